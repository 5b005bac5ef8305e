"""Numbers and formulas that must stand in one place, so that two of them cannot differ."""

from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = ("flightmodel", "recon", "estimators", "synthetic_flight", "postflight")
# text of source code, and the only file that may hold it
ONLY = {
    "9.80665": "flightmodel/earth.py",  # standard gravity
    "2.3, 50.0, 97.7": "flightmodel/statistics.py",
    "DENSITY_LENGTH_M, WIND_LENGTH_M =": "flightmodel/atmosphere.py",  # a sounding's error model
    "np.arcsin(np.clip(self.body_mps": "flightmodel/airdata.py",  # sideslip
}


@pytest.mark.parametrize("text", ONLY)
def test_one_file_holds_it(text: str):
    files = [p for package in PACKAGES for p in (ROOT / package).rglob("*.py") if text in p.read_text()]
    assert [p.relative_to(ROOT).as_posix() for p in files] == [ONLY[text]]
