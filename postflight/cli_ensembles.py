"""The commands ``postflight montecarlo`` and ``postflight study``: many flights at once."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import click

# heavy imports stand inside the commands, so that --help answers at once
FOLDER = click.Path(path_type=Path)


@click.group()
def montecarlo() -> None:
    """Fly many dispersed flights, on this machine or a cluster; kill and resume at will.

    DISPERSIONS is a .toml file, or the name of a shipped one (irve2_reference). FOLDER holds one study.
    """


def workers_and_scheduler(command: Callable[..., None]) -> Callable[..., None]:
    """Add the options that say who flies."""
    command = click.option(
        "--scheduler", metavar="ADDRESS", help="Fly on the Dask cluster of this scheduler, e.g. tcp://host:8786."
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
def montecarlo_run(
    dispersions: str,
    folder: Path,
    flights: int | None,
    until_width: str | None,
    workers: int | None,
    scheduler: str | None,
) -> None:
    """Fly what is missing of DISPERSIONS in FOLDER, then write percentiles, intervals and bands."""
    from postflight.montecarlo import commands

    commands.run(dispersions, folder, flights, workers, scheduler, until_width)


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


@montecarlo.command(name="sobol")
@click.argument("dispersions")
@click.argument("folder", type=FOLDER)
@click.option("--output", default="peak_deflection_deg", show_default=True, help="Whose indices are printed and drawn.")
@click.option("--base", type=int, default=256, show_default=True, help="Points of the design, a power of two.")
@click.option("--by", type=click.Choice(["factor", "section"]), default="section", show_default=True)
@workers_and_scheduler
def montecarlo_sobol(
    dispersions: str, folder: Path, output: str, base: int, by: str, workers: int | None, scheduler: str | None
) -> None:
    """Say which dispersion of DISPERSIONS makes an output uncertain: Sobol indices, BASE x (columns + 2) flights."""
    from postflight.montecarlo import commands

    commands.sobol_indices(dispersions, folder, output, base, by, workers, scheduler)


@click.group()
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
    command = click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Draws the day.")(
        command
    )
    return click.option("--scenario", default="irve2_reference", show_default=True, help="A name, or a .toml file.")(
        command
    )


@study.command(name="damping")
@click.argument("folder", type=FOLDER, default=Path("study-damping"))
@scenario_and_seed
def study_damping(folder: Path, scenario: str, seed: int) -> None:
    """Angle of attack with 0.5 to 20 % damping at 2.5 Hz (Figure 3.1), into FOLDER."""
    from postflight.studies import commands

    commands.damping(scenario, folder, seed)


@study.command(name="stiffness")
@click.argument("folder", type=FOLDER, default=Path("study-stiffness"))
@scenario_and_seed
def study_stiffness(folder: Path, scenario: str, seed: int) -> None:
    """Angle of attack and normal acceleration from 2 to 4 Hz at 0.5 % (Figures 3.2, 3.3), into FOLDER."""
    from postflight.studies import commands

    commands.stiffness(scenario, folder, seed)


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
