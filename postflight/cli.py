"""The ``postflight`` command. Exit codes: 0 fine, 2 usage or configuration, 3 data refused, 4 an estimator gave no
answer, 5 the truth was not recovered or, with ``--strict``, a check is red, 130 interrupted, 143 terminated.

The commands ``postflight montecarlo`` and ``postflight study``: many flights at once.
"""

from __future__ import annotations

import _thread
import atexit
import gc
import os
import signal
import sys
import threading
import time
import warnings
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from types import FrameType
from typing import Any, Literal, NamedTuple

import click

from postflight.streams import close_streams, open_streams, pin_threads, write_out

# heavy imports stand inside the commands, so that --help answers at once; they make hundred thousands of objects, in
# which five hundred searches for garbage, and one at the end, find none: a sixth of a command's time
gc.set_threshold(50_000, 20, 100)
atexit.register(gc.freeze)
FOLDER = click.Path(path_type=Path)
OVERLAY = "overlay"  # value of --film without one


class Computing(click.Command):
    """A command that knows when it began."""

    def invoke(self, ctx: click.Context) -> Any:
        """Run the command; its ``obj`` is when that began."""
        ctx.obj = time.perf_counter()
        return super().invoke(ctx)


class Commands(click.Group):
    """Commands of this kind."""

    command_class = Computing


class NamedChoice(click.Choice[str]):
    """Choice that suggests the nearest valid word for an invalid one."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> str:
        """Value, or a usage error."""
        try:
            return super().convert(value, param, ctx)
        except click.BadParameter as fault:
            from flightmodel.checks import nearest_name

            hint = nearest_name(str(value), list(self.choices))
            raise click.BadParameter(fault.message.rstrip(".") + hint, ctx, param) from None


@click.group(cls=Commands)
def montecarlo() -> None:
    """Fly many dispersed flights, on this machine or a cluster; kill and resume at will.

    DISPERSIONS is a .toml file, or the name of a shipped one (irve2_reference). FOLDER holds one study.
    """


def workers_and_scheduler(command: Callable[..., None]) -> Callable[..., None]:
    """Add the options that say who flies."""
    command = click.option(
        "--scheduler",
        metavar="ADDRESS",
        help="Fly on the cluster of this Dask scheduler: tcp://127.0.0.1:8786, or tls://HOST:8786; without TLS its "
        "ports are open to everyone on the network.",
    )(command)
    return click.option("--workers", type=click.IntRange(min=1), help="Processes here; every core by default.")(command)


@montecarlo.command(name="run")
@click.argument("dispersions")
@click.argument("folder", type=FOLDER)
@click.option("--flights", type=click.IntRange(1, 10_000_000), help="Instead of the file's number; more extend a run.")
@click.option(
    "--until-width", metavar="OUTPUT=WIDTH", help="Stop once the 97.7th percentile's 95 % interval is this narrow."
)
@workers_and_scheduler
def montecarlo_run(**options: Any) -> None:
    """Fly what is missing of DISPERSIONS in FOLDER, then write percentiles, intervals and bands."""
    from postflight.montecarlo import commands

    commands.run(**options)


@montecarlo.command(name="status")
@click.argument("folder", type=FOLDER)
def montecarlo_status(folder: Path) -> None:
    """Say how many flights FOLDER holds, and why some failed."""
    from postflight.montecarlo import commands

    commands.status(folder)


@montecarlo.command(name="merge")
@click.argument("folder", type=FOLDER)
def montecarlo_merge(folder: Path) -> None:
    """Write tables and figures of FOLDER anew from its flights."""
    from postflight.montecarlo import commands

    commands.remerge(folder)


@montecarlo.command(name="retry-failed")
@click.argument("folder", type=FOLDER)
@workers_and_scheduler
def montecarlo_retry_failed(folder: Path, workers: int | None, scheduler: str | None) -> None:
    """Fly those flights of FOLDER again that failed."""
    from postflight.montecarlo import commands

    commands.retry_failed(folder, workers, scheduler)


@click.group(cls=Commands)
def study() -> None:
    """The paper's own studies, as tables and figures beside its numbers."""


@study.command(name="table-3.1")
@click.argument("folder", type=FOLDER, default=Path("study-table-3.1"))
@click.option("--vehicle", default="irve2_reference", show_default=True, help="A shipped one, or a .toml file.")
def study_table_3_1(folder: Path, vehicle: str) -> None:
    """Stiffness and damping against frequency and share of critical damping, into FOLDER."""
    from postflight.studies import commands

    commands.stiffness_and_damping(vehicle, folder)


def scenario_and_seed(command: Callable[..., None]) -> Callable[..., None]:
    """Add the options that say what is flown."""
    seed = click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Draws the day.")
    scenario = click.option("--scenario", default="irve2_reference", show_default=True, help="A name, or a .toml file.")
    return scenario(seed(command))


@study.command(name="damping")
@click.argument("folder", type=FOLDER, default=Path("study-damping"))
@scenario_and_seed
def study_damping(folder: Path, scenario: str, seed: int) -> None:
    """Angle of attack with 0.5 to 20 % damping at 2.5 Hz (Figure 3.1), into FOLDER."""
    from postflight.studies import commands

    commands.joint_study("damping", scenario, folder, seed)


@study.command(name="stiffness")
@click.argument("folder", type=FOLDER, default=Path("study-stiffness"))
@scenario_and_seed
def study_stiffness(folder: Path, scenario: str, seed: int) -> None:
    """Angle of attack and normal acceleration from 2 to 4 Hz at 0.5 % (Figures 3.2, 3.3), into FOLDER."""
    from postflight.studies import commands

    commands.joint_study("stiffness", scenario, folder, seed)


@study.command(name="shell-test")
@click.argument("table", type=click.Path(path_type=Path, dir_okay=False))
@click.argument("folder", type=FOLDER, default=Path("study-shell-test"))
@click.option(
    "--time", default="t_s", show_default=True, help="Column of time, unit behind the last _ or as NAME:UNIT."
)
@click.option("--load", default="moment_nm", show_default=True, help="Column of the load: a moment, or a force.")
@click.option(
    "--displacement", "displacements", multiple=True, default=("angle_deg",), show_default=True,
    help="Column of an angle, or a displacement; of several the mean is taken.",
)  # fmt: skip
@click.option(
    "--arm-m", type=click.FloatRange(min=0.0, min_open=True), help="Arm about the joint of force and displacement."
)
def study_shell_test(**options: Any) -> None:
    """Which joint has a shell by its load test on the ground (TABLE, a CSV of load and displacement)? Into FOLDER."""
    from postflight.studies import commands

    commands.shell_test(**options)


@study.command(name="preflight")
@click.argument("flight", type=FOLDER)
@click.argument("folder", type=FOLDER, default=Path("study-preflight"))
@click.option("--dispersions", default="irve2_reference", show_default=True, help="Whose [joint] the joint has.")
@click.option("--flights", type=click.IntRange(50, 100_000), default=1000, show_default=True)
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True)
def study_preflight(flight: Path, folder: Path, dispersions: str, flights: int, seed: int) -> None:
    """Is FLIGHT inside the bounds of its own entry, with the joint locked and flexible (Figure 1.3)? Into FOLDER."""
    from postflight.studies import commands

    commands.preflight(flight, folder, dispersions, flights, seed)


class FiniteRange(click.FloatRange):
    """A number within bounds; ``nan``, which no comparison catches, is refused too."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """Return the number or raise a usage error."""
        number = float(super().convert(value, param, ctx))
        if number != number:
            self.fail(f"{value} is not a number", param, ctx)
        return number


class WhatIfs(NamedTuple):
    """Options of `what_ifs`, as `postflight.commands.asked` reads them."""

    settings: tuple[str, ...]
    without: tuple[str, ...]
    rate: float | None
    run_name: str | None


def what_ifs(command: Callable[..., None]) -> Callable[..., None]:
    """Add the options that change a flight's assumptions or the reconstruction's settings; the command takes them all
    as ``changed``.
    """

    @wraps(command)
    def taking(**options: Any) -> None:
        changed = WhatIfs(**{name: options.pop(name) for name in WhatIfs._fields})
        command(changed=changed, **options)

    words = "Change an assumption (c_n=1.1, mass_kg=158, wind=none) or setting (engine=filterpy); repeat for several."
    added = (
        click.option("--name", "run_name", metavar="NAME", help="Of the run, to select it by."),
        click.option("--without", multiple=True, metavar="SOURCE", help="Leave this tracker out; repeat for several."),
        click.option("--set", "settings", multiple=True, metavar="NAME=VALUE", help=words),
        click.option("--rate", type=FiniteRange(1.0, 200.0), help="Output rate, Hz; default: flight.toml's, or 20."),
    )
    for option in added:
        taking = option(taking)
    return taking


def strict_option(command: Callable[..., None]) -> Callable[..., None]:
    """Add the option that lets a check decide the exit code."""
    words = "Exit with code 5 if a check is red; everything is written and printed first."
    return click.option("--strict", is_flag=True, help=words)(command)


def of_run(command: Callable[..., None]) -> Callable[..., None]:
    """Add the option that selects a run."""
    words = (
        "A run by its name, its eight digits or its folder; 'plain' for the last that is no what-if. Default: the last."
    )
    return click.option("--run", "wanted", metavar="RUN", help=words)(command)


@click.group(cls=Commands, context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100})
@click.version_option(package_name="postflight")
def cli() -> None:
    """What an entry vehicle really did, and how far its flexible aeroshell deflected.

    A flight is a folder: flight.toml, telemetry/, and for synthetic flights truth/, which no estimator opens.
    """


@cli.command()
@click.argument("folder", type=FOLDER, default=Path("demo-flight"))
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Draws the day and all errors.")
def demo(folder: Path, seed: int) -> None:
    """Fly the reference flight, forget the truth, reconstruct, estimate, then score against the truth.

    Writes a flight folder (default ./demo-flight, replaced when it is one already) with results and figures.
    """
    from postflight import commands

    commands.demo(folder, seed)


@cli.command()
@click.argument("arguments", nargs=-1, metavar="[SCENARIO] [FOLDER]")
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Draws the day and all errors.")
@click.option("--force", is_flag=True, help="Replace an existing synthetic flight folder.")
def simulate(arguments: tuple[str, ...], seed: int, force: bool) -> None:
    """Fly SCENARIO (a name, or a .toml file; default irve2_reference) and write telemetry and truth to a new FOLDER.

    FOLDER defaults to SCENARIO-flight.
    """
    if len(arguments) > 2:
        raise click.UsageError(f"at most a scenario and a folder; got {' '.join(arguments)}")
    from postflight import commands

    commands.simulate(*commands.scenario_and_folder(arguments), seed, force)


@cli.command()
@click.argument("folder", type=FOLDER)
@click.option("--sensitivity", is_flag=True, help="Also rerun without each source, wind, and with other air and mass.")
@what_ifs
def reconstruct(folder: Path, sensitivity: bool, changed: WhatIfs) -> None:
    """Reconstruct the best-estimated trajectory of the flight in FOLDER."""
    from postflight import commands

    commands.run(folder, (), commands.asked(*changed), sensitivity)


@cli.command()
@click.argument("folder", type=FOLDER, required=False)
@click.option(
    "--method", "methods", type=NamedChoice(["camera", "misalignment", "trim", "fused"]), multiple=True,
    help="Estimator to run; repeat for several. Default: all that the flight has data for.",
)  # fmt: skip
@click.option(
    "--plane", type=FiniteRange(-360.0, 360.0),
    help="Assume this plane for the camera (LV clocking, deg); default: find it.",
)  # fmt: skip
@click.option(
    "--joint", type=FiniteRange(0.0), help="Assume the joint this far aft of the nose, m; default: the vehicle file's."
)
@click.option(
    "--film", metavar="[PICTURES]", is_flag=False, flag_value=OVERLAY,
    help="Instead of FOLDER: pictures in a folder, or a film. With FOLDER, without a value: also write its film with "
    "the virtual camera over it (VP9 WebM).",
)  # fmt: skip
@click.option("--times", metavar="LIST|HZ", help="Of --film PICTURES: a list t_s, frame (CSV), or a frame rate.")
@click.option("--camera", metavar="NAME", help="Of --film PICTURES: which camera, if the vehicle file has several.")
@click.option("--benchmark", type=float, help="Of --film PICTURES: when the shell is at rest, s; default: the first.")
@click.option("--loads", metavar="TABLE", help="Instead of FOLDER: another team's trajectory, accelerations and rates.")
@click.option("--vehicle", metavar="FILE", help="Vehicle file, or the name of a shipped one, for --loads and --film.")
@click.option("--column", "columns", multiple=True, metavar="NAME=COLUMN[:UNIT]", help="Of --loads: ax='AX (g)'.")
@click.option("--set", "settings", multiple=True, metavar="NAME=VALUE", help="As of run; of loads: wind_sd_mps=1.")
@click.option("--at", "place", default="cg", help="Of --loads: where the accelerometer is: cg, or a vehicle's package.")
def deflection(
    folder: Path | None, methods: tuple[str, ...], plane: float | None, joint: float | None, film: str | None,
    times: str | None, camera: str | None, benchmark: float | None,
    loads: str | None, vehicle: str | None, columns: tuple[str, ...], settings: tuple[str, ...], place: str,
) -> None:  # fmt: skip
    """Estimate how far the aeroshell deflected: in the flight in FOLDER, by a table of loads (--loads, --vehicle), or
    by a film alone (--film, --times, --vehicle).
    """
    from postflight import commands

    alone = None if film == OVERLAY else film
    whole = [folder, loads, alone].count(None) == 2 and (folder is not None or vehicle is not None)
    if not whole or (alone is not None and times is None):
        words = "name FOLDER, or --loads TABLE --vehicle FILE, or --film PICTURES --times LIST --vehicle FILE"
        raise click.UsageError(f"{words}; to draw the overlay of a flight's film, write FOLDER --film")
    stated = commands.asked(settings, (), None).changes
    changes = stated | commands.assumed(plane, joint)
    if folder is not None:
        commands.deflection(folder, methods, commands.Asked(changes), film == OVERLAY)
    elif loads is not None:
        commands.deflection_of_table(Path(loads), str(vehicle), methods, columns, stated, place)
    else:
        commands.deflection_of_film(Path(str(alone)), str(times), str(vehicle), camera, benchmark, changes)


@cli.command()
@click.argument("folder", type=FOLDER)
@click.option("--camera", "name", metavar="NAME", help="Of several cameras; default: the first in flight.toml.")
@click.option("--port", type=click.IntRange(0, 65535), default=0, help="Of 127.0.0.1; default: any free one.")
@click.option("--browser/--no-browser", default=True, show_default=True, help="Open the page in the browser.")
def camera(folder: Path, name: str | None, port: int, browser: bool) -> None:
    """Work at the film in FOLDER by hand: step through it, try deflections, mask, mark, accept and reject."""
    from flightmodel.checks import ConfigError

    try:
        from postflight.camera_bench import server
    except ModuleNotFoundError:
        raise ConfigError("camera needs Werkzeug: pip install 'postflight[bench]'", code="package-missing") from None

    server.open_bench(folder, name, port, browser)


@cli.command()
@click.argument("corners", type=click.Path(exists=True, dir_okay=False, path_type=Path))
@click.option("--size", required=True, metavar="WxH", help="Size of the pictures, e.g. 640x480.")
@click.option("--lens", type=NamedChoice(["fisheye", "pinhole"]), default="fisheye", show_default=True)
def calibrate(corners: Path, size: str, lens: Literal["fisheye", "pinhole"]) -> None:
    """Calibrate a lens on checkerboard CORNERS (CSV: image, X_m, Y_m, u_px, v_px); print lines for a vehicle file."""
    from postflight import commands

    commands.calibrate(corners, size, lens)


@cli.command()
@click.argument("folder", type=FOLDER)
@click.option("--timings", is_flag=True, help="Print how long each stage took.")
@click.option("--figures", "formats", multiple=True, type=NamedChoice(["pdf", "svg"]), help="Draw figures so too.")
@strict_option
@what_ifs
@click.pass_obj
def run(begun: float, folder: Path, timings: bool, formats: tuple[str, ...], strict: bool, changed: WhatIfs) -> None:
    """Do it all for the flight in FOLDER: trajectory, three deflection estimates fused, tables, figures."""
    from postflight import commands
    from postflight.deflections import METHODS

    stages = commands.Stages(begun)
    commands.run(folder, METHODS, commands.asked(*changed), stages=stages, formats=formats, strict=strict)
    if timings:
        commands.print_stages(stages)


@cli.command()
@click.argument("folder", type=FOLDER)
@click.option("--accept", is_flag=True, help="Write the proposed levels into flight.toml, the old ones beside them.")
def noise(folder: Path, accept: bool) -> None:
    """Propose noise levels of trackers, inertial sensors and motion for flight.toml, by the innovations' likelihood."""
    from postflight import noise

    noise.run(folder, accept)


@cli.command()
@click.argument("folder", type=FOLDER)
@click.option("--hardening", is_flag=True, help="Ask whether the spring hardens (or softens) with the angle.")
@click.option("--freeplay", is_flag=True, help="Ask whether the joint has freeplay.")
@click.option("--creep", is_flag=True, help="Ask whether part of the joint's compliance comes late.")
@click.option("--posterior", is_flag=True, help="Sample the posterior (emcee).")
def reconcile(folder: Path, hardening: bool, freeplay: bool, creep: bool, posterior: bool) -> None:
    """Find the joint that makes the simulator fly like the flight in FOLDER: stiffness, damping, offset, stability."""
    from postflight.reconciliation import command

    command.run(folder, ("freeplay",) * freeplay + ("creep",) * creep + ("hardening",) * hardening, posterior)


@cli.command()
@click.argument("folder", type=FOLDER)
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object and nothing else.")
@click.option("--limit-sd", "sd", type=FiniteRange(0.0), default=4.0, show_default=True, help="Of errors, in own sd.")
@click.option("--limit-deg", "deg", type=FiniteRange(0.0), help="Of errors and sd of deflections and angle of attack.")
@click.option("--limit-m", "m", type=FiniteRange(0.0), help="Of error and sd of the position.")
@click.option("--limit-mps", "mps", type=FiniteRange(0.0), help="Of error and sd of the velocity.")
@click.option("--without", multiple=True, metavar="NAME", help="A method that need not answer; repeat for several.")
@of_run
def score(folder: Path, as_json: bool, wanted: str | None, **limits: Any) -> None:
    """Compare a run of a synthetic flight, the last complete one, with its truth; exit 5 where recovery fails.

    A limit in a unit holds for the error and for the standard deviation: a run does not pass by knowing nothing.
    """
    from postflight import commands
    from postflight.scoring import Limits

    commands.score(folder, as_json, wanted, Limits(**limits))


@cli.command()
@click.argument("folder", type=FOLDER)
@click.option("--output", type=click.Path(dir_okay=False, path_type=Path), help="Default: in the run's folder.")
@click.option("--notebook", is_flag=True, help="Write a Jupyter notebook filled in for this flight instead.")
@click.option(
    "--bands", multiple=True, type=click.Path(exists=True, path_type=Path),
    help="Folder of a Monte Carlo study or a reconciliation to hold the flight against.",
)  # fmt: skip
@of_run
def report(folder: Path, output: Path | None, notebook: bool, bands: tuple[Path, ...], wanted: str | None) -> None:
    """Write the report of a run, the last complete one, of the flight in FOLDER: one HTML file, no network needed."""
    from postflight.report.notebook import write_notebook
    from postflight.report.write import write_report
    from postflight.runs import find_run

    if notebook and bands:
        raise click.UsageError("--bands belongs to the report in HTML; leave out --notebook")
    run = find_run(folder, wanted)
    written = write_notebook(folder, output, run) if notebook else write_report(folder, run, None, output, bands)
    write_out(f"report in {written}\n")


@cli.command()
@click.argument("runs", nargs=-1, required=True, metavar="RUN RUN|FILE...")
@click.option("--output", type=FOLDER, help="Folder to write; default: comparisons/RUN-and-RUN in the flight's.")
def compare(runs: tuple[str, ...], output: Path | None) -> None:
    """Set runs side by side, the others against the first: deflections, trajectory, checks, over each other on a page.

    RUN is a run's folder, a flight's (its last complete run), or FLIGHT/NAME: my-flight/plain my-flight/more-lift.
    A RUN and a file compare it with another team's trajectory (CCSDS OEM, CSV, NetCDF, ...): time offset, shift,
    rotation, height datum and frame of velocity are looked for.
    """
    from postflight.report import compare

    compare.compare(runs, output)


@cli.command()
@click.argument("folder", type=FOLDER, metavar="FOLDER|VEHICLE")
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object and nothing else.")
@strict_option
@click.option("--pressure", type=FiniteRange(0.0), help="Of VEHICLE: dynamic pressure at which it trims, Pa.")
@click.option("--mach", type=FiniteRange(0.0), help="Of VEHICLE: Mach number; default: the largest of its table.")
@click.option("--drawing", type=click.Path(dir_okay=False, path_type=Path), help="PNG of VEHICLE; default: NAME.png.")
def check(folder: Path, as_json: bool, strict: bool, **of_vehicle: Any) -> None:
    """Look at the data of the flight in FOLDER: rates, gaps, stuck and doubtful sensors, units, axes, clocks.

    VEHICLE is a vehicle file (.toml) or the name of a shipped one: it is drawn from the side, with its mass properties,
    static margin, frequency, critical dynamic pressure and trim.
    """
    from postflight.checks import folder_check, vehicle_check

    if vehicle_check.is_vehicle(folder):
        vehicle_check.check(folder, as_json, strict, **of_vehicle)
        return
    if any(value is not None for value in of_vehicle.values()):
        raise click.UsageError("--pressure, --mach and --drawing belong to a vehicle file")
    folder_check.check(folder, as_json, strict)


@cli.command()
@click.argument("folder", type=FOLDER)
@click.option(
    "--vehicle", metavar="NAME", help="A vehicle that ships, a .toml file to copy, or 'form' for one to fill in."
)
def init(folder: Path, vehicle: str | None) -> None:
    """Write a commented flight.toml into FOLDER; what exists is never overwritten.

    A trajectory needs no vehicle file, deflections do.
    """
    from postflight.intake import flight_form

    flight_form.init(folder, vehicle)


@cli.command("import")
@click.argument("files", nargs=-1, required=True, type=FOLDER, metavar="FILES...")
@click.option("--into", "folder", required=True, type=FOLDER, help="A flight folder that `postflight init` made.")
def import_tables(files: tuple[Path, ...], folder: Path) -> None:
    """Bring tables, video and coefficients into a flight folder; proposes in flight.toml which column is which."""
    from postflight.intake import deliveries

    deliveries.import_files(files, folder)


@cli.command()
@click.argument("folder", type=FOLDER)
@click.option(
    "--to", "form", required=True, type=NamedChoice(["csv", "parquet", "mat", "nc", "kml", "oem", "aem", "msopck"])
)
@click.option("--out", type=FOLDER, help="File to write; default: exports/RUN.FORMAT in FOLDER.")
@of_run
def export(folder: Path, form: str, out: Path | None, wanted: str | None) -> None:
    """Write trajectory and deflections of a run, the last complete one, for another program."""
    from postflight import exports

    exports.export(folder, form, out, wanted)


@cli.command()
@click.argument("kind", type=NamedChoice(["flight", "vehicle", "scenario", "coefficients"]))
def schema(kind: str) -> None:
    """Print the JSON Schema of a flight.toml, vehicle or scenario file, or of a coefficient table's sidecar."""
    from postflight.intake.flight_form import schema_text

    write_out(schema_text(kind))


@cli.command()
def warmup() -> None:
    """Compile the kernels for this machine now, so that no later command waits for it."""
    from postflight import commands

    commands.warm_up()


cli.add_command(montecarlo)
cli.add_command(study)


_BINDINGS = f"{os.sep}llvmlite{os.sep}binding{os.sep}"


def terminate(number: int, frame: FrameType | None) -> None:
    """Leave as after Ctrl-C, so that what is half-written is removed; exit code as the shell gives it."""
    if not _postponed(number, frame):
        sys.exit(143)


def interrupt(number: int, frame: FrameType | None) -> None:
    """Stop by `KeyboardInterrupt`."""
    if not _postponed(number, frame):
        raise KeyboardInterrupt


def _postponed(number: int, frame: FrameType | None) -> bool:
    """Whether a signal is retried later: no exception may be raised amid an import or LLVM's bindings.

    Libraries turn it there into errors of their own; bindings leave objects half made, which fail when they are freed.
    """
    while frame is not None:
        if frame.f_code.co_filename.startswith("<frozen importlib") or _BINDINGS in frame.f_code.co_filename:
            _try_again(number)
            return True
        frame = frame.f_back
    return False


def unraisable(lost: Any) -> None:
    """Resend a signal whose exception Python had to drop, as in ``__del__``; show any other dropped exception."""
    if issubclass(lost.exc_type, KeyboardInterrupt | SystemExit):
        _try_again(signal.SIGINT if lost.exc_type is KeyboardInterrupt else signal.SIGTERM)
    else:
        sys.__unraisablehook__(lost)


def _try_again(number: int) -> None:
    again = threading.Timer(0.02, _send_again, (number,))
    again.daemon = True
    again.start()


def _send_again(number: int) -> None:
    """Resend a signal to the main thread to interrupt its wait; on Windows the wait ends first."""
    if sys.platform == "win32":
        _thread.interrupt_main(number)
    else:
        signal.pthread_kill(threading.main_thread().ident or 0, number)


def main() -> None:
    """Run the command; known faults become messages and exit codes, never a traceback."""
    signal.signal(signal.SIGTERM, terminate)
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:  # else the parent has it ignored
        signal.signal(signal.SIGINT, interrupt)
    sys.unraisablehook = unraisable
    open_streams()
    pin_threads()
    try:
        with warnings.catch_warnings():
            warnings.showwarning = show_warning
            cli.main(standalone_mode=False)
    except click.exceptions.Exit as stop:
        sys.exit(stop.exit_code)
    except (click.exceptions.Abort, KeyboardInterrupt):
        write_out("interrupted; nothing half-written is left\n", sys.stderr)
        sys.exit(130)
    except click.ClickException as fault:
        fault.show()
        sys.exit(fault.exit_code)
    except OSError as fault:
        where = fault.filename or "reading or writing a file failed"
        code = getattr(fault, "code", "")
        write_out(f"error: {where}: {fault.strerror or fault}{f' [{code}]' if code else ''}\n", sys.stderr)
        sys.exit(3)
    except ValueError as fault:
        sys.exit(refusal(fault))
    finally:
        close_streams()


def show_warning(message: Warning | str, category: type[Warning], *_: Any, **__: Any) -> None:
    """Print a warning as a finding, without the place in the source that `warnings` gives."""
    code = getattr(category, "code", category.__name__)
    write_out(f"found {message} [{code}]\n", sys.stderr)


def refusal(fault: ValueError) -> int:
    """Print a known refusal and return its exit code; anything else is a defect and is raised again."""
    from flightmodel.checks import GateError

    if not isinstance(fault, GateError):
        raise fault
    for line in fault.faults:
        write_out(f"error: {line}{f' [{line.code}]' if line.code else ''}\n", sys.stderr)
    if len(fault.faults) > 1:
        write_out(f"{len(fault.faults)} faults\n", sys.stderr)
    return fault.exit_code


if __name__ == "__main__":
    main()
