"""Which clock is off, where time biases between pairs of them are known."""

from postflight.checks.units_and_axes import TimeBias, clock_remarks

ONBOARD = ["accelerometer", "rates"]


def edges(**late_s):
    """Time biases of all pairs of four clocks, some of them late."""
    clocks = {"a": 0.0, "b": 0.0, "accelerometer": 0.0, "rates": 0.0} | late_s
    pairs = [
        ("b", "a", 0.03),
        ("a", "accelerometer", 0.2),
        ("b", "accelerometer", 0.05),
        ("accelerometer", "rates", 0.01),
    ]
    return [TimeBias(one, other, clocks[one] - clocks[other], sd) for one, other, sd in pairs]


def named(biases):
    return [(f.source, f.code) for f in clock_remarks(biases, ONBOARD)]


def test_the_clock_that_explains_all_pairs_is_named():
    assert named(edges()) == []
    for name in ("a", "b", "accelerometer", "rates"):
        assert named(edges(**{name: 0.4})) == [(name, "clock-lag")]


def test_both_sensors_on_board_may_share_a_clock():
    assert named(edges(accelerometer=-0.5, rates=-0.5)) == [("accelerometer, rates", "clock-lag")]
    assert named(edges(a=0.5, b=0.5)) == [("accelerometer, rates", "clock-lag")]  # the same in all that is measured


def test_two_clocks_are_named_one_after_the_other():
    assert sorted(named(edges(a=2.0, rates=0.6))) == [("a", "clock-lag"), ("rates", "clock-lag")]


def test_between_three_and_five_sd_a_clock_is_worth_a_look():
    seen = [TimeBias("a", "b", late, 0.1) for late in (0.25, 0.35, 0.55)]
    assert [bias.is_worth_a_look for bias in seen] == [False, True, False]
    assert [bias.is_significant for bias in seen] == [False, False, True]
    assert TimeBias("a", "b", 0.08, 0.01).is_worth_a_look  # eight sd, but less than a tenth of a second
