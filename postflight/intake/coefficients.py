"""A coefficient table as it is delivered: recognised by its columns, put beside the vehicle file with its sidecar."""

from __future__ import annotations

import csv
import io
import json
import re
from pathlib import Path

from flightmodel.aerodynamics import COLUMNS, named_columns
from flightmodel.config import FILL_IN_VALUE
from postflight.intake.loose import LooseTable
from postflight.intake.schema import template
from postflight.intake.words import fold

WIND = (*COLUMNS[:2], "cd", "cl", *COLUMNS[4:])
DAVEML = (".dml",)


def coefficient_columns(table: LooseTable) -> dict[str, str] | None:
    """Return which column is which coefficient; None where Mach, angle or a coefficient is missing (damping may be)."""
    for wanted in (COLUMNS, WIND):
        found = named_columns(wanted, table.names)
        if not set(wanted[:5]) - set(found):
            return found
    return None


def as_coefficients(table: LooseTable, columns: dict[str, str]) -> bytes:
    """Return the CSV with the columns' names that the reader of coefficient tables knows; others stay."""
    back = {column: name for name, column in columns.items()}
    names = [back.get(name, name) for name in table.names]
    changed = [f"{old} as {new}" for old, new in zip(table.names, names, strict=True) if old != new]
    if changed:
        table.notes.append(f"columns renamed: {', '.join(changed)}")
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerows([names, *table.rows])
    return out.getvalue().encode()


def sidecar_text(columns: dict[str, str]) -> str:
    """Return the sidecar to fill in; what the columns' names say is filled in."""
    moment = fold(columns.get("cm", ""))
    nose = re.search(r"nose|nase", moment)
    axes = "wind" if "cd" in columns else "body"
    value = "0.0".ljust(9) if nose else f'"{FILL_IN_VALUE}"'
    why = f"; '{columns['cm']}' says the nose" if nose else ""
    return (
        "# What the numbers of the coefficient table of this name refer to. Values that say FILL IN are needed.\n"
        f'source = "{FILL_IN_VALUE}"                      # where they come from\n'
        f'licence = "{FILL_IN_VALUE}"                     # on what terms\n'
        f'area_m2 = "{FILL_IN_VALUE}"                     # m2: reference area of the coefficients\n'
        f'length_m = "{FILL_IN_VALUE}"                    # m: reference length of the moments\n'
        f"moment_reference_station_m = {value}   # m aft of the nose: the point that C_m is about{why}\n"
        f'axes = "{axes}"                           # "body": C_A and C_N; "wind": C_D and C_L\n'
        'damping_per = "ql/2V"                   # or "ql/V"\n'
        "# [uncertainty]                         # one standard deviation, as fractions\n"
        "# ca = 0.03\n# cn = 0.07\n# cm = 0.1\n"
    )


def named_in_form(text: str, beside: str) -> str | None:
    """Return a vehicle file's text with the table named; None where its coefficients are no longer the form's own.

    Parameters
    ----------
    text : str
        Of the vehicle file.
    beside : str
        The table, relative to it.
    """
    lines, form = text.splitlines(), template("vehicle").splitlines()
    asked = form[form.index("# [aerodynamics]") :]
    asked = asked[: next(k for k, line in enumerate(asked) if line.startswith("# mach = "))]
    at = next((k for k in range(len(lines)) if lines[k : k + len(asked)] == asked), None)
    if at is None:
        return None
    cone = [f"# {line}" for line in asked if line and not line.startswith("#")]
    made = ["[aerodynamics]", f"table = {json.dumps(beside)}", "", *cone]
    return "\n".join([*lines[:at], *made, *lines[at + len(asked) :]]) + "\n"


def how_to_name(table: Path, vehicle: Path, named: bool) -> list[str]:
    """Say what makes a vehicle take its coefficients from a table, or that it does."""
    beside = table.relative_to(vehicle.parent).as_posix()
    by_hand = f'in {vehicle} write  [aerodynamics]  table = "{beside}"  and take [aerodynamics.sphere_cone] out'
    return [
        f"a coefficient table: {f'{vehicle} names it now' if named else by_hand}",
        f"what its numbers refer to is to fill in in {table.with_suffix('.toml')}",
    ]
