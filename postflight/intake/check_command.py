"""What ``postflight check`` prints, for a reader or as JSON, and the code it leaves with."""

from __future__ import annotations

import json
import sys
from pathlib import Path

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from flightmodel.telemetry import Finding
from postflight.intake.check import Report, check_folder

WIDE = 160  # of a log file: a table need not be squeezed there
console = Console(soft_wrap=True, width=None if sys.stdout.isatty() else WIDE)
LONGEST_NAME = 28  # that leaves room for the rest of a table on 80 columns


def check(folder: Path, as_json: bool) -> None:
    """Print what a flight folder holds, what is odd about it and what is refused; leave with its exit code."""
    report = check_folder(folder)
    if as_json:
        sys.stdout.write(json.dumps(report.as_json(), indent=2, allow_nan=False) + "\n")
    else:
        print_report(report)
    if report.exit_code:
        sys.exit(report.exit_code)


def print_report(report: Report) -> None:
    """Tables and lines for a reader."""
    if report.facts:
        table = Table(title="Sensors")
        for name in ("source", "rows", "from s", "to s", "rate Hz", "missing", "file"):
            left = name in ("source", "file")
            # names stay whole on one line, as two radars may differ in their ends; files are folded
            whole = name != "file" and max(len(f.source) for f in report.facts) <= LONGEST_NAME
            table.add_column(name, justify="left" if left else "right", overflow="fold", no_wrap=whole)
        for f in report.facts:
            span = (f"{f.start_s:.3f}", f"{f.end_s:.3f}", f"{f.rate_hz:.4g}")
            table.add_row(escape(f.source), str(f.rows), *span, str(f.missing), escape(f.file))
        console.print(table)
    _lines("[yellow]found[/]", report.findings)
    _lines("[red]odd[/]  ", report.oddities)
    for clock in report.clocks:
        late = f"{clock.late_s:+.3f} +- {clock.sd_s:.3f} s late against {clock.against}"
        console.print(f"clock {escape(clock.source)}: {escape(late)}", highlight=False)
    for words in report.fill_in:
        console.print(f"[cyan]to fill in[/] {escape(words)}", highlight=False)
    for words in report.refused:
        console.print(f"[red]refused[/] {escape(words)}", highlight=False)
    console.print(_summary(report))


def _lines(mark: str, findings: list[Finding]) -> None:
    for finding in findings:
        console.print(f"{mark} {escape(str(finding))}", highlight=False)


def _summary(report: Report) -> str:
    counts = (
        (len(report.findings), "findings", "finding"),
        (len(report.oddities), "oddities", "oddity"),
        (len(report.fill_in), "values still to fill in", "value still to fill in"),
        (len(report.refused), "refused", "refused"),
    )
    said = ", ".join(f"{count} {what if count > 1 else one}" for count, what, one in counts if count)
    return said or "nothing found that would be in the way"
