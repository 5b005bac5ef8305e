"""The cache of tables: found by content alone, whole or not at all, never larger than its limit, never a fault."""

from __future__ import annotations

import os
import subprocess
import sys
import time

import numpy as np
import pytest

from flightmodel import csv_reading
from flightmodel.csv_reading import read_numbers
from flightmodel.tables import TimeColumn

WANTED = {"a": True, "b": False}


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """A cache of its own, which takes small files too."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.delenv("POSTFLIGHT_CACHE", raising=False)
    monkeypatch.setattr(csv_reading, "SMALLEST_BYTES", 0)
    monkeypatch.setattr(csv_reading, "CACHED_BYTES", 0)
    return tmp_path / "cache" / "postflight" / "tables"


@pytest.fixture
def table(tmp_path):
    path = tmp_path / "t.csv"
    path.write_text("t_s,a,b\n" + "".join(f"{k},{k * 0.37:.4f},{'' if k % 9 == 0 else k}\n" for k in range(500)))
    return path


@pytest.fixture
def parses(monkeypatch):
    """How often a file was read and not found in the cache."""
    count = []
    parse = csv_reading._parse
    monkeypatch.setattr(csv_reading, "_parse", lambda *arguments: count.append(1) or parse(*arguments))
    return count


def read(path):
    return read_numbers(path, WANTED, TimeColumn())


def same(one, other):
    np.testing.assert_array_equal(one.time, other.time)
    assert list(one.columns) == list(other.columns)
    for name in one.columns:
        np.testing.assert_array_equal(one.columns[name], other.columns[name])
    assert (one.first_line, one.sha256) == (other.first_line, other.sha256)


def test_the_second_reading_is_from_the_cache_and_the_same(cache, table, parses):
    first = read(table)
    second = read(table)
    assert len(parses) == 1
    same(first, second)
    assert len(list(cache.iterdir())) == 1


def test_a_moved_file_is_found_again_and_a_changed_one_is_not(cache, table, parses, tmp_path):
    first = read(table)
    moved = table.rename(tmp_path / "other.csv")
    same(first, read(moved))
    assert len(parses) == 1
    times = os.stat(moved)
    text = moved.read_text()
    moved.write_text(text.replace("3.7000", "3.8000"))
    os.utime(moved, ns=(times.st_atime_ns, times.st_mtime_ns))  # as a copying tool would leave it
    assert moved.stat().st_size == times.st_size
    assert read(moved).columns["a"][10] == 3.8
    assert len(parses) == 2


def test_other_columns_are_another_entry(cache, table, parses):
    read(table)
    other = read_numbers(table, {"b": True}, TimeColumn())
    assert list(other.columns) == ["t_s", "b"]
    assert read_numbers(table, WANTED).time is None
    assert len(parses) in (2, 3)
    before = len(parses)
    assert list(read_numbers(table, {"b": True}, TimeColumn()).columns) == ["t_s", "b"]
    assert len(parses) == before


def _cut(path):
    path.write_bytes(path.read_bytes()[:-200])


def _hole(path):
    """A page that never reached the disk: right length, zeros inside."""
    data = bytearray(path.read_bytes())
    data[1000:2000] = bytes(1000)
    path.write_bytes(data)


def _garbage(path):
    path.write_bytes(os.urandom(5000))


def _empty(path):
    path.write_bytes(b"")


def _pickle(path):
    with path.open("wb") as file:
        np.save(file, np.array([{}], dtype=object))


@pytest.mark.parametrize("spoil", [_cut, _hole, _garbage, _empty, _pickle])
def test_a_damaged_entry_is_ignored_and_written_anew(cache, table, parses, spoil):
    first = read(table)
    (entry,) = cache.iterdir()
    spoil(entry)
    same(first, read(table))
    assert len(parses) == 2
    same(first, read(table))
    assert len(parses) == 2


@pytest.mark.parametrize("word", ["off", "OFF", "0", "no"])
def test_it_can_be_turned_off(cache, table, parses, monkeypatch, word):
    monkeypatch.setenv("POSTFLIGHT_CACHE", word)
    same(read(table), read(table))
    assert len(parses) == 2
    assert not cache.exists()


def test_small_files_are_not_kept(cache, table, monkeypatch):
    monkeypatch.setattr(csv_reading, "CACHED_BYTES", table.stat().st_size + 1)
    read(table)
    assert not cache.exists()


def test_a_cache_that_cannot_be_written_is_no_fault(table, tmp_path, monkeypatch, cache):
    (tmp_path / "cache").write_text("a file where the folder should be")
    same(read(table), read(table))


def test_it_stays_within_its_limit_and_the_longest_unused_goes(cache, table, monkeypatch):
    read(table)
    (kept,) = cache.iterdir()
    size = kept.stat().st_size
    monkeypatch.setattr(csv_reading, "LIMIT_BYTES", int(3.5 * size))
    names = []
    for k in range(3):
        path = table.with_name(f"{k}.csv")
        path.write_text(table.read_text().replace("18.1300", f"18.13{k}1"))
        old = time.time() - 100.0 + k
        for entry in cache.iterdir():
            if entry not in names and entry != kept:
                names.append(entry)
                os.utime(entry, (old, old))
        read(path)
    os.utime(kept, (1.0, 1.0))
    read(table)  # a look takes it from the oldest to the newest
    path = table.with_name("last.csv")
    path.write_text(table.read_text().replace("18.1300", "18.1399"))
    read(path)
    assert sum(e.stat().st_size for e in cache.iterdir()) <= 3.5 * size
    assert kept.exists()
    assert not names[0].exists()


def test_what_a_killed_process_left_is_swept_up(cache, table):
    cache.mkdir(parents=True)
    left, fresh = cache / "left.part", cache / "fresh.part"
    left.touch()
    fresh.touch()
    os.utime(left, (1.0, 1.0))
    read(table)
    assert not left.exists()
    assert fresh.exists()


def test_a_block_beyond_half_the_limit_is_not_kept(cache, table, monkeypatch):
    monkeypatch.setattr(csv_reading, "LIMIT_BYTES", 1000)
    read(table)
    assert not cache.exists()


def test_two_processes_at_once(cache, table):
    code = (
        "import sys; from pathlib import Path; from flightmodel import csv_reading; "
        "csv_reading.SMALLEST_BYTES = csv_reading.CACHED_BYTES = 0; "
        "print([float(csv_reading.read_numbers(Path(sys.argv[1]), {'a': True}).columns['a'].sum()) for _ in range(20)])"
    )
    running = [
        subprocess.Popen([sys.executable, "-c", code, str(table)], stdout=subprocess.PIPE, text=True) for _ in range(2)
    ]
    told = [process.communicate()[0] for process in running]
    assert all(process.returncode == 0 for process in running)
    assert told[0] == told[1]
    assert len(set(told[0].strip("[]\n").split(", "))) == 1
    assert [p.suffix for p in cache.iterdir()] == [".npy"]
