"""How noisy was this flight? Noise levels of flight.toml proposed by the innovations' likelihood, and accepted."""

from __future__ import annotations

import os
import re
import tomllib
from pathlib import Path
from typing import Any

from rich.markup import escape
from rich.table import Table

from flightmodel.checks import ConfigError
from flightmodel.files import file_bytes, partial_path
from postflight.commands import compile_kernels, console
from postflight.flight import read_flight
from postflight.streams import write_out
from postflight.terminal import progress_bar
from postflight.warmup import RECONSTRUCTION
from recon.noise_levels import NoiseLevels, noise_levels

DIGITS = 3
_HEADER = re.compile(r"\s*\[(?P<name>[^\[\]]+)\]\s*(#.*)?$")
_VALUE = re.compile(r"(?P<before>\s*(?P<key>[\w-]+)\s*=\s*)(?P<value>[^#\s]+)(?P<after>\s*(#.*)?)$")


def run(folder: Path, accept: bool) -> None:
    """Print the noise levels that the flight implies for its flight.toml, and write them there if asked."""
    compile_kernels(*RECONSTRUCTION)
    with progress_bar() as report:
        flight = read_flight(folder)
        found = noise_levels(flight.telemetry, flight.settings, report)
    _print(found)
    new = accepted_values(found)
    if not new:
        console.print("the flight agrees with every level that is stated")
    elif not accept:
        console.print("for flight.toml (or: --accept writes it):\n", highlight=False)
        write_out(toml_lines(new))
    else:
        path = folder / "flight.toml"
        text = with_values(file_bytes(path).decode("utf-8-sig"), new, str(path))
        partial = partial_path(path)
        try:
            partial.write_text(text, encoding="utf-8")
            os.replace(partial, path)
        finally:
            partial.unlink(missing_ok=True)
        console.print(f"{len(new)} levels written to {escape(str(path))}; what they were stands beside them")


def accepted_values(found: NoiseLevels) -> dict[tuple[str, str], float]:
    """Levels that differ from the stated ones, by table and key, to three digits."""
    return {(level.table, level.key): float(f"{level.proposed:.{DIGITS}g}") for level in found.levels if level.changed}


def toml_lines(values: dict[tuple[str, str], float]) -> str:
    """Lines of flight.toml with values by table and key."""
    tables = dict.fromkeys(table for table, _ in values)
    out = []
    for name in tables:
        lines = [f"{key} = {value:.{DIGITS}g}\n" for (table, key), value in values.items() if table == name]
        out.append(f"[{name}]\n" + "".join(lines))
    return "\n".join(out)


def with_values(text: str, values: dict[tuple[str, str], float], name: str) -> str:
    """Text of flight.toml with other values, each line's comment kept, and the old value added to it.

    Raises
    ------
    ConfigError
        ``toml-form``: a table is written in a way that is not changed line by line (inline, dotted keys).
    """
    line_end = "\r\n" if "\r\n" in text else "\n"
    lines, left, table, out = text.splitlines(), dict(values), "", []
    for line in lines:
        header = _HEADER.match(line)
        if header:
            table = _name(header)
            out.append(line)
            # keys that are not stated stand first
            body = _body(lines, table)
            for (of, key), value in list(left.items()):
                if of == table and not any((m := _VALUE.match(each)) and m["key"] == key for each in body):
                    out.append(f"{key} = {value:.{DIGITS}g}  # by the innovations' likelihood")
                    del left[of, key]
            continue
        stated = _VALUE.match(line)
        if stated and (table, stated["key"]) in left:
            value = left.pop((table, stated["key"]))
            remark = f"by the innovations' likelihood; was {stated['value']}"
            comment = stated["after"].strip().removeprefix("#").strip()
            out.append(f"{stated['before']}{value:.{DIGITS}g}  # {remark}{f'. {comment}' if comment else ''}")
        else:
            out.append(line)
    changed = line_end.join(out) + line_end
    if left or tomllib.loads(changed) != _set(tomllib.loads(text), values):
        lost = ", ".join(sorted({table for table, _ in values}))
        raise ConfigError(
            f"{name}: [{lost}] is not written one key a line, so nothing was changed; put in yourself:\n"
            f"{toml_lines(values)}",
            code="toml-form",
        )
    return changed


def _name(header: re.Match[str]) -> str:
    """Name of a table as written in its header, without quotes and blanks about its dots."""
    return re.sub(r"\s*\.\s*", ".", re.sub(r"[\"']", "", header["name"].strip()))


def _body(lines: list[str], table: str) -> list[str]:
    """Lines of a table, without its header."""
    out, inside = [], False
    for line in lines:
        header = _HEADER.match(line)
        if header:
            inside = _name(header) == table
        elif inside:
            out.append(line)
    return out


def _set(tables: dict[str, Any], values: dict[tuple[str, str], float]) -> dict[str, Any]:
    """Tables with values put in."""
    for (table, key), value in values.items():
        at = tables
        for part in table.split("."):
            at = at.setdefault(part, {})
        at[key] = value
    return tables


def _print(found: NoiseLevels) -> None:
    table = Table(title="Noise levels, as flight.toml states them and as the flight shows them")
    for column in ("where", "stated", "proposed", "90 % interval"):
        table.add_column(column, justify="left" if column == "where" else "right")
    for level in found.levels:
        proposed = f"{level.proposed:.3g}" if level.changed else ""
        where = escape(f"[{level.table}] {level.key}")
        table.add_row(where, f"{level.stated:.4g}", proposed, f"{level.low:.2g} to {level.high:.2g}")
    console.print(table)
    console.print(f"log likelihood of the innovations: {found.gain:+.1f} with those proposed")
