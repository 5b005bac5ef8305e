"""What is exported: the newest run's trajectory, deflections, events and covariances, as its files hold them."""

from __future__ import annotations

import json
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from flightmodel.checks import FloatArray, GateError
from flightmodel.config import parse_utc
from postflight.results import newest_run

UNITS = {
    "m": "m", "mps": "m s-1", "mps2": "m s-2", "deg": "degree", "degps": "degree s-1", "pa": "Pa", "kgpm3": "kg m-3",
    "k": "K", "s": "s",
}  # fmt: skip


@dataclass(frozen=True)
class Source:
    """One run, read.

    Parameters
    ----------
    name : str
        Of the flight.
    run : str
        Of the run folder.
    epoch : datetime
        Time zero, UTC.
    finished_utc : str
        When the run ended: the only date that files may carry, so that one run gives one file.
    synthetic : bool
    header : dict
        ``bet_header.json``.
    trajectory, events : DataFrame
        ``bet.csv`` and ``events.csv``.
    deflections : dict of str to DataFrame
        By method.
    covariance_time_s : (k,) float
    covariance : (k, 9, 9) float
        Position and velocity ECEF (m, m/s), rotation body (rad).
    """

    name: str
    run: str
    epoch: datetime
    finished_utc: str
    synthetic: bool
    header: dict[str, Any]
    trajectory: pd.DataFrame
    events: pd.DataFrame
    deflections: dict[str, pd.DataFrame]
    covariance_time_s: FloatArray
    covariance: FloatArray

    def utc(self, t_s: float) -> str:
        """ISO 8601 UTC, microseconds, of a time of the flight."""
        return (self.epoch + timedelta(seconds=float(t_s))).strftime("%Y-%m-%dT%H:%M:%S.%f")

    @property
    def title(self) -> str:
        """What the file is, in a line."""
        kind = "SYNTHETIC flight" if self.synthetic else "flight"
        return f"Best-estimated trajectory and deflections of the {kind} {self.name}"


def unit_of(column: str) -> str:
    """UDUNITS name of a column's unit, by its suffix; ``1`` for none."""
    tail = column.removesuffix("_sd").rsplit("_", 1)[-1]
    if column == "lat_deg":
        return "degrees_north"
    if column == "lon_deg":
        return "degrees_east"
    return UNITS.get(tail, "1")


def read_source(folder: Path) -> Source:
    """Read the newest run of a flight folder; `GateError` where there is none or its files are not whole."""
    run = newest_run(folder)
    try:
        header = json.loads((run / "bet_header.json").read_text())
        facts = json.loads((run / "run.json").read_text())
        trajectory = pd.read_csv(run / "bet.csv")
        events = pd.read_csv(run / "events.csv")
        with np.load(run / "covariance.npz", allow_pickle=False) as stored:
            times, covariance = stored["t_s"], stored["covariance"]
    except FileNotFoundError as fault:
        words = f"has no {Path(str(fault.filename)).name}: it made no trajectory; `postflight run {folder}` does"
        raise GateError(f"{run}: {words}") from None
    except (ValueError, KeyError, OSError) as fault:
        raise GateError(f"{run}: cannot be read back ({fault}); run it again") from None
    deflections = {p.stem.removeprefix("deflection_"): pd.read_csv(p) for p in sorted(run.glob("deflection_*.csv"))}
    return Source(
        header["flight"], run.name, parse_utc(header["epoch_utc"]), facts["finished_utc"], bool(header["synthetic"]),
        header, trajectory, events, deflections, times, covariance,
    )  # fmt: skip
