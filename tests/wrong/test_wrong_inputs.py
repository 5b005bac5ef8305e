"""Wrong but plausible inputs: what must be named is, on the page's flight, and on another with another spin."""

from __future__ import annotations

import os
import re
from pathlib import Path

import pytest

from flightmodel.vehicle import DATA
from synthetic_flight.folder import simulate_to_folder
from synthetic_flight.scenarios import read_scenario
from tests.wrong.cases import cases
from tests.wrong.package import read_package
from tests.wrong.table import HARMLESS, NAMED, REFUSED, UNSEEN, first_named, outcomes, verdict

SEED = 5
SHORTER = (
    (r"(?m)^stop_s = 530\.0", "stop_s = 466.0"),
    (r"telemetry_from_s = 300\.0", "telemetry_from_s = 393.0"),
    (r"(?m)^t_s = 300\.0", "t_s = 395.0"),
    (r"rate_hz = 250\.0", "rate_hz = 100.0"),
    (r"rate_hz = 4\.0", "rate_hz = 2.0"),
)
PAGE = Path(__file__).parents[2] / "docs" / "wrong-inputs.md"
ROW = re.compile(r"^\| (.+?) \| (.*?) \| (.*?) \| (.+?) \|$", re.MULTILINE)
FEW = (
    "gyros 0.2 s early",
    "accelerometer 0.05 s early",
    "q and r exchanged",
    "one radar's wander 0.03 deg, not stated",
)
OTHER = Path(os.environ.get("POSTFLIGHT_REALDATA", "")) / "range_packages_with_truth" / "spin20"
# what no data of two radars can show: docs/wrong-inputs.md says why
SHARED = re.compile(r"^both (sites'|azimuths|elevations|ranges)")


@pytest.fixture(scope="module")
def flight(tmp_path_factory) -> Path:
    """The shipped scenario from 393 s on."""
    folder = tmp_path_factory.mktemp("wrong")
    text = (DATA / "scenarios" / "irve2_reference.toml").read_text()
    for pattern, new in SHORTER:
        text, count = re.subn(pattern, new, text)
        assert count, pattern
    (folder / "shorter.toml").write_text(text)
    simulate_to_folder(read_scenario(str(folder / "shorter.toml")), SEED, folder / "flight")
    return folder / "flight"


@pytest.fixture(scope="module")
def page() -> dict[str, tuple[str, str]]:
    """What the page says is named, and its verdict, by case."""
    return {name: (by, stands) for name, by, _, stands in ROW.findall(PAGE.read_text()) if not name.startswith("-")}


def run(folder: Path, names: tuple[str, ...] = ()):
    package = read_package(folder)
    chosen = [case for case in cases(package) if not names or case.name in names]
    return list(outcomes(package, folder / "truth", chosen))


def test_the_page_has_sixty_cases_and_leaves_only_what_all_radars_share_unseen(page):
    verdicts = {name: stands for name, (_, stands) in page.items() if name != "case"}
    assert len(verdicts) >= 60
    assert set(verdicts.values()) <= {NAMED, HARMLESS, UNSEEN, REFUSED}
    assert all(SHARED.match(name) for name, stands in verdicts.items() if stands == UNSEEN)


@pytest.mark.long
def test_a_few_cases_are_named_rightly(flight):
    for case, found in run(flight, FEW):
        assert verdict(case, found) == NAMED, (case.name, found.named)


@pytest.mark.long
def test_every_case_is_what_the_page_says(flight, page):
    wrong = []
    for case, found in run(flight):
        stands = verdict(case, found)
        code, _ = first_named(found)
        by, said = page[case.name]
        if stands != said or (code and f"`{code}`" not in by):
            wrong.append((case.name, stands, said, found.named[:3], found.worst))
    assert not wrong


@pytest.mark.long
@pytest.mark.realdata
@pytest.mark.skipif(not OTHER.is_dir(), reason="POSTFLIGHT_REALDATA names no folder of range packages")
def test_clocks_and_axes_of_another_simulators_flight_are_named():
    names = tuple(
        case.name
        for case in cases(read_package(OTHER))
        if case.name.startswith(("accelerometer 0", "accelerometer turned", "gyros turned", "q and r", "sign of"))
    )
    for case, found in run(OTHER, names):
        assert verdict(case, found) in (NAMED, REFUSED), (case.name, found.named)
