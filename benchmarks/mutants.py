"""Do the tests notice an error in the physics or the statistics? Plants errors one at a time and runs the tests.

Each entry of mutants.toml names a package, a piece of its source that stands there exactly once, and what an error
would have written instead. An entry says nothing of the file, so that files may be renamed and merged. The tree is
copied once for every worker; in the copy the error is planted, the package's own fast tests (not slow, not long) are
run until one fails, and the source is put back. Compiled kernels (``*_kernels.py``) run interpreted.

Which tests run first: those that called the function that holds the error, as one recorded run of the package's fast
tests found, the quick ones first. Calls of compiled kernels cannot be recorded, so entries in kernels name their test
files. With ``--whole`` the package's remaining fast tests have their turn too before an error counts as survived.

    python benchmarks/mutants.py                    # all, two workers
    python benchmarks/mutants.py --package recon    # of one package
    python benchmarks/mutants.py --only whiteness   # entries whose words contain this
    python benchmarks/mutants.py --list             # where every entry is, without running

Results are kept beside the copies and asked for again only where source, tests or entry changed (``--anew``: all).
Exit code 1 if an error survives that mutants.toml does not explain, or if an explained one is killed.
"""

from __future__ import annotations

import argparse
import ast
import hashlib
import json
import os
import re
import shutil
import subprocess
import sys
import time
import tomllib
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from queue import SimpleQueue

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("flightmodel", "recon", "estimators", "synthetic_flight", "postflight")
FAST = "not slow and not long and not browser and not realdata"
LONGEST_S = 420.0  # an error may also make a loop endless
RECORD = "POSTFLIGHT_MUTANTS_RECORD"
MOST_NAMED = 400  # tests by name in one command line
HOME = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "postflight" / "mutants"


@dataclass(frozen=True)
class Mutant:
    package: str
    error: str
    was: str
    now: str
    tests: tuple[str, ...] = ()
    explained: str = ""
    path: Path = Path()
    line: int = 0

    @property
    def in_kernel(self) -> bool:
        return self.path.name.endswith("_kernels.py")


# ---- entries -------------------------------------------------------------------------------------------------------


def read_entries(tree: Path) -> list[Mutant]:
    """Entries with the place of each; ends with a message if one stands nowhere or in several places."""
    spec = tomllib.loads((Path(__file__).parent / "mutants.toml").read_text())
    faults, found, seen = [], [], set()
    for package in PACKAGES:
        sources = {p: p.read_text() for p in sorted((tree / package).rglob("*.py"))}
        for entry in spec.get(package, []):
            one = Mutant(package, **{k: tuple(v) if k == "tests" else v for k, v in entry.items()})
            places = [(p, text.index(one.was)) for p, text in sources.items() for _ in range(text.count(one.was))]
            if len(places) != 1:
                faults.append(f"{package}: {one.error}: stands {len(places)} times: {one.was!r}")
            elif one.was == one.now or (package, one.was, one.now) in seen:
                faults.append(f"{package}: {one.error}: no error, or the same twice")
            else:
                path, start = places[0]
                seen.add((package, one.was, one.now))
                try:
                    ast.parse(sources[path].replace(one.was, one.now))
                except SyntaxError as wrong:
                    faults.append(f"{package}: {one.error}: does not parse: {wrong}")
                line = sources[path].count("\n", 0, start) + 1
                found.append(Mutant(**{**one.__dict__, "path": path.relative_to(tree), "line": line}))
    if faults:
        sys.exit("mutants.toml:\n" + "\n".join(faults))
    return found


def callers_keys(tree: Path, one: Mutant) -> set[str]:
    """Keys (file:line of its ``def``) of the function that holds the error; of a constant, of all that use it."""
    body = ast.parse((tree / one.path).read_text())
    holders = [
        node
        for node in ast.walk(body)
        if isinstance(node, (ast.FunctionDef, ast.ClassDef)) and node.lineno <= one.line <= (node.end_lineno or 0)
    ]
    functions = [node for node in holders if isinstance(node, ast.FunctionDef)]
    if functions:
        inner = functions[-1]
        first = min([inner.lineno, *(d.lineno for d in inner.decorator_list)])
        # a function compiled into a kernel is never called as such; a closure has its parent for a stand-in
        return {f"{one.path}:{first}"}
    names = {node.name for node in holders}
    for node in body.body:
        if isinstance(node, (ast.Assign, ast.AnnAssign)) and node.lineno <= one.line <= (node.end_lineno or 0):
            names |= {n.id for n in ast.walk(node) if isinstance(n, ast.Name) and isinstance(n.ctx, ast.Store)}
    keys = set()
    for path in (p for package in PACKAGES for p in (tree / package).rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.FunctionDef):
                used = {n.id for n in ast.walk(node) if isinstance(n, ast.Name)}
                used |= {n.attr for n in ast.walk(node) if isinstance(n, ast.Attribute)}
                if used & names:
                    first = min([node.lineno, *(d.lineno for d in node.decorator_list)])
                    keys.add(f"{path.relative_to(tree)}:{first}")
    return keys


# ---- copies of the tree --------------------------------------------------------------------------------------------


def copy_tree(to: Path) -> None:
    """Bring a copy up to date with the checkout; untouched files keep their times, so compiled kernels are kept."""
    command = ["git", "ls-files", "--cached", "--others", "--exclude-standard"]
    listed = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout.split("\n")
    wanted = {name for name in listed if name and (ROOT / name).is_file()}
    for name in sorted(wanted):
        source, target = ROOT / name, to / name
        if not target.exists() or target.read_bytes() != source.read_bytes():
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(source, target)
    for path in sorted(to.rglob("*")):
        if path.is_file() and path.suffix == ".py" and str(path.relative_to(to)) not in wanted:
            path.unlink()
    if not (to / ".git").exists():
        subprocess.run(["git", "init", "-q"], cwd=to, check=True)  # some tests ask for the checkout they are in


def digest(tree: Path, *folders: str) -> str:
    out = hashlib.sha256(sys.version.encode())
    for folder in folders:
        for path in sorted((tree / folder).rglob("*.py")):
            out.update(str(path.relative_to(tree)).encode() + path.read_bytes())
    return out.hexdigest()[:16]


def environment(tree: Path, interpreted: bool) -> dict[str, str]:
    more = {
        "PYTHONPATH": os.pathsep.join([str(tree), str(Path(__file__).parent)]),
        "NUMBA_CACHE_DIR": str(tree.parent / f"{tree.name}-numba"),
        "OMP_NUM_THREADS": "1",
        "OPENBLAS_NUM_THREADS": "1",
        "PYTHONDONTWRITEBYTECODE": "1",  # a planted error and its undoing may fall in one second of a file's time
        "MPLBACKEND": "Agg",
    }
    kept = {k: v for k, v in os.environ.items() if k not in (RECORD, "NUMBA_DISABLE_JIT")}
    return kept | more | ({"NUMBA_DISABLE_JIT": "1"} if interpreted else {})


def run_tests(tree: Path, tests: list[str], interpreted: bool, record: Path | None = None) -> tuple[str, str, float]:
    """``("passed" | "failed" | "endless" | "broken", by what, seconds)`` of tests by file or name."""
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-m", FAST, "-p", "no:cacheprovider", "--no-header", *tests]
    of = environment(tree, interpreted)
    if record is not None:
        command = [c for c in command if c != "-x"] + ["-p", "mutants"]
        of[RECORD] = str(record)
    start = time.monotonic()
    try:
        done = subprocess.run(
            command, cwd=tree, env=of, capture_output=True, text=True, timeout=None if record else LONGEST_S
        )
    except subprocess.TimeoutExpired:
        return "endless", f"no end in {LONGEST_S:.0f} s", LONGEST_S
    seconds = time.monotonic() - start
    by = re.search(r"^(?:FAILED|ERROR) (\S+)", done.stdout, re.M)
    if done.returncode in (0, 5):
        return "passed", "", seconds
    if done.returncode in (1, 2) and by:
        return "failed", by[1], seconds
    return "broken", (done.stdout + done.stderr)[-2000:], seconds


# ---- which test calls what: hooks of a recorded run (pytest -p mutants) ---------------------------------------------

_calls: dict[str, set[str]] = {}
_fixtures: dict[str, set[str]] = {}
_seconds: dict[str, float] = {}
_open: list[set[str]] = []


def _profile(frame, event, _arg):
    if event == "call" and _open:
        code = frame.f_code
        _open[-1].add((code.co_filename, code.co_firstlineno))


def pytest_configure():
    if os.environ.get(RECORD):
        sys.setprofile(_profile)


def pytest_fixture_setup(fixturedef, request):
    if not os.environ.get(RECORD):
        return None
    from _pytest.fixtures import pytest_fixture_setup as usual

    mine = _fixtures.setdefault(f"{fixturedef.baseid}::{fixturedef.argname}", set())
    _open.append(mine)
    try:
        return usual(fixturedef, request)
    finally:
        _open.pop()


def pytest_runtest_logreport(report):
    _seconds[report.nodeid] = _seconds.get(report.nodeid, 0.0) + report.duration


def pytest_runtest_setup(item):
    _open.append(_calls.setdefault(item.nodeid, set()))
    sys.setprofile(_profile if os.environ.get(RECORD) else None)


def pytest_runtest_teardown(item):
    _open.clear()
    for name, defined in getattr(item, "_fixtureinfo").name2fixturedefs.items():  # noqa: B009
        for one in defined:
            _calls[item.nodeid] |= _fixtures.get(f"{one.baseid}::{name}", set())


def pytest_sessionfinish(session):
    sys.setprofile(None)
    target = os.environ.get(RECORD)
    if target:
        root = str(session.config.rootpath) + os.sep
        tests = {
            name: {
                "seconds": _seconds.get(name, 0.0),
                "calls": sorted(
                    f"{file[len(root) :]}:{line}"
                    for file, line in calls
                    if file.startswith(root) and file[len(root) :].split(os.sep)[0] in PACKAGES
                ),
            }
            for name, calls in _calls.items()
        }
        Path(target).write_text(json.dumps(tests))


def recorded(tree: Path, package: str) -> dict[str, dict]:
    """Tests of a package with what each called; recorded anew where package or tests changed."""
    kept = HOME / f"calls-{package}.json"
    mark = HOME / f"calls-{package}.digest"
    now = digest(tree, *PACKAGES, f"tests/{package}")
    if not (kept.exists() and mark.exists() and mark.read_text() == now):
        print(f"recording which tests of {package} call what ...", flush=True)
        state, by, seconds = run_tests(tree, [f"tests/{package}"], False, kept)
        if state != "passed":
            sys.exit(f"{package}: its own tests do not pass as they are: {state} {by}")
        mark.write_text(now)
        print(f"  {seconds:.0f} s")
    return json.loads(kept.read_text())


# ---- one error -----------------------------------------------------------------------------------------------------


def chosen(tree: Path, one: Mutant, calls: dict[str, dict]) -> list[str]:
    """Tests that run the line, quickest first."""
    if one.tests:
        return list(one.tests)
    keys = callers_keys(tree, one)
    mine = [name for name, test in calls.items() if keys & set(test["calls"])]
    return sorted(mine, key=lambda name: calls[name]["seconds"])[:MOST_NAMED]


def plant(tree: Path, one: Mutant, calls: dict[str, dict], whole: bool) -> dict:
    path = tree / one.path
    text, times = path.read_text(), path.stat()
    tests = chosen(tree, one, calls)
    path.write_text(text.replace(one.was, one.now))
    try:
        state, by, seconds = run_tests(tree, tests, one.in_kernel) if tests else ("passed", "", 0.0)
        if state == "passed" and whole:
            state, by, more = run_tests(tree, [f"tests/{one.package}"], False)
            seconds += more
    finally:
        path.write_text(text)
        os.utime(path, ns=(times.st_atime_ns, times.st_mtime_ns))
    fate = {"passed": "survived", "failed": "killed", "endless": "killed"}.get(state, "broken")
    return {"fate": fate, "by": by, "seconds": round(seconds, 1), "tests": len(tests), "whole": whole}


def check_as_it_is(tree: Path, mutants: list[Mutant]) -> None:
    """The interpreted tests pass without an error planted; of the others the recording has shown it."""
    files = sorted({t for one in mutants if one.in_kernel for t in one.tests})
    for name in files:
        state, by, seconds = run_tests(tree, [name], True)
        print(f"  as it is, interpreted: {name} {state} {seconds:.0f} s", flush=True)
        if state != "passed":
            sys.exit(f"{name} does not pass with interpreted kernels: {state} {by}")


def key_of(tree: Path, one: Mutant) -> str:
    marks = digest(tree, *PACKAGES, f"tests/{one.package}")
    words = json.dumps([one.package, one.was, one.now, one.tests, marks])
    return hashlib.sha256(words.encode()).hexdigest()[:24]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("--package", choices=PACKAGES, action="append")
    parser.add_argument("--only", default="", help="entries whose words or source contain this")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument(
        "--whole", action="store_true", help="all fast tests of the package before it counts as survived"
    )
    parser.add_argument("--anew", action="store_true", help="forget kept results")
    parser.add_argument("--survivors", action="store_true", help="only those that survived when last run")
    parser.add_argument("--kernels", choices=("with", "without", "only"), default="with")
    parser.add_argument("--list", action="store_true", help="where each entry is; runs nothing")
    options = parser.parse_args()
    mutants = [
        one
        for one in read_entries(ROOT)
        if one.package in (options.package or PACKAGES)
        and options.only in f"{one.error} {one.was} {one.path}"
        and options.kernels in ("with", "only" if one.in_kernel else "without")
    ]
    if options.list:
        for one in mutants:
            print(f"{one.package:17s} {str(one.path) + ':' + str(one.line):52s} {one.error}")
        print(f"{len(mutants)} entries")
        return 0
    HOME.mkdir(parents=True, exist_ok=True)
    trees: SimpleQueue[Path] = SimpleQueue()
    for number in range(options.workers):
        copy_tree(HOME / f"tree-{number}")
        trees.put(HOME / f"tree-{number}")
    first = HOME / "tree-0"
    keys = {one: key_of(first, one) for one in mutants}
    kept_path, last_path = HOME / "results.json", HOME / "last.json"
    kept = json.loads(kept_path.read_text()) if kept_path.exists() and not options.anew else {}
    last = json.loads(last_path.read_text()) if last_path.exists() else {}
    if options.survivors:
        mutants = [one for one in mutants if last.get(one.was + one.now) != "killed"]
    to_run = [one for one in mutants if keys[one] not in kept or (options.whole and is_open(kept[keys[one]]))]
    calls = {p: recorded(first, p) for p in dict.fromkeys(one.package for one in to_run if not one.tests)}
    check_as_it_is(first, to_run)

    def run(one: Mutant) -> None:
        tree = trees.get()
        try:
            kept[keys[one]] = plant(tree, one, calls.get(one.package, {}), options.whole)
        finally:
            trees.put(tree)
        last[one.was + one.now] = kept[keys[one]]["fate"]
        kept_path.write_text(json.dumps(kept, indent=1))
        last_path.write_text(json.dumps(last, indent=1))
        print(row(one, kept[keys[one]]), flush=True)

    with ThreadPoolExecutor(options.workers) as pool:
        list(pool.map(run, to_run))
    return table(mutants, {one: kept[keys[one]] for one in mutants})


def is_open(result: dict) -> bool:
    return result["fate"] == "survived" and not result["whole"]


def row(one: Mutant, result: dict) -> str:
    by = result["by"].removeprefix(f"tests/{one.package}/") if result["fate"] != "broken" else result["by"][-300:]
    return f"{one.package:17s} {result['fate']:9s} {result['seconds']:6.1f} s  {one.error:62s} {by}"


def table(mutants: list[Mutant], results: dict[Mutant, dict]) -> int:
    print("\n" + "\n".join(row(one, results[one]) for one in mutants) + "\n")
    wrong = 0
    for package in PACKAGES:
        mine = [one for one in mutants if one.package == package]
        if mine:
            killed = sum(results[one]["fate"] == "killed" for one in mine)
            print(f"{package:17s} {killed:3d} of {len(mine):3d} killed, {100.0 * killed / len(mine):.0f} %")
    killed = sum(result["fate"] == "killed" for result in results.values())
    if mutants:
        print(f"{'all':17s} {killed:3d} of {len(mutants):3d} killed, {100.0 * killed / len(mutants):.1f} %")
    for one in mutants:
        fate = results[one]["fate"]
        if fate != "killed":
            wrong += not one.explained
            print(f"{fate}: {one.package}: {one.error} ({one.path}:{one.line})\n    {one.explained or 'NOT EXPLAINED'}")
        elif one.explained:
            wrong += 1
            print(f"killed, but explained as a survivor: {one.package}: {one.error}")
    return int(wrong > 0)


if __name__ == "__main__":
    sys.exit(main())
