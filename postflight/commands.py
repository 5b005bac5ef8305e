"""What each command does, with progress while it works and a table at its end."""

from __future__ import annotations

import json
import re
import sys
import time
import tomllib
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass, field, replace
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from rich.markup import escape
from rich.table import Table

from flightmodel.camera import Lens
from flightmodel.checks import NO_FAULT, Check, ConfigError, DivergenceError, FloatArray, GateError, Issue, Progress
from flightmodel.config import parse_section
from flightmodel.flightfolder import read_flight_file
from flightmodel.instruments import LoadsEntry
from flightmodel.statistics import decimals, pair
from flightmodel.vehicle import read_vehicle
from postflight import run_folder, warmup
from postflight.beside import Beside, Task, same
from postflight.deflections import METHODS, Deflections, camera_sensitivity, estimate, said, with_increments
from postflight.flight import Flight, flight_of_table, read_flight
from postflight.methods import BY_LOADS, NO_VIDEO, Inputs
from postflight.plots.style import FigureFolder
from postflight.reconstruction import Reconstruction, reconstruct
from postflight.report.text import rests_on
from postflight.report.write import write_deflection_report, write_report
from postflight.runs import check_name, find_run
from postflight.scoring import PUBLISHED_DEG, Limits, Score, score_run
from postflight.sensitivity import largest_of_groups, sensitivity
from postflight.streams import write_out
from postflight.studies.preflight import Bounds, entry_bounds
from postflight.terminal import EXIT_CHECK_FAILED, EXIT_NO_ANSWER, few_of_each, progress_bar, terminal
from synthetic_flight.folder import Event, check_destination, flight_events, simulate_to_folder
from synthetic_flight.scenarios import read_scenario, shipped_scenarios
from synthetic_flight.simulate import Truth

if TYPE_CHECKING:
    from estimators.camera import FilmFit
    from estimators.fusing import CameraTimeBias
    from postflight.filming import CameraAnswer

SHORT = {
    "position": "pos.", "velocity": "vel.", "attitude": "att.", "total angle of attack": "alpha",
    "dynamic pressure": "q", "density of the day": "rho", "C_A": "C_A",
}  # fmt: skip
LARGEST_NORMAL = 3.5  # standard deviations that one of some dozens of changes may be off
REFERENCE = "irve2_reference"
FIGURES = "postflight.plots.run_figures"
console = terminal()
console_err = terminal(stderr=True)


def compile_kernels(*groups: str) -> None:
    """Compile kernels before first use, and print that."""
    _say_once(warmup.CACHE.remark)
    if not (wanted := warmup.missing(groups)):
        return
    console_err.print(f"compiling kernels for this machine, once (one to two minutes): {', '.join(wanted)}")
    with progress_bar() as report:
        failed = warmup.prepare(wanted, report)
    for group, reason in failed.items():
        words = f"kernels of {group} were not compiled beforehand, but will be at their first use: {reason}"
        console_err.print(escape(words))


@cache
def _say_once(words: str) -> None:
    if words:
        console_err.print(f"[yellow]found[/] {escape(f'{words} [no-cache]')}")


def warm_up() -> None:
    """Compile every group of kernels that is missing, and say where they lie."""
    if warmup.CACHE.remark:
        raise GateError(warmup.CACHE.remark, "cannot-write")
    compile_kernels(*warmup.GROUPS)
    console.print(f"kernels are compiled: {escape(str(warmup.CACHE.path))}")


def scenario_and_folder(arguments: tuple[str, ...]) -> tuple[str, Path]:
    """Tell scenario and folder apart where only one is given: a .toml file or a shipped name is a scenario."""
    if len(arguments) == 2:
        return arguments[0], Path(arguments[1])
    if arguments and (arguments[0].endswith(".toml") or arguments[0] in shipped_scenarios()):
        return arguments[0], Path(f"{Path(arguments[0]).stem}-flight")
    return REFERENCE, Path(arguments[0] if arguments else f"{REFERENCE}-flight")


def simulate(scenario: str, folder: Path, seed: int, force: bool) -> None:
    """Fly and write a flight folder."""
    chosen = read_scenario(scenario)
    compile_kernels("simulator")
    with progress_bar() as report:
        truth = simulate_to_folder(chosen, seed, folder, report, replace=force)
    print_truth(truth, folder)
    print_events(flight_events(truth, chosen.spec.time.inflated_s))
    if truth.remark:
        console.print(f"[yellow]{escape(truth.remark)}[/]")


def print_truth(truth: Truth, folder: Path) -> None:
    """Print what the flight was, without its deflection."""
    k = int(np.argmax(truth.dynamic_pressure_pa))
    table = Table(title=f"Synthetic flight in {escape(str(folder))}")
    for name in ("apogee km", "peak q Pa", "at s", "altitude km", "Mach", "ended at s"):
        table.add_column(name, justify="right")
    table.add_row(
        f"{truth.altitude_m.max() / 1e3:.1f}",
        f"{truth.dynamic_pressure_pa[k]:.0f}",
        f"{truth.time_s[k]:.2f}",
        f"{truth.altitude_m[k] / 1e3:.1f}",
        f"{truth.mach[k]:.2f}",
        f"{truth.time_s[-1]:.1f}",
    )
    console.print(table)


def print_events(flown: list[Event]) -> None:
    """Print the moments of a synthetic flight, without the angles that estimators look for (truth/events.csv)."""
    table = Table(title="Events")
    for name in ("event", "t s", "alt km", "m/s", "Mach", "q Pa", "W/cm2", "g"):
        table.add_column(name, justify="left" if name == "event" else "right")
    for e in flown:
        table.add_row(
            e.name.replace("dynamic pressure", "q"),
            f"{e.time_s:.2f}",
            f"{e.altitude_m / 1e3:.2f}",
            f"{e.speed_mps:.1f}",
            f"{e.mach:.2f}",
            f"{e.dynamic_pressure_pa:.1f}",
            f"{e.heat_flux_wpm2 / 1e4:.2f}",
            f"{e.sensed_g:.2f}",
        )
    console.print(table)


class Stages:
    """Names and durations, s, of a command's stages, from its start on."""

    def __init__(self, begun: float | None = None) -> None:
        """Count from a moment of `time.perf_counter`, or from now; the time before is loading the program."""
        self._last = time.perf_counter()
        self.seconds = {"loading the program": 0.0 if begun is None else self._last - begun}

    def end(self, name: str) -> None:
        """End a stage."""
        now = time.perf_counter()
        self.seconds[name], self._last = now - self._last, now


def print_stages(stages: Stages) -> None:
    """Print each stage with its seconds."""
    table = Table(title="Time by stage")
    table.add_column("stage")
    table.add_column("s", justify="right")
    for name, seconds in (*stages.seconds.items(), ("in all", sum(stages.seconds.values()))):
        table.add_row(name, f"{seconds:.2f}")
    console.print(table)


def run(
    folder: Path, methods: tuple[str, ...], wanted: Asked, reruns: bool = False, stages: Stages | None = None,
    formats: tuple[str, ...] = (), strict: bool = False,
) -> None:  # fmt: skip
    """Reconstruct, estimate the deflection, write a run folder and print the results; exit 4 if no method answers.

    The answers are printed before tables, figures and report are written. With ``strict`` a failed consistency check
    makes the exit code 5, after everything is written.
    """

    def show_answers(bet: Reconstruction, answers: Deflections, events: pd.DataFrame) -> None:
        print_flight(bet, events)
        if methods:
            print_answers(answers)

    if methods and read_flight_file(folder).loads is not None:  # whose trajectory another team made
        deflection(folder, (), wanted, formats=formats, strict=strict)
        return
    _, answers, written = run_flight(folder, methods, wanted, reruns, show_answers, stages, formats)
    print_increments(answers)
    if (written / "sensitivity.csv").is_file():
        print_sensitivity(run_folder.read_csv(written / "sensitivity.csv"))
    console.print(f"results in {escape(str(written))}, to read in report.html")
    if any(reason.code != NO_VIDEO for reason in answers.refused.values()):
        sys.exit(EXIT_NO_ANSWER)
    if strict and answers.doubt:
        console.coded("[red]failed[/]", f"--strict: {answers.doubt}", "answers-in-doubt")
        sys.exit(EXIT_CHECK_FAILED)


class _Figures:
    """Figures of a run, drawn in a worker process; ``bet`` is the task that holds its trajectory."""

    bet: Task[Reconstruction]

    def __init__(self, beside: Beside, folder: Path, formats: tuple[str, ...]) -> None:
        self._beside, self._folder = beside, FigureFolder(folder, ("png", *formats))
        self._parts: list[Task[None]] = []

    def draw(self, part: str, *arguments: Any) -> None:
        """Submit a function draw_... of `postflight.plots.run_figures`."""
        self._parts.append(self._beside.submit(f"{FIGURES}:draw_{part}", self.bet, self._folder, *arguments))

    def wait(self) -> None:
        """Wait until all are drawn; OSError where a file cannot be written."""
        for part in self._parts:
            part.result()


def run_flight(
    folder: Path, methods: tuple[str, ...], asked_for: Asked, reruns: bool = False,
    show_answers: Callable[[Reconstruction, Deflections, pd.DataFrame], None] = lambda *_: None,
    stages: Stages | None = None, formats: tuple[str, ...] = (),
) -> tuple[Reconstruction, Deflections, Path]:  # fmt: skip
    """Run the chain on one flight folder and write its run folder; ``reruns`` asks for the sensitivity too.

    Figures are drawn as PNG, and in other ``formats``.

    ``show_answers`` is called with trajectory, deflections and events before tables and report are written. The film is
    read and figures are drawn beside it as soon as their numbers are there.
    """
    log: list[str] = []
    stages = stages or Stages()

    def steps(report: Progress) -> Callable[[float, float], Progress]:
        def step(low: float, high: float) -> Progress:
            def show(fraction: float, what: str) -> None:
                if not log or log[-1] != what:
                    log.append(what)
                report(low + (high - low) * fraction, what)

            return show

        return step

    with Beside() as beside:
        beside.submit(import_module, "postflight.filming" if "camera" in methods else FIGURES)  # it starts meanwhile
        with progress_bar() as report:
            flight = asked_for.of(read_flight(folder, steps(report)(0.0, 0.05)))
        stages.end("reading telemetry")
        settings = {"methods": list(methods), "output_rate_hz": flight.settings.output_rate_hz, "sensitivity": reruns}
        if flight.changes:
            settings["changes"] = list(flight.changes)
        new = run_folder.RunFolder(folder, flight.telemetry, settings, asked_for.name, flight.as_read)
        with new as out, closing(beside):
            with progress_bar() as report:
                figures = _Figures(beside, out.path / "figures", formats)
                bet, answers = _answered(flight, methods, figures, steps(report), stages, beside)
            event_rows = run_folder.event_table(bet, bet.table)
            show_answers(bet, answers, event_rows)
            stages.end("printing the answers")
            figures.draw("deflections", replace(answers, bet=None))  # not sooner: to hand them over takes a moment
            with progress_bar() as report:
                step = steps(report)
                step(0.0, 0.1)(0.0, "writing tables")
                run_folder.write_reconstruction(out, bet, answers)
                run_folder.write_answers(out, answers)
                out.keep(run_folder.summary(bet, answers, event_rows))
                stages.end("tables")
                with out.part("aerodynamic increments"):
                    answers = with_increments(answers)
                    run_folder.write_increments(out, answers)
                    run_folder.write_all_checks(out, bet, answers)
                stages.end("aerodynamic increments")
                bounds, reran = _write_rest(out, bet, answers, reruns, step)
                figures.draw("studies", bounds, reran, answers.increments)
                stages.end("bounds of the rigid vehicle")
                step(0.9, 1.0)(0.0, "drawing, and writing the report")
                lines = "".join(json.dumps({"step": k, "what": what}) + "\n" for k, what in enumerate(log))
                (out.path / "log.jsonl").write_text(lines)
                out.keep(run_folder.summary(bet, answers, event_rows))
                with out.part("report"):
                    write_report(folder, out.path, flight)
                stages.end("report")
                figures.wait()
                stages.end("figures that were not drawn meanwhile")
    for reason in out.left_out:
        console.coded("[yellow]left out[/]", reason, reason.code)
    return bet, answers, out.path


def _answered(
    flight: Flight, methods: tuple[str, ...], figures: _Figures, step: Callable[[float, float], Progress],
    stages: Stages, beside: Beside,
) -> tuple[Reconstruction, Deflections]:  # fmt: skip
    """Trajectory, handed to the figures, and deflections; a camera without video is among the refused methods."""
    own = warmup.ESTIMATES if "camera" in methods else warmup.ESTIMATES[:1]
    compile_kernels(*warmup.RECONSTRUCTION, "simulator", "ensembles", *own)
    stages.end("compiling")
    film: Task[FilmFit] | None = None
    if "camera" in methods and len(flight.telemetry.films) == 1:
        film = beside.keep("postflight.filming:camera_film", flight)
    beside.submit(import_module, FIGURES)
    bet = reconstruct(flight, None, step(0.05, 0.7))
    stages.end("trajectory")
    figures.bet = there = beside.keep(same, bet)
    camera: Task[CameraAnswer] | None = None
    time_bias: Task[CameraTimeBias | None] | None = None
    if film is not None:
        camera = beside.submit("postflight.filming:camera_answer", there, film)
        if "fused" in methods:
            time_bias = beside.submit("postflight.filming:time_bias_of", there, camera)
    figures.draw("trajectory")  # which comes after the camera
    _ = bet.table  # while the camera has no answer yet
    answers = estimate(bet, methods, step(0.7, 1.0), camera, time_bias)
    stages.end("deflections")
    return bet, answers


def _write_rest(
    out: run_folder.RunFolder, bet: Reconstruction, answers: Deflections, reruns: bool,
    step: Callable[[float, float], Progress],
) -> tuple[Bounds | None, pd.DataFrame | None]:  # fmt: skip
    """Write results that follow the answers; return the rigid vehicle's bounds and the sensitivity, for the figures."""
    bounds, table = None, None
    if "camera" in answers.histories:
        with out.part("camera sensitivity"):
            out.write_csv("camera_sensitivity.csv", camera_sensitivity(bet.flight, answers.histories["camera"]))
    if bet.loads is not None:
        with out.part("bounds of the rigid vehicle"):
            bounds = entry_bounds(bet, None, progress=step(0.1, 0.2 if reruns else 0.9))
            out.write_csv("rigid_bounds.csv", bounds.table())
    if reruns:
        with out.part("sensitivity"):
            table = sensitivity(bet, step(0.2, 0.9))
            out.write_csv("sensitivity.csv", table)
    return bounds, table


@dataclass(frozen=True)
class Asked:
    """Options of a command line: changed assumptions and settings, sources left out, output rate, name."""

    changes: dict[str, Any] = field(default_factory=dict)
    without: tuple[str, ...] = ()
    rate_hz: float | None = None
    name: str = ""

    def of(self, flight: Flight) -> Flight:
        """Return the flight with the options applied; sources are left out beside those that flight.toml leaves out.

        Raises
        ------
        ConfigError
            Assumptions that cannot be, sources that the flight does not have.
        """
        if self.rate_hz is not None:  # how densely it is written is no assumption
            flight = replace(flight, settings=replace(flight.settings, output_rate_hz=self.rate_hz))
        flight = flight.with_(**self.changes)
        return flight.with_(without=(*flight.settings.without, *self.without)) if self.without else flight


def asked(
    settings: tuple[str, ...], without: tuple[str, ...], rate_hz: float | None, run_name: str | None = None
) -> Asked:
    """Read ``--set NAME=VALUE`` (the value as TOML writes it) and the other options; every fault at once."""
    changes: dict[str, Any] = {}
    faults: list[Issue] = []
    if run_name is not None:
        try:
            check_name(run_name)
        except ConfigError as fault:
            faults += fault.faults
    for text in settings:
        name, equals, value = (part.strip() for part in text.partition("="))
        if not (equals and name):
            faults.append(Issue(f"--set {text}: NAME=VALUE is wanted, e.g. --set c_n=1.1", "option-format"))
        elif name in changes:
            faults.append(Issue(f"--set {text}: {name} is set twice; give it once", "given-twice"))
        else:
            changes[name] = _toml_value(value)
    if faults:
        raise ConfigError(faults)
    return Asked(changes, without, rate_hz, run_name or "")


def _toml_value(text: str) -> Any:
    """Value in TOML's notation; ``none`` is None, and anything that is not TOML is a string."""
    if text.lower() == "none":
        return None
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text


def print_flight(flight: Reconstruction, events: pd.DataFrame) -> None:
    """Events, verdicts and findings."""
    if flight.flight.changes:
        console.print(f"[yellow]what-if[/] {escape('; '.join(flight.flight.changes))}")
    table = Table(title=f"Best-estimated trajectory of {escape(flight.telemetry.name)}")
    for name in ("event", "t s", "altitude km", "Mach", "q Pa", "alpha total deg"):
        table.add_column(name, justify="left" if name == "event" else "right")
    for row in events.itertuples(index=False):
        alpha = pair(row.alpha_total_wind_deg, row.alpha_total_wind_3sd_deg / 3.0) if flight.has_attitude else ""
        pressure = f"{row.dynamic_pressure_pa:.1f}"
        table.add_row(row.event, f"{row.t_s:.2f}", f"{row.alt_m / 1e3:.2f}", f"{row.mach:.2f}", pressure, alpha)
    console.print(table)
    if flight.peak_lies:
        words = f"the largest dynamic pressure is no peak: {flight.peak_lies}"
        console.coded("[yellow]found[/]", words, "peak-outside-data")
    for words, code in few_of_each((*flight.findings, *run_folder.without_attitude(flight))):
        console.coded("[yellow]found[/]", words, code)
    for reason in () if flight.density is not None else flight.missing:  # that is as flown, too
        console.coded("[yellow]left out[/]", f"as-flown atmosphere: {reason}", reason.code)
    if flight.attitude is not None and flight.attitude.comparison is not None:
        console.print(escape(flight.attitude.remark))
    console.table("What the absolute values depend on", ("value", "on"), rests_on(flight.rests_on), ("on",))
    print_checks(flight.consistency_checks, "trajectory")
    for k, suspect in enumerate(flight.suspects):
        console.coded(f"[red]{'suspect' if k == 0 else 'also'}[/]", suspect, suspect.code)


def print_checks(checks: tuple[Check, ...], of: str) -> None:
    """Print how many checks pass, and in red those that fail."""
    failed = [check for check in checks if not check.passed]
    console.print(f"{len(checks) - len(failed)} of {len(checks)} consistency checks of the {of} pass")
    for check in failed:
        numbers = f"{check.value:.3g} outside {check.low:.3g} to {check.high:.3g}"
        console.coded("[red]check failed[/]", f"{check.name}: {check.remark} ({numbers})", check.code)


def print_increments(answers: Deflections) -> None:
    """Print aerodynamic increments in one line, and in red those beyond the vehicle file's uncertainty."""
    if answers.no_increments is not None:
        console.coded("[yellow]left out[/]", str(answers.no_increments), answers.no_increments.code)
    if answers.increments is None:
        return
    console.print(f"against the preflight table, {escape(answers.increments.about)}")
    print_checks(answers.increments.consistency_checks, "coefficients")


def print_sensitivity(found: pd.DataFrame) -> None:
    """Changes of a few quantities at peak dynamic pressure, rerun by rerun, in standard deviations."""
    shown = largest_of_groups(found).pivot(index="rerun", columns="group", values="change_over_sd")
    groups = [g for g in SHORT if g in shown]
    table = Table(title="Sensitivity: change at peak dynamic pressure over the reported standard deviation")
    table.add_column("rerun")
    for group in groups:
        table.add_column(SHORT[group], justify="right", no_wrap=True)
    for rerun in dict.fromkeys(found["rerun"]):
        if rerun in shown.index:
            values = shown.loc[rerun, groups]
            table.add_row(escape(rerun), *("" if np.isnan(x) else "-" if x == 0.0 else f"{x:+.2f}" for x in values))
    console.print(table)
    for row in found[found["quantity"].isna()].itertuples(index=False):
        console.print(f"[yellow]no rerun[/] {escape(row.rerun)}: {escape(str(row.reason))}")
    odd = found[found["change_over_expected_sd"].abs() > LARGEST_NORMAL]
    for row in odd.itertuples(index=False):
        console.print(
            f"[yellow]found[/] {escape(row.rerun)}: {row.quantity} moves by {row.change:.3g} {row.unit}, "
            f"{abs(row.change_over_expected_sd):.1f} times what the data left out should move it"
        )


def print_answers(answers: Deflections) -> None:
    """Deflection method by method: at peak q (without a trajectory at the largest), cycle mean, largest."""
    if answers.doubt:
        console.coded("[red]in doubt[/]", answers.doubt, "answers-in-doubt")
    at_s, cycle = answers.reference_s, answers.cycle_s
    summary = run_folder.method_summary(answers)
    here, peak = ("at peak q", "peak q at") if answers.knows_peak else ("there", "no trajectory was made; largest at")
    title = f"Deflection of the aeroshell against the centerbody, deg: {peak} {at_s:.2f} s"
    title += f"{'' if cycle is None else f', cycle from {cycle[0]:.2f} to {cycle[1]:.2f} s'}; plane in deg LV"
    names = (here, *(() if cycle is None else ("cycle mean",)), "largest", "at s", "5 to 95 %", "LV")
    table = Table(title=title)
    for name in ("method", *names):
        table.add_column(name, justify="left" if name == "method" else "right", no_wrap=name != "5 to 95 %")
    for row in answers.to_frame().itertuples(index=False):
        if not np.isfinite(row.theta_deg):
            table.add_row(row.method, "no answer")
            continue
        places = decimals(row.theta_sd_deg)
        words = said(summary[row.method], here) | {
            "at s": f"{row.largest_t_s:.2f}",
            "5 to 95 %": f"{row.theta_p5_deg:.{places}f} to {row.theta_p95_deg:.{places}f}",
            "LV": f"{row.plane_lv_deg:.0f}",
        }
        table.add_row(row.method, *(words.get(name, "") for name in names))
    console.print(table)
    for check in answers.consistency_checks:
        if check.passed:
            console.print(escape(check.remark))
        else:
            console.coded("[red]check failed[/]", check.remark, check.code)
    if answers.consistency_checks:
        passed = sum(check.passed for check in answers.consistency_checks)
        console.print(f"{passed} of {len(answers.consistency_checks)} consistency checks of the deflection pass")
    bias = None if answers.fused is None else answers.fused.camera_time_bias
    if bias is not None and bias.applied:
        console.print(escape(bias.remark))
    if answers.camera is not None and answers.camera.shape is not None:
        console.print(f"shell's shape under load, by video: {escape(answers.camera.shape.verdict)}")
    none: dict[tuple[str, str], list[str]] = {}
    for method, row in summary.items():
        if "reason" in row:
            none.setdefault((row["reason"], row["code"]), []).append(method)
    for (reason, code), methods in none.items():
        console.coded("[yellow]no answer[/]", f"from {', '.join(methods)}: {reason}", code)


def assumed(plane_deg: float | None, joint_m: float | None) -> dict[str, Any]:
    """Stated camera assumptions, in the form of `Flight.with_`."""
    given = {"camera_plane_lv_deg": plane_deg, "joint_station_m": joint_m}
    return {name: value for name, value in given.items() if value is not None}


def deflection(
    folder: Path, methods: tuple[str, ...], wanted: Asked, film: bool = False, formats: tuple[str, ...] = (),
    strict: bool = False,
) -> None:  # fmt: skip
    """Estimate the deflection alone; the camera needs no trajectory, and is corrected where one can be made.

    With ``film`` the onboard film is written with the virtual camera over it; ``formats`` and ``strict``: `run`.
    """
    from postflight.filming import by_camera
    from postflight.plots.overlay import write_overlay_film

    flight = wanted.of(read_flight(folder, needs_path=set(methods) != {"camera"}))
    telemetry = flight.telemetry
    if not methods:
        methods = tuple(m for m in METHODS if m != "camera" or m not in Inputs.of(telemetry).missing())
    settings = {"methods": list(methods), "changes": list(flight.changes)}
    alone, plane_is_known = set(methods) == {"camera"}, flight.camera_plane_lv_rad is not None
    makes_bet = telemetry.loads is None and (not alone or (not plane_is_known and telemetry.can_tell_load))
    if makes_bet:
        compile_kernels(*warmup.RECONSTRUCTION)
    compile_kernels(*(["camera"] if "camera" in methods else []), *(["balance"] if telemetry.loads else []))
    with progress_bar() as report:
        bet, trouble = None, NO_FAULT
        try:
            if makes_bet:
                bet = reconstruct(flight, None, lambda f, what: report(0.6 * f, what))
        except (GateError, DivergenceError) as fault:
            if not alone:
                raise
            trouble = Issue(str(fault), fault.codes[0])
        answers = estimate(bet or flight, methods, lambda f, what: report(0.6 + 0.3 * f, what))
        with run_folder.RunFolder(folder, telemetry, settings, wanted.name, flight.as_read) as out:
            _write_alone(out, answers, flight, settings, formats)
            for name in by_camera(telemetry, answers["camera"]) if film and "camera" in answers.histories else ():
                file = "overlay.webm" if len(telemetry.films) == 1 else f"overlay_{name}.webm"
                write_overlay_film(flight, out.path / "figures" / file, answers["camera"], name, report)
    if trouble:
        console.coded("[yellow]no trajectory[/],", f"the camera answers alone: {trouble}", trouble.code)
    if film and "camera" not in answers.histories:
        console.coded(
            "[yellow]no film[/]", "was drawn: there is no answer of the camera to lay over it", "figure-failed"
        )
    _print_alone(answers, flight, out.path, strict)


def deflection_of_table(
    table: Path, vehicle: str, methods: tuple[str, ...], columns: tuple[str, ...], changes: dict[str, Any], place: str
) -> None:
    """Estimate by loads, print, and write tables, figures and report beside them, in ``<stem>-deflection``."""
    pairs = dict(text.partition("=")[::2] for text in columns)
    entry = parse_section(LoadsEntry, {"file": table.name, "acceleration_at": place, **changes}, "--set")
    flight = flight_of_table(table, read_vehicle(vehicle), pairs, entry)
    compile_kernels("balance")
    _finish_alone(table, estimate(flight, methods or BY_LOADS), flight)


def deflection_of_film(
    pictures: Path, times: str, vehicle: str, camera: str | None, benchmark_s: float | None, changes: dict[str, Any]
) -> None:
    """Estimate by a film alone, print, and write tables, figures and report beside it, in ``<stem>-deflection``.

    ``times`` is a list of frames, or their rate in Hz; ``changes`` are changes of `Flight.with_`.
    """
    from postflight.film_alone import read_film

    try:
        when: str | float = float(times)
    except ValueError:
        when = times
    film = read_film(pictures, when, vehicle, camera=camera, benchmark_s=benchmark_s).with_(**changes)
    compile_kernels("camera")
    with progress_bar() as report:
        answers = estimate(film, ("camera",), report)
    _finish_alone(pictures, answers, film)


def _finish_alone(given: Path, answers: Deflections, flight: Flight) -> None:
    """Write answers without a run into ``<stem>-deflection`` beside their input, and print them."""
    out = run_folder.Results(given.with_name(f"{given.stem}-deflection"))
    (out.path / "figures").mkdir(parents=True, exist_ok=True)
    _write_alone(out, answers, flight, {"methods": list(answers.histories), "changes": list(flight.changes)})
    _print_alone(answers, flight, out.path)


def _write_alone(
    out: run_folder.Results, answers: Deflections, flight: Flight, settings: dict[str, Any],
    formats: tuple[str, ...] = (),
) -> None:  # fmt: skip
    """Write tables, figures and report of answers that have no run."""
    from postflight.plots.run_figures import draw_alone

    out.write_csv("answers.csv", answers.to_frame())
    run_folder.write_answers(out, answers)
    run_folder.write_checks(out, answers.consistency_checks)
    draw_alone(answers, FigureFolder(out.path / "figures", ("png", *formats)), flight)
    write_deflection_report(answers, flight, out.path, settings)


def _print_alone(answers: Deflections, flight: Flight, path: Path, strict: bool = False) -> None:
    """Print findings, answers and their assumptions; exit 4 if a method has none, 5 if doubtful with ``strict``."""
    telemetry = flight.telemetry
    for words, code in few_of_each(telemetry.findings):
        console.coded("[yellow]found[/]", words, code)
    print_answers(answers)
    if "camera" in answers.histories:
        console.print(f"camera: {escape(answers.histories['camera'].assumptions)}")
    if telemetry.loads is not None and flight.read_loads is not None:
        loads, unused, _ = flight.read_loads
        sizes = ", ".join(f"{key} = {size:g}" for key, size in flight.assumed.get("loads", {}).items())
        console.print(
            f"{len(loads.time_s)} rows of {telemetry.loads.path}; errors not stated: {sizes or 'none'}", markup=False
        )
        if unused:
            console.print(f"columns not used: {', '.join(unused)}", markup=False)
    console.print(f"results in {path}, to read in report.html", markup=False)
    if answers.refused:
        sys.exit(EXIT_NO_ANSWER)
    if strict and answers.doubt:
        console.coded("[red]failed[/]", f"--strict: {answers.doubt}", "answers-in-doubt")
        sys.exit(EXIT_CHECK_FAILED)


def calibrate(corners: Path, size: str, lens: Lens) -> None:
    """Calibrate a lens and print the lines of a vehicle file."""
    from estimators.calibration import calibrate_lens, read_corners

    match = re.fullmatch(r"(\d{1,5})[x,](\d{1,5})", size.strip())
    if not match:
        raise ConfigError(f"--size {size}: width and height like 640x480 are wanted", "option-format")
    found = calibrate_lens(read_corners(corners), (int(match[1]), int(match[2])), lens)
    words = f"{found.corners} corners in {found.pictures} pictures, rms {found.rms_px:.3f} px"
    console.print(f"# {words}", highlight=False)
    console.print(escape(found.toml()), highlight=False)


def score(folder: Path, as_json: bool, wanted: str | None = None, limits: Limits | None = None) -> None:
    """Score a run (`find_run`); exit 5 where recovery fails."""
    result = score_run(folder, None if wanted is None else find_run(folder, wanted), limits)
    if as_json:
        write_out(json.dumps(result.as_json()) + "\n")
    else:
        print_score(result)
    if result.failures:
        sys.exit(EXIT_CHECK_FAILED)


def print_score(result: Score) -> None:
    """Estimates against the truth, with what was published of this vehicle's flight beside them."""
    table = Table(title=f"Deflection at peak q ({result.peak_s:.2f} s), deg, against the truth")
    title, published = PUBLISHED_DEG.get(result.vehicle, ("", {}))
    for name in ("method", "at peak q", "1 sd", "truth", "error", *([title] if title else [])):
        table.add_column(name, justify="left" if name == "method" else "right")
    for method, row in result.methods.items():
        beside = [f"{published[method]:g}" if method in published else ""] if title else []
        if row["deflection_deg"] is None:
            table.add_row(method, "no answer", "", f"{row['truth_deg']:.2f}", "", *beside)
            continue
        places = decimals(row["sd_deg"])
        numbers = (f"{row[k]:.{places}f}" for k in ("deflection_deg", "sd_deg"))
        table.add_row(method, *numbers, f"{row['truth_deg']:.2f}", f"{row['error_deg']:+.{places}f}", *beside)
    console.print(table)
    bet = result.bet
    parts = [
        f"position {bet['position_rms_m']:.1f} ({bet['position_sd_m']:.1f}) m",
        f"velocity {bet['velocity_rms_mps']:.2f} ({bet['velocity_sd_mps']:.2f}) m/s",
        f"total angle of attack {bet['alpha_total_rms_deg']:.2f} ({bet['alpha_total_sd_deg']:.2f}) deg"
        if np.isfinite(bet["alpha_total_sd_deg"])
        else "no attitude was estimated",
    ]
    span = f"{bet['pulse_start_s']:.1f} to {bet['pulse_end_s']:.1f} s"
    console.print(f"BET over the pulse ({span}), rms error (1 sd as stated): {', '.join(parts)}")
    for failure in result.failures:
        console.coded("[red]failed[/]", failure, failure.code)
    if not result.failures:
        console.print("[green]truth recovered[/] within every limit")


def demo(folder: Path, seed: int) -> None:
    """Fly, reconstruct, estimate, and only then look at the truth."""
    from postflight.plots.deflection import figure_summary
    from postflight.plots.style import draw

    check_destination(folder, replace=True)
    begun = time.perf_counter()
    console.print("A synthetic flight of an IRVE-II-class vehicle. The estimators see telemetry/ only.")
    compile_kernels("simulator", "ensembles", *warmup.RECONSTRUCTION, *warmup.ESTIMATES)
    simulate(REFERENCE, folder, seed, force=True)
    bet, answers, written = run_flight(folder, METHODS, Asked())
    print_flight(bet, run_folder.read_csv(written / "events.csv"))
    for method, reason in answers.refused.items():
        console.coded("[yellow]no answer[/]", f"from {method}: {reason}", reason.code)
    result = score_run(folder, written)
    picture = folder / "demo.png"
    draw(picture, figure_summary, bet, answers, truth_history(folder))
    print_score(result)
    console.print(run_folder.best_in_words(answers), highlight=False)
    console.print(f"results, figures and report.html in {escape(str(written))}")
    console.print(f"the answer as a picture, with the truth: {escape(str(picture))}")
    console.print(f"{time.perf_counter() - begun:.0f} s in all")
    if result.failures:
        sys.exit(EXIT_CHECK_FAILED)


def truth_history(folder: Path) -> tuple[FloatArray, FloatArray]:
    """Times and true deflection, deg, of a synthetic flight, for drawing after everything is estimated."""
    try:
        table = run_folder.read_csv(folder / "truth" / "deflection.csv")
    except FileNotFoundError:
        raise GateError(f"{folder}: no truth/deflection.csv", "truth-missing") from None
    return table["t_s"].to_numpy(), table["theta_deg"].to_numpy()
