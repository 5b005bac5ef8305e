"""Levels accepted into flight.toml: the right line changes, comments stay, nothing is written that reads otherwise."""

import tomllib

import pytest

from flightmodel.checks import ConfigError
from postflight.noise import toml_lines, with_values
from tests.refusing import refuses

FILE = """name = "a"

[gnss.gps]     # the one on top
file = "gps.csv"
horizontal_sd_m = 5.0   # of the data sheet
[gnss.gps.columns]
t = "t_s"

[gnss."second"]
horizontal_sd_m = 4.0

[sensors.rates]
noise_sd_degps=0.5
"""
NEW = {
    ("gnss.gps", "horizontal_sd_m"): 0.747,
    ("gnss.gps", "wander_sd_m"): 2.0,
    ("sensors.rates", "noise_sd_degps"): 0.1,
}


@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_values_are_put_in_and_the_old_ones_stand_beside(end):
    text = with_values(FILE.replace("\n", end), NEW, "flight.toml")
    read = tomllib.loads(text)
    assert read["gnss"]["gps"]["horizontal_sd_m"] == 0.747
    assert read["gnss"]["gps"]["wander_sd_m"] == 2.0
    assert read["gnss"]["second"] == {"horizontal_sd_m": 4.0}
    assert read["sensors"]["rates"]["noise_sd_degps"] == 0.1
    lines = text.split(end)
    (changed,) = [line for line in lines if "0.747" in line]
    assert "was 5.0" in changed
    assert changed.endswith("of the data sheet")
    assert sum(a != b for a, b in zip(FILE.split("\n"), [x for x in lines if "wander" not in x], strict=True)) == 2


@pytest.mark.parametrize(
    "text",
    [
        "gnss.gps.horizontal_sd_m = 5.0\n",
        "[gnss]\ngps = { horizontal_sd_m = 5.0 }\n",
        '[gnss.gps]\nx = """\n[a]\n"""\n',
    ],
)
def test_a_table_written_otherwise_is_left_to_the_analyst(text):
    values = {("gnss.gps", "horizontal_sd_m"): 0.747}
    if '"""' in text:
        values = {("a", "x"): 1.0}
    with refuses("toml-form", names=["flight.toml", "1|0.747"], kind=ConfigError):
        with_values(text, values, "flight.toml")


def test_lines_to_paste_hold_the_values():
    read = tomllib.loads(toml_lines(NEW))
    assert read["gnss"]["gps"] == {"horizontal_sd_m": 0.747, "wander_sd_m": 2.0}
    assert read["sensors"]["rates"]["noise_sd_degps"] == 0.1
