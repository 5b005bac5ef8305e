"""Wrong but plausible inputs: what must be named is, on the page's flight, and on another with another spin."""

from __future__ import annotations

import csv
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
DOCS = Path(__file__).parents[2] / "docs"
FEW = (
    "gyros 0.2 s early",
    "accelerometer 0.05 s early",
    "q and r exchanged",
    "one radar's wander 0.03 deg, not stated",
)
OTHER = Path(os.environ.get("POSTFLIGHT_REALDATA", "")) / "range_packages_with_truth" / "spin20"
# what no data of two radars can show: docs/wrong-inputs.md says why
SHARED = re.compile(r"^both (sites'|azimuths|elevations|ranges)")


def changed(text: str, changes: tuple[tuple[str, str], ...]) -> str:
    """Text with each pattern's places replaced."""
    for pattern, new in changes:
        text, count = re.subn(pattern, new, text)
        assert count, pattern
    return text


def fly(folder: Path, seed: int, scenario: tuple[tuple[str, str], ...], vehicle: tuple[tuple[str, str], ...]) -> Path:
    """The shipped scenario from 393 s on, it and the shipped vehicle changed."""
    own = (r"(?m)^vehicle = .*", 'vehicle = "vehicle.toml"')
    shipped = DATA / "vehicles" / "irve2_reference.toml", DATA / "scenarios" / "irve2_reference.toml"
    for path, place, changes in zip(
        shipped, ("vehicle", "shorter"), (vehicle, (*SHORTER, *scenario, own)), strict=True
    ):
        (folder / f"{place}.toml").write_text(changed(path.read_text(), changes))
    simulate_to_folder(read_scenario(str(folder / "shorter.toml")), seed, folder / "flight")
    return folder / "flight"


@pytest.fixture(scope="module")
def flight(tmp_path_factory) -> Path:
    """The shipped scenario from 393 s on."""
    return fly(tmp_path_factory.mktemp("wrong"), SEED, (), ())


@pytest.fixture(scope="module")
def table() -> dict[str, dict[str, str]]:
    """What docs/wrong_inputs.csv says of each case."""
    with (DOCS / "wrong_inputs.csv").open(newline="") as file:
        return {row["case"]: row for row in csv.DictReader(file)}


def run(folder: Path, names: tuple[str, ...] = ()):
    package = read_package(folder)
    chosen = [case for case in cases(package) if not names or case.name in names]
    return list(outcomes(package, folder / "truth", chosen))


def test_the_table_has_sixty_cases_and_leaves_only_what_all_radars_share_unseen(table):
    verdicts = {name: row["verdict"] for name, row in table.items()}
    assert len(verdicts) >= 60
    assert set(verdicts.values()) <= {NAMED, HARMLESS, UNSEEN, REFUSED}
    assert all(SHARED.match(name) for name, stands in verdicts.items() if stands == UNSEEN)


def test_the_page_has_the_tables_counts(table):
    page = (DOCS / "wrong-inputs.md").read_text()
    for stands in (NAMED, HARMLESS, UNSEEN, REFUSED):
        assert f"| {stands} | {sum(row['verdict'] == stands for row in table.values())} |" in page


@pytest.mark.long
def test_a_few_cases_are_named_rightly(flight):
    for case, found in run(flight, FEW):
        assert verdict(case, found) == NAMED, (case.name, found.named)


@pytest.mark.long
def test_every_case_is_what_the_table_says(flight, table):
    wrong = []
    for case, found in run(flight):
        stands = verdict(case, found)
        code, _ = first_named(found)
        said = table[case.name]["verdict"]
        if stands != said or code != table[case.name]["code"]:
            wrong.append((case.name, stands, said, found.named[:3], found.worst))
    assert not wrong


@pytest.mark.long
def test_a_stiff_shell_that_spins_hides_nothing_that_the_methods_compared_can_show(tmp_path):
    """Spin averages a lateral force, and trackers see no tilted sensor: only the methods disagree."""
    stiff = ((r"(?m)^bending_stiffness_nmprad = .*", "bending_stiffness_nmprad = 30e3"),)
    names = (
        "accelerometer tilted 3 deg",
        "gyros tilted 3 deg",
        "accelerometer's bias 1 m/s2",
        "gyros without 3 s at the peak",
        "2 s of the gyros repeated",
    )
    for case, found in run(fly(tmp_path, 41, ((r"(?m)^spin_rpm = .*", "spin_rpm = 25.0"),), stiff), names):
        wanted = HARMLESS if case.name.startswith("2 s") else NAMED
        assert verdict(case, found) == wanted, (case.name, found.named, found.worst)


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
