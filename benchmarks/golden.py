"""Ten flights' answers in numbers: is what this checkout answers the same as what was stored, to 1e-9 of the stated sd?

    python benchmarks/golden.py store [FLIGHT ...]      fly, and write benchmarks/golden/FLIGHT.json
    python benchmarks/golden.py compare [FLIGHT ...]    fly again, and print what differs from these files
    python benchmarks/golden.py exam [CASE ...]         make docs/wrong_inputs.csv again, and print what differs

Every flight (`benchmarks.golden_flights`) is flown through ``postflight run`` in a temporary folder, two at once
(``--jobs``), with one thread of linear algebra each: a minute for all ten on two quiet cores, some ten minutes for the
exam. `benchmarks.golden_numbers` says what is kept and how it is compared; versions, hashes and times of day are not.
Tables named ``flight/...`` are what the estimators read, and the truth: where these differ the simulator moved, and the
answers (``run/...``) with it. Tables and columns that are not stored yet are named; nothing guards them.

Store and compare on one machine with the same packages: kernels and linear algebra round otherwise on another
processor, and what is fitted with numerical derivatives (Southwell's intervals) makes 4e-9 of a last digit.

``benchmarks/golden/moves.toml`` accepts differences for a written reason. Exit code 1 where anything else differs.
"""

from __future__ import annotations

import argparse
import csv
import json
import math
import multiprocessing
import sys
import time
import tomllib
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

# this checkout's packages, whatever the environment has installed
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from benchmarks.golden_flights import FLIGHTS, Tables, exam_rows, fly, one_thread
from benchmarks.golden_numbers import SENTENCES, differences, kept

ROOT = Path(__file__).resolve().parents[1]
STORE = ROOT / "benchmarks" / "golden"
TOLERANCE = 1e-9
EXAM = ROOT / "docs" / "wrong_inputs.csv"
OF_EXAM = ("verdict", "code", "suspects")
Rows = dict[str, dict[str, str]]  # of the table of wrong inputs, by case


@dataclass(frozen=True)
class Difference:
    """Largest difference of a column of a flight, in its unit (infinite where it has no size), and where it is."""

    flight: str
    table: str
    column: str
    size: float
    unit: str
    where: str


@dataclass(frozen=True)
class Move:
    """Differences that are accepted for a reason, up to a size; names may hold ``*``."""

    flight: str
    table: str
    column: str
    most: float
    reason: str

    def covers(self, found: Difference) -> bool:
        """Whether a difference is one of these, and no larger."""
        pairs = ((found.flight, self.flight), (found.table, self.table), (found.column, self.column))
        return found.size <= self.most and all(fnmatchcase(name, pattern) for name, pattern in pairs)


def read_moves(path: Path) -> list[Move]:
    """Read the written reasons; a store elsewhere may have none.

    Raises
    ------
    ValueError
        For an entry without words for a reason, or with a size that is no positive number.
    """
    text = path.read_text() if path.is_file() else ""
    moves = [Move(**entry) for entry in tomllib.loads(text).get("moved", [])]
    for move in moves:
        if not move.reason.strip() or not move.most > 0.0:
            raise ValueError(f"{path}: {move}: a move needs its largest size and its reason in words")
    return moves


def compared(flight: str, stored: dict[str, Any], fresh: Tables) -> tuple[list[Difference], list[str]]:
    """The largest difference of every column of a flight; and the tables and columns that are not stored."""
    found: dict[tuple[str, str], Difference] = {}
    for table, old in stored.items():
        if table not in fresh:
            found[table, "*"] = Difference(flight, table, "*", math.inf, "", "the table is gone")
            continue
        for one in differences(old, fresh[table]):
            before = found.get((table, one.column))
            if one.size > TOLERANCE and (before is None or one.size > before.size):
                found[table, one.column] = Difference(flight, table, *one)
    new = [table for table in fresh if table not in stored]
    for table in stored.keys() & fresh.keys():
        known = {*stored[table]["columns"], *SENTENCES}
        new += [f"{table} {column}" for column in fresh[table] if column not in known]
    return list(found.values()), sorted(new)


def verdict(found: list[Difference], moves: list[Move], flights: Sequence[str]) -> int:
    """Print what differs, what was accepted and why, and reasons without a difference; 1 where anything is left."""
    reasons = [next((move for move in moves if move.covers(one)), None) for one in found]
    for head, accepted in (("accepted", True), ("MOVED", False)):
        chosen = [(one, why) for one, why in zip(found, reasons, strict=True) if (why is not None) == accepted]
        if chosen:
            print(f"\n{head}: flight, table, column, largest difference, where")
        for one, why in sorted(chosen, key=lambda pair: (pair[0].flight, pair[0].table, -pair[0].size)):
            size = f"{one.size:.3g} {one.unit}".rstrip()
            print(f"{one.flight:17} {one.table:32} {one.column:32} {size:17} {one.where}")
            if why is not None:
                print(f"{'':17} because: {why.reason}")
    for flight in sorted({one.flight for one in found if one.table.startswith("flight/")}):
        print(f"{flight}: what is flown differs (flight/...); its answers would follow it with the same estimators")
    covered = [any(move.covers(one) for one in found) for move in moves]
    for move, used in zip(moves, covered, strict=True):
        if not used and any(fnmatchcase(flight, move.flight) for flight in flights):
            print(f"unused: nothing differs that this covers: {move}")
    left = sum(why is None for why in reasons)
    print(f"\n{len(found)} columns differ in {len(flights)} flights, {left} of them without a reason")
    return int(left > 0)


def as_text(tables: dict[str, Any]) -> str:
    """JSON with a line a column, so that a difference of two stores shows which one it is of."""
    lines = []
    for table, parts in tables.items():
        inner = []
        for part, value in parts.items():
            rows = [f"   {json.dumps(k)}: {json.dumps(v)}" for k, v in value.items()] if isinstance(value, dict) else []
            inner.append(f"  {json.dumps(part)}: " + ("{\n" + ",\n".join(rows) + "}" if rows else json.dumps(value)))
        lines.append(f" {json.dumps(table)}: {{\n" + ",\n".join(inner) + "}")
    return "{\n" + ",\n".join(lines) + "\n}\n"


def store_flight(flight: str, store: Path) -> int:
    """Fly and store a flight; return the bytes of its file."""
    text = as_text({table: kept(frame) for table, frame in fly(flight).items()})
    return (store / f"{flight}.json").write_text(text)


def compare_flight(flight: str, store: Path) -> tuple[list[Difference], list[str]]:
    """Fly a flight again and compare it with its file."""
    stored = json.loads((store / f"{flight}.json").read_text())
    return compared(flight, stored, fly(flight))


def timed(work: Callable[..., Any], *arguments: Any) -> tuple[Any, float]:
    """Result of a function, and its seconds."""
    begun = time.perf_counter()
    return work(*arguments), time.perf_counter() - begun


def side_by_side(jobs: int, work: Callable[..., Any], items: Sequence[Any], *more: Any) -> Iterator[tuple[Any, Any]]:
    """Do a piece of work for each item in processes of their own; yield item and result in the order they end."""
    one_thread()
    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(jobs, mp_context=spawn) as pool:
        waiting = {pool.submit(timed, work, item, *more): item for item in items}
        for done in as_completed(waiting):
            item, (result, seconds) = waiting[done], done.result()
            print(f"{item if isinstance(item, str) else f'part {item + 1}':17} {seconds:6.1f} s", flush=True)
            yield item, result


def store(flights: Sequence[str], folder: Path, jobs: int) -> int:
    """Store flights."""
    folder.mkdir(exist_ok=True)
    for flight, size in side_by_side(jobs, store_flight, flights, folder):
        print(f"{'':17} {size / 1e3:6.0f} kB in {flight}.json")
    print(f"{sum(path.stat().st_size for path in folder.glob('*.json')) / 1e6:.2f} MB in all")
    return 0


def compare(flights: Sequence[str], folder: Path, jobs: int) -> int:
    """Compare flights with the store."""
    absent = [flight for flight in flights if not (folder / f"{flight}.json").is_file()]
    if absent:
        print(f"not stored: {', '.join(absent)}", file=sys.stderr)
        return 2
    moves, found = read_moves(folder / "moves.toml"), []
    for flight, (differing, new) in side_by_side(jobs, compare_flight, flights, folder):
        found += differing
        if new:
            print(f"{'':17} {flight} is not stored: {', '.join(new[:8])}{' ...' if len(new) > 8 else ''}")
    return verdict(found, moves, flights)


def exam_differences(stated: Rows, made: Rows, names: Sequence[str]) -> list[str]:
    """What differs between two tables of wrong inputs by case, among these cases and new ones; error sizes may."""
    out = [f"{name}: no such case any more" for name in names if name not in made]
    out += [f"{name}: not in {EXAM.name}" for name in made if name not in stated]
    for name in (name for name in names if name in made and name in stated):
        old, new = stated[name], made[name]
        out += [
            f"{name}: {column}: {new[column]!r} for {old[column]!r}" for column in OF_EXAM if new[column] != old[column]
        ]
    return out


def exam(cases: Sequence[str], jobs: int) -> int:
    """Make the table of wrong inputs again, or some cases of it, and print what differs."""
    with EXAM.open(newline="") as file:
        stated = {row["case"]: row for row in csv.DictReader(file)}
    made: Rows = {}
    for _, rows in side_by_side(jobs, exam_rows, range(jobs), jobs, list(cases)):
        made |= {row["case"]: row for row in rows}
    differing = exam_differences(stated, made, cases or list(stated))
    print("\n".join([*differing, f"{len(made)} cases, {len(differing)} differences"]))
    return int(bool(differing))


def main() -> None:
    """Run the command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["store", "compare", "exam"])
    parser.add_argument("names", nargs="*", metavar="FLIGHT", help=f"of {', '.join(FLIGHTS)}; default: all")
    parser.add_argument("--jobs", type=int, default=2, help="processes, each of which flies one at a time")
    parser.add_argument("--store", type=Path, default=STORE, help="folder of the store; default: benchmarks/golden")
    asked = parser.parse_args()
    if asked.what == "exam":
        sys.exit(exam(asked.names, asked.jobs))
    if unknown := set(asked.names) - FLIGHTS.keys():
        parser.error(f"no such flight: {', '.join(sorted(unknown))}; there are {', '.join(FLIGHTS)}")
    sys.exit((store if asked.what == "store" else compare)(asked.names or list(FLIGHTS), asked.store, asked.jobs))


if __name__ == "__main__":
    main()
