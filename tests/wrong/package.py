"""A flight's tables, flight.toml and vehicle file in memory, in canonical columns, to be made wrong and written."""

from __future__ import annotations

import json
import shutil
import tomllib
from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pandas as pd

from flightmodel.flightfolder import read_flight
from flightmodel.telemetry import TriadRecord
from flightmodel.vehicle import DATA

_MARGINS = {
    "accelerometer": ("ax_suba_mps2", "ay_suba_mps2", "az_suba_mps2"),
    "rates": ("p_body_degps", "q_body_degps", "r_body_degps"),
}


@dataclass
class Package:
    """Everything that a range delivers.

    ``tables`` are by the name of their instrument; inertial sensors read in their own axes, SI or degrees per second.
    ``pictures`` is applied to every frame of the film.
    """

    spec: dict[str, Any]
    vehicle: dict[str, Any]
    tables: dict[str, pd.DataFrame]
    film: Path | None = None
    pictures: Any = None

    @property
    def radars(self) -> list[str]:
        """Names of the radars."""
        return list(self.spec["radars"])

    def copy(self) -> Package:
        """Copy that may be made wrong."""
        tables = {name: table.copy() for name, table in self.tables.items()}
        return Package(deepcopy(self.spec), deepcopy(self.vehicle), tables, self.film)

    def write(self, folder: Path) -> Path:
        """Write a flight folder."""
        shutil.rmtree(folder, ignore_errors=True)
        (folder / "telemetry").mkdir(parents=True)
        shutil.copy(DATA / "aerodynamics" / "irve2_reference.csv", folder)
        shutil.copy(DATA / "aerodynamics" / "irve2_reference.toml", folder)
        (folder / "flight.toml").write_text(_toml(self.spec))
        (folder / "vehicle.toml").write_text(_toml(self.vehicle))
        for name, table in self.tables.items():
            table.to_csv(folder / "telemetry" / f"{name}.csv", index=False)
        if self.film is not None and self.pictures is None:
            shutil.copytree(self.film, folder / "telemetry" / "film")
        elif self.film is not None:
            (folder / "telemetry" / "film").mkdir()
            for frame in self.tables["frames"]["frame"]:
                picture = cv2.imread(str(self.film / frame), cv2.IMREAD_UNCHANGED)
                cv2.imwrite(str(folder / "telemetry" / "film" / frame), self.pictures(picture))
        return folder


def read_package(folder: Path) -> Package:
    """Read a sound flight folder of the reference vehicle's shape."""
    telemetry = read_flight(folder)
    spec = tomllib.loads((folder / "flight.toml").read_text())
    spec.pop("events", None)
    spec["reconstruction"] = {"output_rate_hz": 10.0}
    entries = {**spec["sensors"], **spec["radars"], "atmosphere": spec["atmosphere"]}
    for name, entry in entries.items():
        for key in ("columns", "time", "resolution_mps2", "resolution_degps"):
            entry.pop(key, None)
        entry["file"] = f"telemetry/{name}.csv"
    tables = {name: _triad(name, getattr(telemetry, name)) for name in _MARGINS}
    for name, radar in telemetry.radars.items():
        values = radar.range_az_el * [1.0, 180.0 / np.pi, 180.0 / np.pi]
        tables[name] = pd.DataFrame(
            np.column_stack([radar.time_s, values]), columns=["t_s", "range_m", "az_deg", "el_deg"]
        )
    s = telemetry.sounding
    assert s is not None
    rows = (s.altitude_m, s.density_kgpm3, s.temperature_k, s.wind_north_mps, s.wind_east_mps)
    names = ("alt_m", "rho_kgpm3", "t_k", "wind_n_mps", "wind_e_mps")
    tables["atmosphere"] = pd.DataFrame(dict(zip(names, rows, strict=True)))
    film = None
    if "frames" in spec:
        tables["frames"] = pd.read_csv(folder / spec["frames"]["file"])
        film = (folder / spec["frames"]["folder"]).resolve()
        spec["frames"] |= {"file": "telemetry/frames.csv", "folder": "telemetry/film"}
    vehicle = tomllib.loads((DATA / "vehicles" / "irve2_reference.toml").read_text())
    own = folder / str(spec["vehicle"])
    if own.is_file():
        vehicle = {"geometry": vehicle["geometry"], "cameras": vehicle["cameras"]} | tomllib.loads(own.read_text())
    spec["vehicle"] = "vehicle.toml"
    return Package(spec, vehicle, tables, film)


def _triad(name: str, record: TriadRecord | None) -> pd.DataFrame:
    assert record is not None
    values = record.measured_sensor if name == "accelerometer" else np.rad2deg(record.measured_sensor)
    return pd.DataFrame(np.column_stack([record.time_s, values]), columns=["t_s", *_MARGINS[name]])


def _toml(values: dict[str, Any], path: str = "") -> str:
    """TOML of nested tables whose leaves are strings, numbers, booleans and arrays of them."""
    leaves = {k: v for k, v in values.items() if not isinstance(v, dict)}
    lines = [f"[{path}]"] if path else []
    lines += [f"{key} = {json.dumps(value)}" for key, value in leaves.items()]
    tables = [_toml(v, f"{path}.{k}" if path else k) for k, v in values.items() if isinstance(v, dict)]
    return "\n".join(["\n".join(lines), *tables]) + "\n"
