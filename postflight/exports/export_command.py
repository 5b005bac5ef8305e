"""What ``postflight export`` does: one file, whole or not at all, the same bytes for the same run."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from rich.console import Console
from rich.markup import escape

from flightmodel.checks import ConfigError, GateError
from postflight.exports import kml, matlab, netcdf, oem, tables
from postflight.exports.source import Source, read_source
from postflight.whole_file import write_file

FORMS: dict[str, Callable[[Source], bytes]] = {
    "csv": tables.csv_bytes,
    "parquet": tables.parquet_bytes,
    "mat": matlab.mat_bytes,
    "nc": netcdf.netcdf_bytes,
    "kml": kml.kml_bytes,
    "oem": oem.oem_bytes,
}
EXTRAS = {"pyarrow": "parquet"}
console = Console(soft_wrap=True)


def export(folder: Path, form: str, out: Path | None) -> None:
    """Write one file and say where.

    Raises
    ------
    ConfigError
        Where a library is missing, with the command that installs it; where the file would lie in a run folder.
    GateError
        Where the flight has no run with a trajectory.
    """
    source = read_source(folder)
    path = out or folder / "exports" / f"{source.run}.{form}"
    if (folder / "runs").resolve() in path.resolve().parents:
        raise ConfigError(f"{path}: run folders stay as they were written; name another place")
    try:
        content = FORMS[form](source)
    except ImportError as fault:
        name = (fault.name or "").partition(".")[0]
        if name not in EXTRAS:
            raise
        words = f"--to {form} needs {name}, which is not installed: pip install 'postflight[{EXTRAS[name]}]'"
        raise ConfigError(words) from None
    try:
        write_file(path, content)
    except OSError as fault:
        raise GateError(f"{path}: cannot be written: {fault.strerror or fault}") from None
    console.print(f"{escape(str(path))} ({len(content) / 1e6:.1f} MB) of run {escape(source.run)}", highlight=False)
