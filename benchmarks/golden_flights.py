"""Ten flights whose answers are stored in numbers (`benchmarks.golden`): how each is made, flown through, and read.

The tables of a run are written with all digits instead of ten: of a position the tenth may be a thousandth of its sd.
"""

from __future__ import annotations

import json
import math
import os
import re
import shutil
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from benchmarks.golden_numbers import SENTENCES

ROOT = Path(__file__).resolve().parents[1]
DATA = ROOT / "flightmodel" / "data"
SEED = 8123
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
CODE = re.compile(r"\[([a-z0-9]+(?:-[a-z0-9]+)+)\]")
# the command with all digits in its tables
WHOLE = """import sys
from postflight.streams import pin_threads
pin_threads()
from postflight import run_folder
assert run_folder.DIGITS == "%.10g"
run_folder.DIGITS = "%.17g"
from postflight.cli import main
main()"""
ENDS = (0, 2, 3, 4)  # exit codes with which a flight may end: with answers, refused, without an answer
Tables = dict[str, pd.DataFrame]


def one_thread() -> None:
    """Limit linear algebra of processes that are started from now on to one thread."""
    os.environ.update(dict.fromkeys(THREADS, "1"))


def command(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    """Run the ``postflight`` command of this checkout."""
    one_thread()
    env = {**os.environ, "PYTHONPATH": str(ROOT), "COLUMNS": "2000"}  # no code is broken between two lines
    words = [sys.executable, "-c", WHOLE, *map(str, arguments)]
    return subprocess.run(words, capture_output=True, text=True, env=env, check=False)


def simulated(scenario: str | Path, seed: int, folder: Path) -> Path:
    """Fly a scenario into a folder."""
    done = command("simulate", scenario, folder, "--seed", str(seed))
    if done.returncode:
        raise RuntimeError(f"simulate {scenario}: exit {done.returncode}: {done.stderr[-2000:]}")
    return folder


def example(name: str, folder: Path) -> Path:
    """Copy a flight of ``examples/``."""
    return Path(shutil.copytree(ROOT / "examples" / name, folder, ignore=shutil.ignore_patterns("runs")))


def changed(text: str, pattern: str, new: str) -> str:
    """Text with the one place of a pattern replaced."""
    text, count = re.subn(pattern, new, text)
    if count != 1:
        raise RuntimeError(f"{pattern} is there {count} times")
    return text


def other_film(look: str, folder: Path) -> Path:
    """Lay the other renderer's two frames of a look into the flight that they show, which is simulated without film."""
    scenario = (DATA / "scenarios" / "irve2_reference.toml").read_text()
    unfilmed = folder.with_name("unfilmed.toml")
    unfilmed.write_text(changed(scenario, r"(?ms)^\[video\].*?(?=^\[)", ""))
    simulated(unfilmed, 7, folder)
    for kind in ("csv", "toml"):
        shutil.copy(DATA / "aerodynamics" / f"irve2_reference.{kind}", folder)
    vehicle = (DATA / "vehicles" / "irve2_reference.toml").read_text()
    (folder / "vehicle.toml").write_text(changed(vehicle, 'features = "drawn"', 'features = "texture"'))
    names = {t: f"{look}_{t}.jpg" for t in (421, 440)}
    (folder / "telemetry" / "film").mkdir()
    for name in names.values():
        shutil.copy(ROOT / "tests" / "data" / "other_film" / name, folder / "telemetry" / "film")
    rows = "".join(f"{t:.3f},{name}\n" for t, name in names.items())
    (folder / "telemetry" / "frames.csv").write_text(f"t_s,frame\n{rows}")
    flight = changed((folder / "flight.toml").read_text(), '(?m)^vehicle = ".*"', 'vehicle = "vehicle.toml"')
    frames = 'file = "telemetry/frames.csv"\nfolder = "telemetry/film"\ncamera = "camera5"\nbenchmark_s = 421.0\n'
    (folder / "flight.toml").write_text(f"{flight}\n[frames]\n{frames}")
    return folder


def exam_flight(folder: Path) -> Path:
    """Fly the sound flight of the wrong inputs."""
    from tests.wrong import test_wrong_inputs

    folder.mkdir()
    return test_wrong_inputs.fly(folder, test_wrong_inputs.SEED, (), ())


def wrong_input(case: str, folder: Path) -> Path:
    """Make the exam's flight wrong, as `tests.wrong.table` does."""
    from tests.wrong.cases import cases
    from tests.wrong.package import read_package

    wrong = read_package(exam_flight(folder.with_name("sound")))
    chosen = next(one for one in cases(wrong) if one.name == case)
    if not chosen.filmed:
        wrong.film = None
        wrong.spec.pop("frames", None)
    chosen.change(wrong)
    return wrong.write(folder)


def exam_rows(part: int, parts: int, names: list[str]) -> list[dict[str, str]]:
    """Make rows of the table of wrong inputs: one part of the cases with these names, or of all cases."""
    from tests.wrong.cases import cases
    from tests.wrong.package import read_package
    from tests.wrong.table import outcomes, row

    columns = ("case", "code", "suspects", "worst_answer", "error_sd", "verdict")
    with tempfile.TemporaryDirectory() as temporary:
        folder = exam_flight(Path(temporary) / "exam")
        package = read_package(folder)
        chosen = [case for case in cases(package) if not names or case.name in names][part::parts]
        rows = []
        for one in outcomes(package, folder / "truth", chosen):
            rows.append(dict(zip(columns, row(*one), strict=True)))
            print(f"{rows[-1]['case']}: {rows[-1]['verdict']}", flush=True)
        return rows


FLIGHTS: dict[str, Callable[[Path], Path]] = {
    "irve2_reference": partial(simulated, "irve2_reference", 0),  # the demo's
    "irve2_rich": partial(simulated, "irve2_rich", SEED),
    "irve3": partial(simulated, "irve3", SEED),
    "loftid": partial(simulated, "loftid", SEED),
    "mars_entry": partial(example, "mars_entry"),
    "range_package_01": partial(example, "range_package_01"),
    "other_film": partial(other_film, "flown"),
    "gyros_early": partial(wrong_input, "gyros 1 s early"),
    "radar_wanders": partial(wrong_input, "one radar's wander 0.03 deg, not stated"),
    "cg_offset_turned": partial(wrong_input, "c.g. offset in the other axis"),
}


def fly(name: str) -> Tables:
    """Every table of a flight: what is flown, what the command answers and prints.

    Raises
    ------
    RuntimeError
        Where the command ends as it should not, or writes rounded numbers.
    """
    with tempfile.TemporaryDirectory() as temporary:
        folder = FLIGHTS[name](Path(temporary) / "flight")
        tables = dict(flown(folder))
        done = command("run", folder)
        if done.returncode not in ENDS:
            raise RuntimeError(f"{name}: exit {done.returncode}: {done.stderr[-2000:]}")
        printed = " ".join(CODE.findall(f"{done.stdout}\n{done.stderr}"))
        tables["run/command"] = pd.DataFrame([{"exit": done.returncode, "codes": printed}])
        tables.update(answers(folder))
    if "run/bet" in tables and not has_all_digits(tables["run/bet"]):
        raise RuntimeError("bet.csv has less than all digits: mend `WHOLE` in benchmarks/golden_flights.py")
    return tables


def has_all_digits(table: pd.DataFrame) -> bool:
    """Whether numbers have more digits than a run writes: a move below the last would not be seen."""
    values = table.select_dtypes("float").iloc[len(table) // 2].dropna()
    return any(float(f"{x:.12g}") != x for x in values)


def flown(folder: Path) -> Iterator[tuple[str, pd.DataFrame]]:
    """What the estimators are given, and the truth."""
    yield "flight/flight.toml", leaves(tomllib.loads((folder / "flight.toml").read_text()))
    for path in sorted(folder.rglob("*.csv")):
        yield f"flight/{path.relative_to(folder).with_suffix('').as_posix()}", read_csv(path)
    for film in sorted({path.parent for end in ("png", "jpg") for path in folder.rglob(f"*.{end}")}):
        yield f"flight/{film.relative_to(folder).as_posix()}", pictures(film)


def read_csv(path: Path) -> pd.DataFrame:
    """Read a table without rounding."""
    return pd.read_csv(path, low_memory=False, float_precision="round_trip")


def pictures(film: Path) -> pd.DataFrame:
    """Brightness of every frame of a film: mean, rms, and rms of its differences across and down."""
    import cv2

    rows = []
    for path in sorted(film.iterdir()):
        grey = np.asarray(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE), float)
        sizes = (grey, np.diff(grey, axis=1), np.diff(grey, axis=0))
        rows.append((len(rows), grey.mean(), *(math.sqrt(np.mean(x**2)) for x in sizes)))
    return pd.DataFrame(rows, columns=["frame", "mean", "rms", "across_rms", "down_rms"])


def answers(folder: Path) -> Iterator[tuple[str, pd.DataFrame]]:
    """Tables of a flight's one run."""
    for path in sorted(folder.glob("runs/*/*")):
        name = f"run/{path.stem}"
        if path.suffix == ".csv":
            yield name, read_csv(path)
        elif path.name == "summary.json":
            yield name, leaves(json.loads(path.read_text()))
        elif path.suffix == ".toml":
            yield f"{name}.toml", leaves(tomllib.loads(path.read_text()))
        elif path.name == "covariance.npz":
            with np.load(path) as whole:
                yield name, correlations(whole["t_s"], whole["covariance"])


def correlations(time_s: np.ndarray, covariance: np.ndarray) -> pd.DataFrame:
    """Correlations (k, 36) of the trajectory's nine errors; their sd are in ``bet.csv``."""
    sd = np.sqrt(np.einsum("kii->ki", covariance))
    pairs = zip(*np.triu_indices(covariance.shape[1], 1), strict=True)
    columns = {f"correlation_{i}_{j}": covariance[:, i, j] / (sd[:, i] * sd[:, j]) for i, j in pairs}
    return pd.DataFrame({"t_s": time_s, **columns})


def leaves(tree: dict[str, Any]) -> pd.DataFrame:
    """Values of nested tables as a table of one row, whose columns are their paths."""

    def walk(value: Any, path: str) -> Iterator[tuple[str, Any]]:
        if isinstance(value, dict | list):
            for key, part in value.items() if isinstance(value, dict) else enumerate(value):
                if key not in SENTENCES:
                    yield from walk(part, f"{path}.{key}" if path else str(key))
        else:
            yield path, value

    return pd.DataFrame([dict(walk(tree, ""))])
