"""Units: every short name against a library of units, other texts through it, and what is no unit of a table."""

import numpy as np
import pint
import pytest

from flightmodel.checks import ConfigError
from flightmodel.config import Section, parse_section
from flightmodel.units import UNITS, read_unit

PINT = pint.UnitRegistry()
IN_PINT = {
    "deg1e7": "1e-7 * degree", "mil": "2 * pi / 6400 * radian", "mps2": "m/s^2", "g": "standard_gravity",
    "mg": "standard_gravity/1000", "ftps2": "ft/s^2", "radps": "rad/s", "mradps": "mrad/s", "degps": "deg/s",
    "degph": "deg/hour", "t": "tesla", "ut": "microtesla", "nt": "nanotesla", "mps": "m/s", "cmps": "cm/s",
    "mmps": "mm/s", "kmh": "km/hour", "kt": "knot", "ftps": "ft/s", "kgpm3": "kg/m^3", "gpm3": "g/m^3",
    "slugpft3": "slug/ft^3", "lbpft3": "lb/ft^3", "k": "kelvin", "degc": "degC", "degf": "degF", "degr": "degR",
    "pa": "Pa", "hpa": "hPa", "kpa": "kPa", "psf": "lbf/ft^2", "inhg": "inHg", "mmhg": "mmHg", "gon": "gon",
    "us": "us", "nmi": "nautical_mile",
}  # fmt: skip


@pytest.mark.parametrize("name", [name for name in UNITS if name not in ("1", "percent", "gauss")])
def test_short_names_are_what_the_library_says(name):
    unit = UNITS[name]
    text = IN_PINT.get(name, name)
    if name in ("degc", "degf"):
        low, high = (PINT.Quantity(x, text).to_base_units().magnitude for x in (0.0, 1.0))
        assert unit.offset == pytest.approx(low, abs=1e-9)
        assert unit.factor == pytest.approx(high - low, rel=1e-9)
    else:
        text = text.replace("pi", "3.141592653589793")
        assert unit.factor == pytest.approx(PINT.parse_expression(text).to_base_units().magnitude, rel=1e-6)
        assert unit.offset == 0.0


@pytest.mark.parametrize(
    ("text", "kind", "factor"),
    [
        ("deg/hr", "rate", 4.84813681e-6),
        ("slug/ft^3", "density", 515.378818),
        ("kg m-3", "density", 1.0),
        ("g/cm³", "density", 1000.0),
        ("m/s2", "acceleration", 1.0),
        ("m s⁻²", "acceleration", 1.0),
        ("inHg", "pressure", 3386.389),
        ("mbar", "pressure", 100.0),
        ("furlong/fortnight", "speed", 1.66309857e-4),
        ("arcmin", "angle", 2.90888e-4),
        ("µT", "magnetic field", 1e-6),
        ("kiloyard", "length", 914.4),
    ],
)
def test_other_texts_are_read(text, kind, factor):
    unit = read_unit(text)
    assert unit.kind == kind
    assert unit.factor == pytest.approx(factor, rel=1e-5)


@pytest.mark.parametrize(
    "text",
    ["", "F", "R", "C", "V", "volt", "counts", "kg", "N m", "dBm", "%", "m/", "__import__('os')", "m" * 60, "9**9**9",
     "m^9999999", "raw", "m\n", "s^-1"],
)  # fmt: skip
def test_what_is_no_unit_of_a_table_is_not_read(text):
    assert read_unit(text) is None


class DataSheet(Section):
    """Keys whose names end with a unit, as those of flight.toml."""

    bias_sd_mps2: float = 0.0
    noise_sd_deg: tuple[float, float] | float = 0.0
    mount_k: float = 0.0
    mass_kg: float = 0.0
    rows: int = 0


@pytest.mark.parametrize(
    ("key", "text", "number"),
    [
        ("bias_sd_mps2", "4 mg", 4e-3 * 9.80665), ("bias_sd_mps2", "3e-2 ft/s^2", 3e-2 * 0.3048),
        ("noise_sd_deg", "1 mrad", np.rad2deg(1e-3)), ("noise_sd_deg", "30 arcmin", 0.5),
        ("mount_k", "20 degC", 293.15), ("mount_k", "20 K", 20.0),
    ],
)  # fmt: skip
def test_a_data_sheet_s_value_takes_its_unit(key, text, number):
    assert getattr(parse_section(DataSheet, {key: text}, "sheet"), key) == pytest.approx(number, rel=1e-12)


def test_a_list_takes_units_too():
    sheet = parse_section(DataSheet, {"noise_sd_deg": ["0.1 deg", 0.2]}, "sheet")
    assert sheet.noise_sd_deg == pytest.approx((0.1, 0.2))


@pytest.mark.parametrize(
    "stated",
    [
        {"bias_sd_mps2": "4 kg"},
        {"bias_sd_mps2": "4"},
        {"bias_sd_mps2": "4 furlongs?"},
        {"mass_kg": "much"},
        {"rows": "4"},
    ],
)
def test_a_value_with_another_unit_or_none_is_refused(stated):
    with pytest.raises(ConfigError):
        parse_section(DataSheet, stated, "sheet")
