"""How is a synthetic flight delivered? As a range delivers a real one: telemetry and data sheets, the truth apart.

``telemetry/`` holds the tables, ``flight.toml`` the a priori standard deviations of the instruments' data sheets and
nothing that was drawn, ``truth/`` the true trajectory, deflection and events. A vehicle that ships with the toolkit is
named, another one is copied in with its coefficient table, so that nothing refers to a place outside. The folder is
made beside its destination and renamed when whole: a killed run leaves nothing half-written.

Events, each with the true state: separation (the first record), inflation (the joint unlocks), apogee, 80 km, peak
heating, Mach 3.5, peak dynamic pressure, 40 km, Mach 1, splashdown; those outside the flown span are absent. Heat flux
is that of the stagnation point, ``1.7415e-4 sqrt(rho / r_nose) V^3`` W/m^2, with the vehicle's nose radius.

References
----------
Sutton and Graves, "A general stagnation-point convective-heating equation for arbitrary gas mixtures", NASA TR R-376.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from flightmodel import earth, tables
from flightmodel.checks import FloatArray, GateError, Progress
from flightmodel.config import Section
from flightmodel.earth import STANDARD_GRAVITY_MPS2
from flightmodel.events import descent_events, find_peak, first_fall, has_peak, splashdown_index, values_at
from flightmodel.files import abandoned, partial_path, writing
from flightmodel.instruments import ACCELEROMETER, GNSS, MAGNETOMETER, RADAR, RATES, SUN, InstrumentTable
from synthetic_flight import sensing, weather
from synthetic_flight.film import write_videos
from synthetic_flight.instrument_errors import Video, stated_errors
from synthetic_flight.scenarios import Scenario, child_rng, fly_scenario
from synthetic_flight.simulate import Truth

if TYPE_CHECKING:
    import pandas as pd


TRUTH_RATE_HZ = 50.0
SHORTEST_TELEMETRY_S = 1.0
OLD = "old"  # name of a flight that is being replaced


def simulate_to_folder(
    scenario: Scenario, seed: int, destination: Path, progress: Progress | None = None, replace: bool = False
) -> Truth:
    """Fly a scenario and write its flight folder.

    Parameters
    ----------
    scenario : Scenario
    seed : int
        Draws the day-of-flight atmosphere and every instrument's errors.
    destination : Path
    progress : callable, optional
        Called with the fraction done and what is being done.
    replace : bool
        Replace an existing *synthetic* flight folder; anything else is never touched.

    Raises
    ------
    GateError
        Where the destination exists, or the flight diverged before the telemetry begins.
    """
    report = progress or (lambda _fraction, _what: None)
    if destination.is_symlink():
        destination = destination.resolve()
    _remove_leftovers(destination)
    check_destination(destination, replace)
    report(0.0, "flying")
    truth = fly_scenario(scenario, seed)
    _check_telemetry(scenario, truth)
    partial = partial_path(destination)
    with writing(destination, "choose another folder"):
        destination.parent.mkdir(parents=True, exist_ok=True)
        partial.mkdir(mode=0o755)
        try:
            _write(scenario, seed, truth, partial, report)
            _put_in_place(partial, destination)
        finally:
            shutil.rmtree(partial, ignore_errors=True)
    report(1.0, "done")
    return truth


def _check_telemetry(scenario: Scenario, truth: Truth) -> None:
    ended, begins = truth.time_s[-1], scenario.spec.time.telemetry_from_s
    if ended < begins + SHORTEST_TELEMETRY_S:
        why = truth.remark or ("it came down" if truth.altitude_m[-1] <= 0.0 else "stop_s is too early")
        raise GateError(
            f"scenario '{scenario.spec.name}': the flight ends at {ended:.2f} s ({why}); time.telemetry_from_s = "
            f"{begins:g} leaves less than {SHORTEST_TELEMETRY_S:g} s to deliver",
            code="time-not-covered",
        )


def _put_in_place(partial: Path, destination: Path) -> None:
    """Rename into place; the old folder is moved aside first and removed last, so that one of the two always exists."""
    if not destination.exists():
        partial.rename(destination)
        return
    old = partial_path(destination, OLD)
    destination.rename(old)
    partial.rename(destination)
    shutil.rmtree(old, ignore_errors=True)


def _remove_leftovers(destination: Path) -> None:
    """Remove leftovers of killed processes beside the destination; restore an old flight that has no successor."""
    for left in abandoned(destination.parent, destination.name, OLD):
        if destination.exists():
            shutil.rmtree(left, ignore_errors=True)
        else:
            left.rename(destination)
    for left in abandoned(destination.parent, destination.name):
        shutil.rmtree(left, ignore_errors=True)


def check_destination(destination: Path, replace: bool) -> None:
    """Refuse to overwrite anything but a synthetic flight folder."""
    if not destination.exists():
        return
    ours = (destination / "truth" / "run.json").is_file() and (destination / "flight.toml").is_file()
    if not replace:
        raise GateError(
            f"{destination}: exists already; choose another folder, or replace it (--force, in Python replace=True)",
            code="file-exists",
        )
    if not ours:
        raise GateError(
            f"{destination}: is not a synthetic flight folder, so --force does not replace it",
            code="file-exists",
        )


def _write(scenario: Scenario, seed: int, truth: Truth, folder: Path, report: Progress) -> None:
    spec, vehicle = scenario.spec, scenario.vehicle
    start = spec.time.telemetry_from_s
    telemetry = folder / "telemetry"
    telemetry.mkdir()
    report(0.15, "sensing")
    mount = spec.accelerometer.mount
    rng = child_rng(seed, mount)
    at, force = sensing.sense_accelerometer(truth, vehicle, mount, spec.accelerometer, start, rng)
    _csv(telemetry / "accelerometer.csv", {"t_s": at, **_named(f"a{{}}_{mount}_mps2", "xyz", force)}, "%.6f")
    at, rate = sensing.sense_rates(truth, spec.rates, start, child_rng(seed, "rates"))
    _csv(telemetry / "rates.csv", {"t_s": at, **_named("{}_body_degps", "pqr", np.rad2deg(rate))}, "%.6f")
    _write_attitude_sensors(scenario, seed, truth, telemetry)
    for name, radar in spec.radars.items():
        at, rae = sensing.sense_radar(truth, radar, start, child_rng(seed, name), name)
        columns = {"t_s": at, "range_m": rae[:, 0], "az_deg": np.rad2deg(rae[:, 1]), "el_deg": np.rad2deg(rae[:, 2])}
        columns |= {"range_rate_mps": rae[:, 3]} if rae.shape[1] > 3 else {}
        _csv(telemetry / f"radar_{name}.csv", columns, "%.6f")
    for name, receiver in spec.gnss.items():
        at, fixes = sensing.sense_gnss(truth, receiver, start, child_rng(seed, f"gnss {name}"), name)
        columns = {"t_s": at, **_named("{}_ecef_m", "xyz", fixes[:, :3]), **_named("v{}_ecef_mps", "xyz", fixes[:, 3:])}
        _csv(telemetry / f"gnss_{name}.csv", columns, "%.4f")
    z, air, wind = weather.sense_atmosphere(truth.profile, spec.atmosphere, child_rng(seed, "sounding"))
    columns = {"alt_m": z, "rho_kgpm3": air[:, 0], "t_k": air[:, 1], "wind_n_mps": wind[:, 0], "wind_e_mps": wind[:, 1]}
    _csv(telemetry / "atmosphere.csv", columns, "%.8g")
    q_prior = sensing.sense_attitude(truth, spec.attitude_prior, child_rng(seed, "attitude"))
    _write_truth(scenario, seed, truth, folder / "truth")
    write_videos(scenario, seed, truth, telemetry, report)
    write_flight_toml(scenario, q_prior, folder)


def _write_attitude_sensors(scenario: Scenario, seed: int, truth: Truth, telemetry: Path) -> None:
    spec, start = scenario.spec, scenario.spec.time.telemetry_from_s
    if spec.magnetometer is not None:
        rng = child_rng(seed, "magnetometer")
        at, field = sensing.sense_magnetometer(truth, scenario.vehicle, spec.magnetometer, start, rng)
        columns = {"t_s": at, **_named("b{}_magnetometer_ut", "xyz", field * 1e6)}
        _csv(telemetry / "magnetometer.csv", columns, "%.6f")
    if spec.sun is not None:
        at, angles = sensing.sense_sun(truth, spec.sun, start, child_rng(seed, "sun"))
        columns = {"t_s": at}
        for k, head in enumerate(np.moveaxis(np.rad2deg(angles), 1, 0), 1):
            columns |= {f"az_sun{k}_deg": head[:, 0], f"el_sun{k}_deg": head[:, 1]}
        _csv(telemetry / "sun.csv", columns, "%.6f")


def _named(pattern: str, letters: str, values: FloatArray) -> dict[str, FloatArray]:
    return {pattern.format(letter): column for letter, column in zip(letters, values.T, strict=True)}


def _csv(path: Path, columns: dict[str, FloatArray], form: str) -> None:
    values = np.column_stack([np.asarray(column, dtype=float) for column in columns.values()])
    row = ",".join([form] * len(columns)) + "\n"
    # all at once: four times as fast as pandas, and the same bytes
    text = row * len(values) % tuple(values.ravel().tolist())
    if np.isnan(values).any():
        text = text.replace("nan", "")
    path.write_text(",".join(columns) + "\n" + text, newline="\n")


def _write_truth(scenario: Scenario, seed: int, truth: Truth, folder: Path) -> None:
    folder.mkdir()
    every = max(1, round(1.0 / (TRUTH_RATE_HZ * scenario.spec.time.record_s)))
    rows = np.flatnonzero(truth.time_s >= scenario.spec.time.telemetry_from_s - 1e-9)[::every]
    t, path = truth.time_s[rows], truth.trajectory
    columns = {
        "t_s": t,
        **_named("r{}_ecef_m", "xyz", path.position_ecef_m[rows]),
        **_named("v{}_ecef_mps", "xyz", path.velocity_ecef_mps[rows]),
        **_named("q{}_ecef_body", "wxyz", path.q_ecef_body[rows]),
        **_named("{}_body_degps", "pqr", np.rad2deg(path.omega_body_eci_body_radps[rows])),
        "alt_m": truth.altitude_m[rows],
        "mach": truth.mach[rows],
        "dynamic_pressure_pa": truth.dynamic_pressure_pa[rows],
        "alpha_shell_deg": np.rad2deg(truth.alpha_shell_rad[rows]),
        "alpha_body_deg": np.rad2deg(truth.alpha_body_rad[rows]),
    }
    _csv(folder / "truth.csv", columns, "%.10g")
    deflection = truth.deflection
    columns = {
        "t_s": t,
        "theta_deg": np.rad2deg(deflection.theta_rad[rows]),
        "plane_lv_deg": np.rad2deg(deflection.plane_lv_rad[rows]),
        "twist_deg": np.rad2deg(truth.twist_rad[rows]),
    }
    _csv(folder / "deflection.csv", columns, "%.8f")
    events = event_table(flight_events(truth, scenario.spec.time.inflated_s))
    events.to_csv(folder / "events.csv", index=False, float_format="%.8g", lineterminator="\n")
    shutil.copyfile(scenario.source, folder / "scenario.toml")
    run = {"scenario": scenario.spec.name, "seed": seed, "words": truth.remark, "synthetic": True}
    (folder / "run.json").write_text(json.dumps(run, indent=2) + "\n")


VEHICLE_FOLDER = "vehicle"


def write_flight_toml(scenario: Scenario, q_prior: FloatArray, folder: Path) -> None:
    """Write ``flight.toml`` into a flight folder, and copy in a vehicle of the user's own with its table."""
    vehicle = scenario.spec.vehicle
    if vehicle.endswith(".toml"):
        source = scenario.vehicle.source
        for name in (source.name, *scenario.vehicle.files):
            copy = folder / VEHICLE_FOLDER / name
            copy.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(source.parent / name, copy)
        vehicle = f"{VEHICLE_FOLDER}/{source.name}"
    (folder / "flight.toml").write_text(_flight_toml(scenario, q_prior, vehicle), encoding="utf-8")


def _text(value: str) -> str:
    """Return a text as TOML writes it."""
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")


def _flight_toml(scenario: Scenario, q_prior: FloatArray, vehicle: str) -> str:
    """Return ``flight.toml`` with the errors of the data sheets and no drawn values."""
    spec = scenario.spec
    acc = spec.accelerometer
    lines = [
        "# SYNTHETIC flight, written by postflight simulate. Nothing in truth/ may be used to estimate.",
        f"name = {_text(spec.name)}",
        f"t0_utc = {_text(spec.t0_utc)}",
        f"vehicle = {_text(vehicle)}",
        "synthetic = true",
        "",
        "[attitude_prior]",
        f"t_s = {spec.attitude_prior.t_s}",
        f"q_ecef_body = [{', '.join(f'{x:.6f}' for x in q_prior)}]",
        f"sd_deg = {spec.attitude_prior.sd_deg}",
    ]
    lines += _table("sensors.accelerometer", "accelerometer", [f'mount = "{acc.mount}"'], ACCELEROMETER, acc)
    lines += _accelerometer_columns(acc.mount)
    lines += _table("sensors.rates", "rates", [], RATES, spec.rates)
    if spec.magnetometer is not None:
        mount = f'mount = "{spec.magnetometer.mount}"'
        lines += _table("sensors.magnetometer", "magnetometer", [mount], MAGNETOMETER, spec.magnetometer)
    if spec.sun is not None:
        heads = f"heads_lv_deg = [{', '.join(str(clock) for clock in spec.sun.heads_lv_deg)}]"
        lines += _table("sensors.sun", "sun", [heads, f"field_deg = {spec.sun.field_deg}"], SUN, spec.sun)
    for name, radar in spec.radars.items():
        place = [
            f"latitude_deg = {radar.latitude_deg}",
            f"longitude_deg = {radar.longitude_deg}",
            f"height_m = {radar.height_m}",
            *(['measures = ["range", "az", "el", "range_rate"]'] if radar.range_rate_sd_mps > 0.0 else []),
        ]
        tracking = [
            *([f'tracks = "{radar.tracks}"'] if radar.tracks != "cg" else []),
            *([f"angle_servo_hz = {radar.angle_servo_hz}"] if radar.angle_servo_hz > 0.0 else []),
        ]
        lines += _table(f"radars.{name}", f"radar_{name}", place, RADAR, radar, tracking)
    for name, receiver in spec.gnss.items():
        antenna = f"antenna_from_datum_body_m = {list(receiver.antenna_from_datum_body_m)}"
        lines += _table(f"gnss.{name}", f"gnss_{name}", [antenna], GNSS, receiver)
    lines += ["", "[atmosphere]", 'file = "telemetry/atmosphere.csv"']
    if spec.video is not None:
        lines += _video_lines("frames", "frames.csv", spec.video.camera, spec.video)
    for name, video in spec.videos.items():
        lines += _video_lines(f"cameras.{name}", f"frames_{name}.csv", name, video)
    for name, at_s in spec.event_times:
        if at_s >= spec.time.telemetry_from_s or scenario.vehicle.mass_steps:  # which may refer to it
            lines += ["", "[[events]]", f"name = {_text(name)}", f"t_s = {at_s}"]
    return "\n".join(lines) + "\n"


def _accelerometer_columns(mount: str) -> list[str]:
    """Lines that declare the accelerometer's columns if their names are not the default ones."""
    names = [(f"a{axis}", f"a{axis}_{mount}_mps2") for axis in "xyz"]
    if [name for _, name in names] == [quantity.canonical for quantity in tables.ACCELEROMETER]:
        return []
    return [f'columns.{short} = {{ column = "{name}", unit = "mps2" }}' for short, name in names]


def _video_lines(table: str, listed: str, name: str, video: Video) -> list[str]:
    images = video.format == "png"
    return [
        "",
        f"[{table}]",
        f'file = "telemetry/{listed}"',
        f'folder = "telemetry/{name}"' if images else f'film = "telemetry/{name}.{video.format}"',
        f'camera = "{video.camera}"',
        f"benchmark_s = {video.benchmark_s}",
        *([f"time_bias_sd_s = {video.time_offset_s}"] if 0.0 < video.time_offset_s <= 1.0 else []),
    ]


def _table(
    name: str, file: str, about: list[str], errors: InstrumentTable, spec: Section, more: Sequence[str] = ()
) -> list[str]:
    """Lines of an instrument's table: file, ``about``, the errors that are always stated, and nonzero optional ones."""
    stated, there = stated_errors(errors, spec), stated_errors(errors, spec, if_there=True)
    return ["", f"[{name}]", f'file = "telemetry/{file}.csv"', *about, *stated, *more, *there]


SUTTON_GRAVES = 1.7415e-4


@dataclass(frozen=True)
class Event:
    """An event of the flight and the true state at it.

    Altitude, Mach number and dynamic pressure are those at the shell's nose, position and velocity (relative to the
    rotating Earth) those of the datum; angles of attack are total and relative to the wind; ``sensed_g`` is the
    magnitude of the specific force at the undeflected vehicle's c.g., in standard gravities.
    """

    name: str
    time_s: float
    altitude_m: float
    latitude_rad: float
    longitude_rad: float
    speed_mps: float
    flight_path_rad: float
    airspeed_mps: float
    mach: float
    dynamic_pressure_pa: float
    heat_flux_wpm2: float
    alpha_shell_rad: float
    alpha_body_rad: float
    deflection_rad: float
    sensed_g: float


def heat_flux(density_kgpm3: FloatArray, airspeed_mps: FloatArray, nose_radius_m: float) -> FloatArray:
    """Stagnation-point convective heat flux to a cold wall, W/m^2 (Sutton and Graves)."""
    return SUTTON_GRAVES * np.sqrt(density_kgpm3 / nose_radius_m) * airspeed_mps**3


def flight_events(truth: Truth, inflated_s: float | None = None) -> list[Event]:
    """Events of a flight in order of time.

    Parameters
    ----------
    truth : Truth
    inflated_s : float or None
        When the joint was unlocked; no inflation is named without it.
    """
    whole = splashdown_index(truth.altitude_m)
    rows = slice(0, whole)
    t, altitude = truth.time_s[rows], truth.altitude_m[rows]
    density, pressure = truth.density_kgpm3[rows], truth.dynamic_pressure_pa[rows]
    airspeed = np.sqrt(2.0 * pressure / density)
    flux = heat_flux(density, airspeed, truth.vehicle.geometry.nose_radius_m)
    named = [("separation", float(t[0])), *descent_events(t, altitude, truth.mach[rows])]
    if inflated_s is not None and t[0] < inflated_s < t[-1]:
        named.append(("inflation", inflated_s))
    for name, values in (("peak heating", flux), ("peak dynamic pressure", pressure)):
        if has_peak(values):
            named.append((name, find_peak(t, values)[0]))
    if whole is not None:
        splash = first_fall(t, altitude, 0.0)
        named.append(("splashdown", float(t[-1]) if splash is None else splash))
    force = truth.specific_force_body(truth.vehicle.cg_m)[rows]
    columns = np.column_stack(
        [
            altitude,
            truth.trajectory.position_ecef_m[rows],
            truth.trajectory.velocity_ecef_mps[rows],
            airspeed,
            truth.mach[rows],
            pressure,
            flux,
            truth.alpha_shell_rad[rows],
            truth.alpha_body_rad[rows],
            truth.deflection.theta_rad[rows],
            np.linalg.norm(force, axis=1) / STANDARD_GRAVITY_MPS2,
        ]
    )
    return [_event(name, at, values_at(t, columns, at)) for name, at in sorted(named, key=lambda one: one[1])]


def _event(name: str, at_s: float, state: FloatArray) -> Event:
    place, velocity = state[1:4], state[4:7]
    latitude, longitude, _ = earth.geodetic_from_ecef(place)
    north, east, down = earth.ned_from_ecef(velocity, place)
    # angles and force are magnitudes: a cubic near zero may pass below it
    sizes = [float(x) for x in (*state[7:11], *np.maximum(state[11:], 0.0))]
    path = float(np.arctan2(-down, np.hypot(north, east)))
    speed = float(np.linalg.norm(velocity))
    return Event(name, at_s, float(state[0]), float(latitude), float(longitude), speed, path, *sizes)


def event_table(events: list[Event]) -> pd.DataFrame:
    """Events as a table with angles in degrees, as ``truth/events.csv`` holds it."""
    rows = [
        {
            "event": e.name,
            "t_s": e.time_s,
            "alt_m": e.altitude_m,
            "lat_deg": np.rad2deg(e.latitude_rad),
            "lon_deg": np.rad2deg(e.longitude_rad),
            "speed_ground_mps": e.speed_mps,
            "flight_path_deg": np.rad2deg(e.flight_path_rad),
            "airspeed_mps": e.airspeed_mps,
            "mach": e.mach,
            "dynamic_pressure_pa": e.dynamic_pressure_pa,
            "heat_flux_wpm2": e.heat_flux_wpm2,
            "alpha_shell_deg": np.rad2deg(e.alpha_shell_rad),
            "alpha_body_deg": np.rad2deg(e.alpha_body_rad),
            "deflection_deg": np.rad2deg(e.deflection_rad),
            "sensed_g": e.sensed_g,
        }
        for e in events
    ]
    import pandas as pd

    return pd.DataFrame(rows)
