"""What does ``postflight montecarlo`` do? Fly a study, report its state, merge it, fly failed runs again."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from rich.markup import escape

from flightmodel.checks import ConfigError, GateError
from postflight.commands import compile_kernels, console
from postflight.montecarlo import execution
from postflight.montecarlo.bands import Merged, merge, write_merged
from postflight.montecarlo.execution import Wanted
from postflight.montecarlo.study import Stop, Study, read_study
from postflight.plots.studies import figure_bands
from postflight.plots.style import draw
from postflight.terminal import progress_bar
from postflight.warmup import RECONSTRUCTION
from synthetic_flight.ensemble import available_cores, check_outputs


def run(
    dispersions: str, folder: Path, flights: int | None, workers: int | None, scheduler: str | None,
    until_width: str | None,
) -> None:  # fmt: skip
    """Fly what is missing and merge."""
    study = read_study(dispersions)
    stop = study.spec.stop if until_width is None else stop_from(until_width, study)
    wanted = Wanted(flights or study.spec.flights, workers or available_cores(), scheduler, stop)
    count = fly(study, folder, wanted)
    finish(study, folder, count)
    if stop is not None:
        met = count < wanted.flights
        rule = f"interval of {stop.output} narrower than {stop.width:g}"
        console.print(f"{escape(rule)}: {'reached with' if met else 'not reached in'} {count} flights")


def stop_from(text: str, study: Study) -> Stop:
    """Read ``OUTPUT=WIDTH``."""
    output, _, width = text.partition("=")
    try:
        number = float(width)
    except ValueError:
        number = np.nan
    if not 0.0 < number < np.inf:
        message = f"--until-width {text}: OUTPUT=WIDTH is wanted, e.g. peak_normal_g=0.05"
        raise ConfigError(message, code="option-format")
    check_outputs((output,), study.plan.scalars)
    base = study.spec.stop or Stop(output=output, width=number)
    return base.model_copy(update={"output": output, "width": number})


def fly(study: Study, folder: Path, wanted: Wanted) -> int:
    """Fly with progress; return how many flights the study has."""
    compile_kernels("simulator", "ensembles", *(RECONSTRUCTION if study.spec.mode == "whole" else ()))
    if wanted.scheduler is not None and execution.is_open(wanted.scheduler):
        words = f"--scheduler {wanted.scheduler}: not encrypted, and whoever reaches its port can run code there; use tls://"
        console.coded("[yellow]found[/]", words, "scheduler-unreachable")
    try:
        with progress_bar() as report:
            return execution.run(study, folder, wanted, report)
    except KeyboardInterrupt:
        console.print(f"{escape(str(folder))} keeps every finished chunk; the same command resumes from there")
        raise


def finish(study: Study, folder: Path, flights: int) -> Merged:
    """Merge, write, draw, print."""
    merged = merge(study, folder, flights)
    write_merged(folder, merged)
    if len(merged.bands):
        draw(folder / "bands.png", figure_bands, merged, _origin(study))
    _print_merged(merged, folder)
    if merged.summary["failed"] == flights:
        message = f"{folder}: every flight failed; the first: {merged.flights['reason'].iloc[0]}"
        raise GateError(message, code="every-flight-failed")
    return merged


def _origin(study: Study) -> str:
    """Return the figures' corner text: what was flown."""
    return f"{study.source.name}: SYNTHETIC flights of {study.plan.scenario.spec.name}"


def _print_merged(merged: Merged, folder: Path) -> None:
    """Percentiles with their intervals, and what failed."""
    rows = []
    for output, band in merged.percentiles.groupby("output", sort=False):
        ends = ("open" if np.isnan(x) else f"{x:.4g}" for x in band.iloc[-1][["low_95", "high_95"]])
        rows.append((output, *(f"{value:.4g}" for value in band["value"]), " to ".join(ends)))
    names = ("output", "2.3 %", "50 %", "97.7 %", "95 % interval of the last")
    console.table(f"{merged.summary['flights']} flights: percentiles", names, rows)
    for name, row in merged.summary.get("coverage", {}).items():
        console.print(f"{name}: " + ", ".join(f"{key} {value:.3g}" for key, value in row.items()), highlight=False)
    if merged.summary["diverged"]:
        console.print(f"[yellow]found[/] deflection beyond 90 deg in {merged.summary['diverged']} flights")
    if merged.summary["failed"]:
        words = f"{merged.summary['failed']} flights failed; their reasons are in flights.csv"
        console.print(f"[red]failed[/] {words}; `postflight montecarlo retry-failed {escape(str(folder))}`")
    console.print(f"results in {escape(str(folder))}")


def status(folder: Path) -> None:
    """Print how many flights of a folder are flown."""
    found = execution.status(folder)
    flown = f"{found.flights} of {found.flights_wanted} flights in {found.chunks} of {found.chunks_wanted} chunks"
    console.print(f"{flown}; {found.failed.total()} failed, {found.diverged} diverged", highlight=False)
    for reason, count in found.failed.most_common(5):
        console.print(f"[red]failed[/] {count} times: {escape(reason)}")


def remerge(folder: Path) -> None:
    """Merge the chunks of a folder again."""
    study, flights = execution.study_of(folder)
    finish(study, folder, flights)


def retry_failed(folder: Path, workers: int | None, scheduler: str | None) -> None:
    """Fly failed runs again and merge."""
    study, flights = execution.study_of(folder)
    compile_kernels("simulator", "ensembles", *(RECONSTRUCTION if study.spec.mode == "whole" else ()))
    wanted = Wanted(flights, workers or available_cores(), scheduler)
    with progress_bar() as report:
        tried, still = execution.retry_failed(study, folder, wanted, report)
    console.print(f"{tried} failed flights flown again, {still} fail again", highlight=False)
    finish(study, folder, flights)
