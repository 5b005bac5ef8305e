"""Do the tests notice an error in the physics or the statistics? Plants errors one at a time and runs the tests.

Each entry of mutants.toml names a package, a piece of its source that stands there exactly once, and what an error
would have written instead. An entry says nothing of the file, so that files may be renamed and merged. The tree is
copied once for every worker; in the copy the error is planted, the package's own fast tests (not slow, not long) are
run until one fails, and the source is put back. With an error in a kernel all kernels run interpreted; with one in
other code of a module that holds kernels all are compiled anew.

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
import contextlib
import hashlib
import importlib
import importlib.util
import json
import os
import re
import resource
import shutil
import signal
import subprocess
import sys
import time
import tomllib
import traceback
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from queue import SimpleQueue

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("flightmodel", "recon", "estimators", "synthetic_flight", "postflight")
FAST = "not slow and not long and not browser and not realdata"
LONGEST_S = 420  # of processor time: an error may also make a loop endless
KERNELS = {"kernel", "inlined"}  # their decorators
RECORD = "POSTFLIGHT_MUTANTS_RECORD"
MOST_NAMED = 400  # tests by name in one command line
FIRST = 10  # of the tests that run a line, so many are tried before all others: collecting takes time too
ENDLESS = -1000
PRELOADED = (
    "numpy", "scipy.interpolate", "scipy.optimize", "scipy.stats", "scipy.signal", "scipy.ndimage", "pandas", "numba",
    "pydantic", "cv2", "matplotlib.pyplot", "pytest", "hypothesis", "erfa", "filterpy.kalman",
)  # fmt: skip
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
    in_kernel: bool = False


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
                place = {"path": path.relative_to(tree), "line": line, "in_kernel": is_compiled(sources[path], line)}
                found.append(Mutant(**{**one.__dict__, **place}))
    if faults:
        sys.exit("mutants.toml:\n" + "\n".join(faults))
    return found


def is_compiled(source: str, line: int) -> bool:
    """Whether a line is of a kernel, of a part of one, or of a constant that one of its module reads."""
    body = ast.parse(source).body
    kernels = [n for n in body if isinstance(n, ast.FunctionDef) and KERNELS & set(map(ast.unparse, n.decorator_list))]
    (holder,) = (n for n in body if n.lineno <= line <= (n.end_lineno or 0))
    if isinstance(holder, (ast.FunctionDef, ast.ClassDef)):
        return holder in kernels
    stored = {n.id for n in ast.walk(holder) if isinstance(n, ast.Name) and isinstance(n.ctx, ast.Store)}
    return any(isinstance(n, ast.Name) and n.id in stored for one in kernels for n in ast.walk(one))


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
        "MPLBACKEND": "Agg",
    }
    kept = {k: v for k, v in os.environ.items() if k not in (RECORD, "NUMBA_DISABLE_JIT")}
    return kept | more | ({"NUMBA_DISABLE_JIT": "1"} if interpreted else {})


class Server:
    """A process that has imported what the tests need of others' libraries, and forks for every run of tests."""

    def __init__(self, tree: Path) -> None:
        self.tree, self.process = tree, None

    def run(self, tests: list[str], interpreted: bool, record: Path | None = None) -> tuple[str, str, float]:
        """``("passed" | "failed" | "endless" | "broken", by what, seconds)`` of tests by file or name.

        A recording, of all tests of a package, may take as long as it does.
        """
        if self.process is None or self.process.poll() is not None:
            self.process = subprocess.Popen(
                [sys.executable, __file__, "--serve"], cwd=self.tree, env=environment(self.tree, False), text=True,
                stdin=subprocess.PIPE, stdout=subprocess.PIPE,
            )  # fmt: skip
        words = self.tree.parent / f"{self.tree.name}.out"
        # short arguments: a fork, not a command line
        job = {
            "tests": tests,
            "interpreted": interpreted,
            "record": str(record or ""),
            "out": str(words),
        }
        start = time.monotonic()
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self.process.stdin.write(json.dumps(job) + "\n")
        self.process.stdin.flush()
        code = int(self.process.stdout.readline() or 3)  # nothing: the server itself was ended
        seconds = time.monotonic() - start
        if code == ENDLESS:
            return "endless", f"no end in {LONGEST_S} s of processor time", seconds
        said = words.read_text(errors="replace")
        by = re.search(r"^(?:FAILED|ERROR) (\S+)", said, re.M)
        if code in (0, 5):
            return "passed", "", seconds
        if code in (1, 2) and by:
            return "failed", by[1], seconds
        return "broken", said[-2000:], seconds


def serve() -> None:
    """Run tests on demand, each time in a child; nothing of the packages is imported before."""
    for name in PRELOADED:
        with contextlib.suppress(ImportError):
            importlib.import_module(name)
    for line in sys.stdin:
        job = json.loads(line)
        child = os.fork()
        if child == 0:
            os.setsid()
            os._exit(_run_in_child(job))
        code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        with contextlib.suppress(ProcessLookupError):
            os.killpg(child, signal.SIGKILL)  # what tests started and an error left
        print(ENDLESS if code == -signal.SIGXCPU else code, flush=True)


def _run_in_child(job: dict) -> int:
    with Path(job["out"]).open("w") as words:
        for stream in (1, 2):
            os.dup2(words.fileno(), stream)
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    if not job["record"]:
        resource.setrlimit(resource.RLIMIT_CPU, (LONGEST_S, LONGEST_S + 5))
    if job["interpreted"]:
        import numba

        numba.config.DISABLE_JIT = 1
        os.environ["NUMBA_DISABLE_JIT"] = "1"
    options = ["-q", "-m", FAST, "-p", "no:cacheprovider", "--no-header", "--tb=line"]
    if job["record"]:
        os.environ[RECORD] = job["record"]
        options += ["-p", "mutants"]
    else:
        options.append("-x")
    import pytest

    try:
        code = int(pytest.main([*options, *job["tests"]]))
    except BaseException:
        traceback.print_exc()
        code = 3
    sys.stdout.flush()
    return code


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


def recorded(server: Server, package: str) -> dict[str, dict]:
    """Tests of a package with what each called; recorded anew where package or tests changed."""
    kept = HOME / f"calls-{package}.json"
    mark = HOME / f"calls-{package}.digest"
    now = digest(server.tree, *PACKAGES, f"tests/{package}")
    if not (kept.exists() and mark.exists() and mark.read_text() == now):
        print(f"recording which tests of {package} call what ...", flush=True)
        state, by, seconds = server.run([f"tests/{package}"], False, kept)
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


def plant(server: Server, one: Mutant, calls: dict[str, dict], whole: bool) -> dict:
    path = server.tree / one.path
    text, times = path.read_text(), path.stat()
    tests = chosen(server.tree, one, calls)
    stages = [tests[:FIRST], tests[FIRST:]] if not one.tests else [tests]
    stages += [[f"tests/{one.package}"]] if whole else []
    state, by, seconds = "passed", "", 0.0
    compiled = Path(environment(server.tree, False)["NUMBA_CACHE_DIR"])
    kept = set(compiled.glob("kernels-*"))
    write(path, text.replace(one.was, one.now))
    try:
        for number, stage in enumerate(stages):
            if stage and state == "passed":
                is_last = whole and number == len(stages) - 1
                state, by, more = server.run(stage, one.in_kernel and not is_last)
                seconds += more
    finally:
        write(path, text)
        os.utime(path, ns=(times.st_atime_ns, times.st_mtime_ns))
        for folder in set(compiled.glob("kernels-*")) - kept:  # of the source with the error
            shutil.rmtree(folder)
    fate = {"passed": "survived", "failed": "killed", "endless": "killed"}.get(state, "broken")
    return {"fate": fate, "by": by, "seconds": round(seconds, 1), "tests": len(tests), "whole": whole}


def write(path: Path, text: str) -> None:
    """Write a source and forget its bytecode, which knows a file's time to the second only."""
    path.write_text(text)
    Path(importlib.util.cache_from_source(str(path))).unlink(missing_ok=True)


def check_as_it_is(server: Server, mutants: list[Mutant]) -> None:
    """The interpreted tests pass without an error planted; of the others the recording has shown it."""
    files = sorted({t for one in mutants if one.in_kernel for t in one.tests})
    for name in files:
        state, by, seconds = server.run([name], True)
        print(f"  as it is, interpreted: {name} {state} {seconds:.0f} s", flush=True)
        if state != "passed":
            sys.exit(f"{name} does not pass with interpreted kernels: {state} {by}")


def key_of(one: Mutant) -> str:
    words = json.dumps([one.package, one.was, one.now, one.tests])
    return hashlib.sha256(words.encode()).hexdigest()[:24]


def marks_of(tree: Path, one: Mutant, result: dict) -> str:
    """What a result rests on: all source and, of a killed one, the test that noticed it; else the package's tests."""
    by = tree / result["by"].split("::")[0]
    if result["fate"] == "killed" and by.is_file():
        return digest(tree, *PACKAGES) + hashlib.sha256(by.read_bytes()).hexdigest()[:16]
    return digest(tree, *PACKAGES, f"tests/{one.package}")


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
    parser.add_argument("--named", action="store_true", help="only entries that name their tests: nothing is recorded")
    parser.add_argument("--list", action="store_true", help="where each entry is; runs nothing")
    options = parser.parse_args()
    mutants = [
        one
        for one in read_entries(ROOT)
        if one.package in (options.package or PACKAGES)
        and options.only in f"{one.error} {one.was} {one.path}"
        and (one.tests or not options.named)
        and options.kernels in ("with", "only" if one.in_kernel else "without")
    ]
    if options.list:
        for one in mutants:
            print(f"{one.package:17s} {str(one.path) + ':' + str(one.line):52s} {one.error}")
        print(f"{len(mutants)} entries")
        return 0
    HOME.mkdir(parents=True, exist_ok=True)
    free: SimpleQueue[Server] = SimpleQueue()
    servers = [Server(HOME / f"tree-{number}") for number in range(options.workers)]
    for server in servers:
        copy_tree(server.tree)
        free.put(server)
    first = HOME / "tree-0"
    keys = {one: key_of(one) for one in mutants}
    kept_path = HOME / "results.json"
    kept = json.loads(kept_path.read_text()) if kept_path.exists() and not options.anew else {}
    if options.survivors:
        mutants = [one for one in mutants if kept.get(keys[one], {}).get("fate") != "killed"]
    to_run = [one for one in mutants if is_open(first, one, kept.get(keys[one]), options.whole)]
    calls = {p: recorded(servers[0], p) for p in dict.fromkeys(one.package for one in to_run if not one.tests)}
    check_as_it_is(servers[0], to_run)

    def run(one: Mutant) -> None:
        server = free.get()
        try:
            result = plant(server, one, calls.get(one.package, {}), options.whole)
        finally:
            free.put(server)
        kept[keys[one]] = result | {"marks": marks_of(first, one, result)}
        kept_path.write_text(json.dumps(kept, indent=1))
        print(row(one, result), flush=True)

    with ThreadPoolExecutor(options.workers) as pool:
        list(pool.map(run, to_run))
    return table(mutants, {one: kept[keys[one]] for one in mutants})


def is_open(tree: Path, one: Mutant, result: dict | None, whole: bool) -> bool:
    """Whether an entry has to be run: never was, source or tests changed since, or more tests are asked for."""
    if result is None or result["fate"] == "broken" or result["marks"] != marks_of(tree, one, result):
        return True
    return whole and result["fate"] == "survived" and not result["whole"]


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
    sys.exit(serve() if "--serve" in sys.argv else main())
