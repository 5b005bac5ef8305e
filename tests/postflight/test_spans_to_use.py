"""``use_s`` on every table of an entry flight: what lies outside is not looked at, and is told."""

from __future__ import annotations

import numpy as np
import pytest

from flightmodel.flightfolder import read_flight
from tests.refusing import numbers_in, refuses


@pytest.mark.parametrize(
    "section", ["sensors.accelerometer", "sensors.rates", "radars.north", "radars.south", "frames"]
)
def test_rows_outside_are_left_out(flight, clean_flight, section):
    name = section.split(".")[-1]
    flight.declare("use_s = [[420.0, 422.4], [424.0, 428.0]]", after=f"[{section}]")
    telemetry = read_flight(flight.root)
    record = telemetry.radars[name] if section.startswith("radars") else getattr(telemetry, name)
    whole = read_flight(clean_flight.root)
    before = whole.radars[name] if section.startswith("radars") else getattr(whole, name)
    inside = np.array([420.0 <= t <= 422.4 or 424.0 <= t <= 428.0 for t in before.time_s])
    assert 0 < inside.sum() < len(inside)
    np.testing.assert_array_equal(record.time_s, before.time_s[inside])
    if section == "frames":
        assert [p.name for p in record.paths] == [p.name for p, kept in zip(before.paths, inside, strict=True) if kept]
    (told,) = [f.what for f in telemetry.findings if (f.source, f.code) == (name, "rows-outside-span")]
    assert numbers_in(told)[:2] == [(~inside).sum(), len(inside)]


def test_a_picture_outside_may_be_missing(flight):
    (flight.root / "telemetry" / "camera5" / "frame_2.png").unlink()
    with refuses("file-missing", names=[r"frame_2\.png"]):
        read_flight(flight.root)
    flight.declare("use_s = [[420.0, 425.0]]", after="[frames]")
    assert len(read_flight(flight.root).frames.paths) == 2


def test_a_span_without_a_picture_is_refused(flight):
    flight.declare("use_s = [[500.0, 600.0]]", after="[frames]")
    with refuses("too-few-rows", names=["use_s"]):
        read_flight(flight.root)
