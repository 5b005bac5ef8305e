"""Rows as ranges deliver them: whatever order packets come in, the flight is the same; what contradicts is not used."""

from __future__ import annotations

import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flightmodel.gate import FEW, in_order
from tests.refusing import numbers_in

STEP_S = 0.01


def flight(rows, seed=0):
    """Times and two channels, one with holes."""
    rng = np.random.default_rng(seed)
    time_s = np.round(100.0 + STEP_S * np.arange(rows), 6)
    values = rng.normal(size=(2, rows))
    values[1, rng.random(rows) < 0.1] = np.nan
    return time_s, values


def delivered(time_s, values, rows):
    rows = np.asarray(rows)
    return in_order(time_s[rows], [column[rows] for column in values], 2 + np.arange(len(rows)))


def counted(words):
    return tuple(int(n) for n in re.match(r"(\d+) rows? in (\d+) block", words).groups())


def check_whole(delivery, rows, count):
    """Every row of the flight once, in order."""
    assert not delivery.refusal
    np.testing.assert_array_equal(np.asarray(rows)[delivery.rows], np.arange(count))


def test_what_is_in_order_is_left_alone():
    time_s, values = flight(500)
    delivery = delivered(time_s, values, np.arange(500))
    check_whole(delivery, np.arange(500), 500)
    assert delivery.repairs == ()


@settings(max_examples=80, deadline=None)
@given(st.data())
def test_packets_in_any_order_and_number_are_the_same_flight(data):
    count = data.draw(st.integers(40, 300))
    time_s, values = flight(count, seed=count)
    cuts = sorted(data.draw(st.sets(st.integers(1, count - 1), max_size=6)))
    packets = np.split(np.arange(count), cuts)
    packets = [packets[k] for k in data.draw(st.permutations(range(len(packets))))]
    again = data.draw(st.lists(st.sampled_from(packets), max_size=3))
    rows = np.concatenate([*packets, *again])
    delivery = delivered(time_s, values, rows)
    check_whole(delivery, rows, count)
    repairs = {repair.code: repair for repair in delivery.repairs}
    assert ("rows-left-out" in repairs) == bool(again)
    if again:
        repair = repairs["rows-left-out"]
        assert counted(repair.what)[0] == sum(map(len, again))
        assert (repair.start_s, repair.end_s) == (
            time_s[np.concatenate(again)].min(),
            time_s[np.concatenate(again)].max(),
        )
    sent = np.concatenate(packets)
    late = sent[sent < np.maximum.accumulate(sent)]
    assert ("rows-reordered" in repairs) == bool(len(late))
    if len(late):
        repair = repairs["rows-reordered"]
        assert counted(repair.what)[0] == len(late)
        assert (repair.start_s, repair.end_s) == (time_s[late.min()], time_s[late.max()])


@pytest.mark.parametrize(
    "rows",
    [
        np.arange(400)[::-1],
        np.arange(400).reshape(-1, 2)[:, ::-1].ravel(),
        np.random.default_rng(3).permutation(400),
        np.concatenate([np.delete(np.arange(400), np.arange(5, 400, 9)), np.arange(5, 400, 9)]),
        np.concatenate([np.arange(400), np.arange(400)]),
        np.repeat(np.arange(400), 3),
    ],
    ids=["reversed", "swapped in pairs", "shuffled", "single rows late", "all twice", "each three times"],
)
def test_orders_of_all_kinds(rows):
    time_s, values = flight(400)
    check_whole(delivered(time_s, values, rows), rows, 400)


def test_late_rows_of_a_jittering_clock_find_their_place():
    rng = np.random.default_rng(5)
    time_s, values = flight(2000)
    time_s = time_s + STEP_S * rng.uniform(-0.2, 0.2, size=2000)
    late = np.arange(7, 2000, 50)
    rows = np.concatenate([np.delete(np.arange(2000), late), late])
    check_whole(delivered(time_s, values, rows), rows, 2000)


def test_a_late_block_of_which_a_part_was_there_already():
    time_s, values = flight(300)
    first = np.delete(np.arange(300), [*range(100, 104), *range(105, 120)])  # 104 came through, the rest was sent again
    rows = np.concatenate([first, np.arange(100, 120)])
    delivery = delivered(time_s, values, rows)
    check_whole(delivery, rows, 300)
    assert [counted(repair.what) for repair in delivery.repairs] == [(1, 1), (19, 2)]


@pytest.mark.parametrize("phase", [0.0, 0.1, 0.37, 0.5, 0.8])
@pytest.mark.parametrize("back", [30, 150, 399])
def test_a_clock_that_was_reset_is_refused(phase, back):
    time_s, values = flight(800)
    time_s = np.round(np.where(np.arange(800) < 400, time_s, time_s - (back + phase) * STEP_S), 6)
    delivery = in_order(time_s, list(values), 2 + np.arange(800))
    assert delivery.refusal.startswith("line 402: ")
    assert delivery.refusal.code == "rows-contradict"
    if phase == 0.0:
        assert numbers_in(delivery.refusal)[-2:] == [402 - back, 2 * back]
    else:
        assert numbers_in(delivery.refusal)[-1] == back


@pytest.mark.parametrize("back", [2.4, 12.0, 12.4])
def test_a_clock_that_was_reset_a_little_is_refused_for_what_follows(back):
    time_s, values = flight(4000)
    time_s = np.round(np.where(np.arange(4000) < 2000, time_s, time_s - back * STEP_S), 6)
    delivery = in_order(time_s, list(values), 2 + np.arange(4000))
    assert delivery.refusal.code == "clock-set-back"
    assert delivery.refusal.startswith("line 2002: ")
    told = [2002.0, round(time_s[1999], 6), round(time_s[2000], 6), int(back)]
    assert numbers_in(delivery.refusal)[:4] == told


@pytest.mark.parametrize("late", [1, 12])
def test_a_late_block_that_contradicts_and_ends_with_a_jump_is_left_out(late):
    time_s, values = flight(4000)
    sent = np.concatenate([time_s[:2000], time_s[2000 - late : 2000] - 0.4 * STEP_S, time_s[2000:]])
    rows = np.concatenate([np.arange(2000), np.arange(3000, 3000 + late), np.arange(2000, 4000)])
    whole = in_order(sent[: 2000 + late], list(values[:, rows[: 2000 + late]]), np.arange(2000 + late))
    sent = np.concatenate([sent[: 2000 + late], sent[2000 + late + 2 :]])  # after what is late comes something new
    rows = np.concatenate([rows[: 2000 + late], rows[2000 + late + 2 :]])
    delivery = in_order(sent, list(values[:, rows]), 2 + np.arange(len(sent)))
    for found in (whole, delivery):
        assert not found.refusal
        (repair,) = found.repairs
        assert counted(repair.what) == (late, 1)
        assert repair.code == "rows-contradict"
        assert (repair.start_s, repair.end_s) == (sent[2000], sent[1999 + late])
    assert (np.diff(sent[delivery.rows]) > 0.0).all()


def test_a_block_sent_again_with_a_few_other_values_is_no_reset_clock():
    time_s, values = flight(4000)
    rows = np.concatenate([np.arange(2000), np.arange(1988, 4000)])  # runs on from what was sent again
    values = values[:, rows]
    values[0, [2003, 2004]] += 1.0
    delivery = in_order(time_s[rows], list(values), 2 + np.arange(len(rows)))
    assert not delivery.refusal
    assert [counted(repair.what)[0] for repair in delivery.repairs] == [10, 4]


@pytest.mark.parametrize("torn", [1, 3, 4, 40])
def test_few_rows_that_contradict_are_left_out_and_many_are_refused(torn):
    count = 800
    time_s, values = flight(count)
    places = np.linspace(10, 700, torn).astype(int)
    rows = np.concatenate([np.arange(count), places])
    values = values[:, rows]
    values[0, count:] += 1.0
    delivery = in_order(time_s[rows], list(values), 2 + np.arange(len(rows)))
    if 2 * torn >= FEW * len(rows):
        assert torn >= 4 + (torn == 4)
        assert delivery.refusal.code == "rows-contradict"
        told = numbers_in(delivery.refusal)
        assert (told[0], *told[-2:]) == (count + 2, places[0] + 2, 2 * torn)
        return
    assert torn <= 4
    (repair,) = delivery.repairs
    assert counted(repair.what) == (2 * torn, torn + 1)
    assert repair.code == "rows-contradict"
    assert all(f"{t:.6f}" in repair.what for t in time_s[places])
    assert (repair.start_s, repair.end_s) == (time_s[places[0]], time_s[places[-1]])
    np.testing.assert_array_equal(delivery.rows, np.delete(np.arange(count), places))


def test_a_value_that_is_missing_in_one_copy_alone_is_another_value():
    time_s = np.array([0.0, 1.0, 1.0, 2.0, 3.0])
    alike = in_order(time_s, [np.array([5.0, np.nan, np.nan, 6.0, 7.0])], np.arange(2, 7))
    np.testing.assert_array_equal(alike.rows, [0, 1, 3, 4])
    other = in_order(time_s, [np.array([5.0, np.nan, 2.0, 6.0, 7.0])], np.arange(2, 7))
    assert other.refusal.code == "rows-contradict"
    assert "line 4: " in other.refusal
    assert "line 3 " in other.refusal


def test_one_row_all_over_again_is_refused():
    delivery = in_order(np.full(5, 2.0), [np.ones(5)], np.arange(2, 7))
    assert "line 3: " in delivery.refusal
    assert delivery.refusal.code == "too-few-rows"
