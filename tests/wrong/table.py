"""The table of wrong inputs (docs/wrong_inputs.csv): which case is named by what, and how wrong the worst answer is.

``python -m tests.wrong.table FOLDER`` runs every case on the flight in FOLDER, a sound synthetic flight with its truth,
and prints the table's rows.
"""

from __future__ import annotations

import csv
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

from estimators.agreement import CAMERA_MISALIGNED, MOUNT
from tests.wrong.cases import Case, cases
from tests.wrong.outcome import Outcome, outcome_of
from tests.wrong.package import Package, read_package

NAMED, HARMLESS, UNSEEN, REFUSED = "named", "harmless", "not visible", "refused"
_INPUTS = {  # of the methods' agreement, and whose file states them
    "aerodynamic coefficients": "vehicle",
    "initial c.g. offset": "vehicle",
    "mass properties": "vehicle",
    "sounded wind": "atmosphere",
    "sounded density": "atmosphere",
    MOUNT: "accelerometer",
    "frames": "camera",
    CAMERA_MISALIGNED: "camera",
}


def first_named(found: Outcome) -> tuple[str, tuple[str, ...]]:
    """Code and suspects of what is named first; empty where nothing is."""
    for code, sources in found.named:
        names = [name for source in sources for name in _INPUTS.get(source, source).split(", ") if name]
        suspects = tuple(_INPUTS.get(name, name) for name in names)
        if suspects:
            return code, suspects
    return "", ()


def verdict(case: Case, found: Outcome) -> str:
    """`NAMED` rightly, `REFUSED` by the run, `HARMLESS`, `UNSEEN`, or in words what is wrong."""
    _, suspects = first_named(found)
    if set(suspects) & set(case.suspects):
        return NAMED
    if any(reason.startswith("run ") for reason in found.refused):
        return REFUSED
    if suspects:
        return f"blames {' or '.join(suspects)}"
    return UNSEEN if found.is_wrong else HARMLESS


def outcomes(package: Package, truth: Path, chosen: list[Case]) -> Iterator[tuple[Case, Outcome]]:
    """Run cases one after the other."""
    for case in chosen:
        wrong = package.copy()
        if not case.filmed:
            wrong.film = None
            wrong.spec.pop("frames", None)
        case.change(wrong)
        with tempfile.TemporaryDirectory() as folder:
            yield case, outcome_of(wrong.write(Path(folder) / "flight"), truth)


def row(case: Case, found: Outcome) -> tuple[str, ...]:
    """One row of the table."""
    code, suspects = first_named(found)
    worst, size = found.worst if found.errors_sd else ("", None)
    error = "" if size is None else f"{size:.1f}"
    return case.name, code, " ".join(dict.fromkeys(suspects)), worst, error, verdict(case, found)


def main(folder: Path) -> None:
    """Write the rows of every case to standard output."""
    package = read_package(folder)
    writer = csv.writer(sys.stdout, lineterminator="\n")
    writer.writerow(("case", "code", "suspects", "worst_answer", "error_sd", "verdict"))
    for case, found in outcomes(package, folder / "truth", cases(package)):
        writer.writerow(row(case, found))
        sys.stdout.flush()


if __name__ == "__main__":
    main(Path(sys.argv[1]))
