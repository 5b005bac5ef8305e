"""What does ``postflight study`` do? One of the paper's studies as tables and figures in a folder."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
from rich.markup import escape

from flightmodel.statistics import BAND_COLUMNS
from flightmodel.vehicle import vehicle_from_toml, vehicle_path
from postflight.commands import compile_kernels, console
from postflight.flight import read_flight
from postflight.montecarlo.bands import write_csv
from postflight.montecarlo.study import read_study
from postflight.plots import studies
from postflight.plots.style import draw
from postflight.reconstruction import reconstruct
from postflight.studies import joints
from postflight.studies.joints import table_3_1
from postflight.studies.preflight import Bounds, entry_bounds, pulse_columns, shares
from postflight.studies.shell_test import fit_laws, read_load_test
from postflight.terminal import progress_bar
from postflight.warmup import RECONSTRUCTION
from synthetic_flight.scenarios import read_scenario


def stiffness_and_damping(vehicle: str, folder: Path) -> None:
    """Write and print Table 3.1."""
    known = vehicle_from_toml(vehicle_path(vehicle))
    table = table_3_1(known)
    folder.mkdir(parents=True, exist_ok=True)
    write_csv(folder / "table_3_1.csv", table)
    draw(folder / "table_3_1.png", studies.figure_table_3_1, known)
    names = ("study", "Hz", "% of c*", "quantity", "paper", "ours", "vehicle's own")
    rows = [
        (r.study, f"{r.frequency_hz:g}", f"{r.damping_percent:g}", r.quantity, r.paper, r.ours, f"{r.vehicle:.5g}")
        for r in table.itertuples()
    ]
    console.table("Table 3.1 (AIAA 2011-2571)", names, rows, words=("quantity",))
    console.print(f"{int(table['agrees'].sum())} of {len(table)} numbers agree to the last digit printed")
    console.print(f"results in {escape(str(folder))}")


def joint_study(name: str, scenario: str, folder: Path, seed: int) -> None:
    """Fly the study of the joint's ``damping`` or ``stiffness``; write it, and print it beside the paper's words."""
    chosen = read_scenario(scenario)
    compile_kernels("simulator", "ensembles")
    study = joints.STUDIES[name](chosen, seed)
    folder.mkdir(parents=True, exist_ok=True)
    write_csv(folder / f"{name}.csv", study.table)
    write_csv(folder / f"{name}_paper.csv", study.paper)
    write_csv(folder / f"{name}_histories.csv", joints.histories(study))
    for number in (figure for figure, (own, *_) in studies.JOINT_FIGURES.items() if own == name):
        draw(folder / f"figure_{number.replace('.', '_')}.png", studies.figure_joints, chosen, number, study)
    later = f"{joints.LATER_S[0]:g} to {joints.LATER_S[1]:g} s later"
    rows = []
    for r in study.table.itertuples():
        cells = (r.alpha_mean_deg, r.alpha_later_mean_deg, r.normal_mean_g, r.normal_peak_g, r.deflection_mean_deg)
        ended = "" if np.isnan(r.tumbled_s) else f"{r.tumbled_s:.1f}"
        rows.append((r.joint, *("" if np.isnan(x) else f"{x:.2f}" for x in cells), ended))
    names = ("joint", "alpha deg", "later", "normal g", "peak g", "deflection deg", "tumbled s")
    console.table(f"Centerbody around peak pressure ({study.peak_s:.1f} s) and {later}", names, rows)
    for r in study.paper.itertuples():
        mark = "[green]agrees[/]" if r.agrees else "[yellow]differs[/]"
        console.print(f"{mark} {escape(r.claim)}: paper {r.paper}, here {r.ours:.2f} ({escape(r.measured_as)})")
    console.print(f"results in {escape(str(folder))}")


def shell_test(
    table: Path, folder: Path, time: str, load: str, displacements: tuple[str, ...], arm_m: float | None
) -> None:
    """Fit a joint's law to a load test; write its table, the lines of a vehicle file and a figure, and print them."""
    test = read_load_test(table, time, load, displacements, arm_m)
    found = fit_laws(test)
    laws = found.table()
    folder.mkdir(parents=True, exist_ok=True)
    write_csv(folder / "shell_test.csv", laws)
    (folder / "joint.toml").write_text(found.selected.vehicle_file_lines())
    draw(folder / "shell_test.png", studies.figure_shell_test, found, f"load test {test.name}")
    rows = []
    for fit, r in zip(found.fits, laws.to_dict(orient="records"), strict=True):
        creep = [f"{r[name]:.3g} +/- {r[f'{name}_sd']:.1g}" if "creep" in fit.laws else ""
                 for name in ("creep_share", "creep_time_s")]  # fmt: skip
        remark = "selected" if r["selected"] else "" if fit.time_is_inside else "time constant not inside the test"
        rows.append((r["law"], f"{r['rms_percent']:.2f}", f"{r['largest_percent']:.1f}", *creep, remark))
    names = ("law", "rms, % of the largest", "largest", "creep share", "time constant s", "")
    console.table(f"Laws of the joint by the load test {test.name}", names, rows, words=("",))
    console.print(escape(found.selected.vehicle_file_lines()), end="")
    console.print(f"results in {escape(str(folder))}")


def preflight(flight_folder: Path, folder: Path, dispersions: str, flights: int, seed: int) -> None:
    """Fly the bounds of a flight's own entry with the joint locked and flexible; print where the flight lies."""
    joint = read_study(dispersions).spec.joint
    compile_kernels(*RECONSTRUCTION, "simulator", "ensembles")
    with progress_bar() as report:
        flight = reconstruct(read_flight(flight_folder), None, lambda f, what: report(0.4 * f, what))
        flight.required_loads()
        rigid = entry_bounds(flight, None, flights, seed, lambda f, what: report(0.4 + 0.3 * f, what))
        flexible = entry_bounds(flight, joint, flights, seed, lambda f, what: report(0.7 + 0.3 * f, what))
    table = shares(flight, rigid, flexible)
    folder.mkdir(parents=True, exist_ok=True)
    write_csv(folder / "preflight.csv", table)
    write_csv(folder / "preflight_bands.csv", bands(rigid, flexible))
    write_csv(folder / "preflight_flight.csv", pulse_columns(flight))
    draw(folder / "figure_1_3.png", studies.figure_preflight, flight, rigid, flexible)
    names = ("joint", "quantity", "inside", "over the median", "peak / 97.7 %", "diverged")
    rows = [
        (r.joint, r.quantity, f"{100 * r.share_inside:.1f} %", f"{r.over_median_at_peak:.3g}",
         f"{r.peak_over_upper:.2f}", r.diverged)
        for r in table.itertuples()
    ]  # fmt: skip
    title = f"The flight against 2.3 to 97.7 % of {flights} entries, over the pulse"
    console.table(title, names, rows, words=("quantity",))
    console.print("paper: angle of attack 4 to 5 deg above the median, peak normal acceleration over twice the bound")
    console.print(f"results in {escape(str(folder))}")


def bands(rigid: Bounds, flexible: Bounds) -> pd.DataFrame:
    """Bands of both, for a file."""
    parts = []
    for joint, bounds in (("rigid", rigid), ("flexible", flexible)):
        for quantity, (band, nominal) in bounds.by_quantity.items():
            about = {"joint": joint, "quantity": quantity, "time_s": np.round(bounds.time_s, 6)}
            percentiles = dict(zip(BAND_COLUMNS, band, strict=True))
            parts.append(pd.DataFrame(about | percentiles | {"nominal": nominal}))
    return pd.concat(parts, ignore_index=True)
