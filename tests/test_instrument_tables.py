"""One row an error: each reaches the flight file, the filter and the simulator, and a new one needs no other place."""

from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
import pytest
from pydantic import BaseModel

from flightmodel import instruments
from flightmodel.instruments import RadarSite
from recon.state import instrument_blocks
from synthetic_flight import instrument_errors as simulated
from synthetic_flight.instrument_errors import stated_errors

KINDS = {
    "accelerometer": (
        instruments.ACCELEROMETER, instruments.TriadEntry, simulated.Accelerometer, instruments.TriadSpec,
    ),
    "rates": (instruments.RATES, instruments.RatesEntry, simulated.Rates, instruments.TriadSpec),
    "magnetometer": (
        instruments.MAGNETOMETER, instruments.MagnetometerEntry, simulated.Magnetometer, instruments.TriadSpec,
    ),
    "radar": (instruments.RADAR, instruments.RadarEntry, simulated.Radar, RadarSite),
    "sun": (instruments.SUN, instruments.SunEntry, simulated.SunSensors, instruments.SunHeads),
    "gnss": (instruments.GNSS, instruments.GnssEntry, simulated.Gnss, instruments.GnssSpec),
    "barometer": (instruments.BAROMETER, instruments.BarometerEntry, None, instruments.BarometerSpec),
}  # fmt: skip
SITE = {"name": "r", "latitude_rad": 0.6, "longitude_rad": -1.3, "height_m": 12.0}
# every row of a table has a number of its own, so that a mix-up shows
SIZES = {row.name: 0.01 * k for k, row in enumerate(instruments.RADAR.rows, 1)}


@pytest.mark.parametrize("kind", KINDS)
def test_every_row_is_in_record_file_and_scenario(kind: str):
    table, entry, section, record = KINDS[kind]
    for row in table.rows:
        assert row.name in {f.name for f in fields(record)}
        assert entry.model_fields[row.key].default == row.prior
        for key in row.scenario_keys:
            assert section is not None
            assert key in section.model_fields or hasattr(section, key), f"{kind}: {key}"


def test_every_error_state_of_a_radar_has_its_row_s_size_and_unit():
    blocks = instrument_blocks(instruments.RADAR, RadarSite(**SITE, **SIZES))
    rows = [row for row in instruments.RADAR.rows if row.states]
    assert [(b.components, b.unit, b.prior_sd) for b in blocks] == [(r.states, r.unit, SIZES[r.name]) for r in rows]
    # angles, range rate, range
    assert [b.time_constant_s for b in blocks if np.isfinite(b.time_constant_s)] == [20.0, 5.0, 20.0]


def test_units_of_the_file_become_si():
    entry = instruments.RadarEntry(
        file="x.csv", latitude_deg=0.0, longitude_deg=0.0, height_m=0.0, droop_sd_deg=2.0, range_scale_sd=3e-6
    )
    si = instruments.RADAR.from_file(entry)
    assert si["droop_sd_rad"] == pytest.approx(np.pi / 90.0)
    assert si["range_scale_sd"] == 3e-6
    assert si["azimuth_sd_rad"] is None
    field = instruments.MAGNETOMETER.from_file(instruments.MagnetometerEntry(file="x.csv", bias_sd_ut=0.7))
    assert field["bias_sd"] == pytest.approx(0.7e-6)
    assert field["bias_time_constant_s"] == 100.0


def test_a_new_row_reaches_file_filter_and_simulator():
    @dataclass(frozen=True)
    class Drooping(RadarSite):
        sag_sd_rad: float = instruments.error_row(
            "rad", 0.0, at=0.0, states=("sag",), simulated=None, left_out=True,
            response=(2, lambda error, _slant, _az, el: error * np.sin(el)),
        )  # fmt: skip

    table = instruments.table_of(Drooping)

    @instruments.with_keys(table.file_keys())
    class Entry(BaseModel):
        pass

    @instruments.with_keys(table.scenario_keys())
    class Section(BaseModel):
        refraction_left: float = 0.0

    assert Entry.model_fields["sag_sd_deg"].default == 0.0
    given = {key: 0.5 for key, (_, default) in table.scenario_keys().items() if default is ...}
    section = Section(**given, sag_deg=0.25)
    assert "sag_sd_deg = 0.25" in stated_errors(table, section, if_there=True)
    assert table.from_scenario(section)["sag_sd_rad"] == (pytest.approx(np.deg2rad(0.25)),)
    stated = table.from_file(Entry(sag_sd_deg=0.25))
    assert instrument_blocks(table, Drooping(**SITE, **stated))[-1].components == ("sag",)


def test_an_error_s_name_stands_in_the_table_and_in_the_function_with_its_partials():
    root = Path(__file__).parents[1]
    packages = ("flightmodel", "recon", "estimators", "synthetic_flight", "postflight")
    naming = {
        path.relative_to(root).as_posix()
        for package in packages
        for path in (root / package).rglob("*.py")
        if "droop" in path.read_text().lower()
    }
    assert naming == {"flightmodel/instruments.py", "recon/measurements.py"}
