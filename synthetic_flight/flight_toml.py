"""What an analyst is told of a synthetic flight: ``flight.toml``, and beside it the vehicle file it needs.

The folder holds by itself: a vehicle that ships with the toolkit is named, another one is copied in with its
coefficient table, and nothing refers to a place outside.
"""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np

from flightmodel.checks import FloatArray
from synthetic_flight.instrument_sections import Magnetometer, Radar, SunSensors, Triad
from synthetic_flight.scenarios import ACCELEROMETER_MOUNT, Scenario

# the last digit of the telemetry's files: noise below it is not in them, and an estimator wants none of zero
LAST_DIGIT = 1e-6
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


def _at_least(sd: float, resolution: float = 0.0) -> float:
    """Return the standard deviation that is told: an ideal instrument has that of its steps or of the last digit."""
    return sd if sd >= LAST_DIGIT else max(LAST_DIGIT, round(resolution / np.sqrt(12.0), 9))


def _flight_toml(scenario: Scenario, q_prior: FloatArray, vehicle: str) -> str:
    """Return ``flight.toml`` with nominal errors: what an analyst would be told, nothing that was drawn."""
    spec = scenario.spec
    acc, gyro = spec.accelerometer, spec.rates
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
        "",
        "[sensors.accelerometer]",
        'file = "telemetry/accelerometer.csv"',
        f'mount = "{ACCELEROMETER_MOUNT}"',
        f"noise_sd_mps2 = {_at_least(acc.noise_mps2)}",
        f"bias_sd_mps2 = {acc.bias_mps2}",
        *_triad_lines(acc),
        f"time_bias_sd_s = {acc.time_bias_s}",
        f"resolution_mps2 = {acc.resolution_mps2}",
        *_drift_lines("mps2", acc.drift_mps2, acc.drift_time_constant_s),
        "",
        "[sensors.rates]",
        'file = "telemetry/rates.csv"',
        f"noise_sd_degps = {_at_least(gyro.noise_degps)}",
        f"bias_sd_degps = {gyro.bias_degps}",
        *_triad_lines(gyro),
        f"time_bias_sd_s = {gyro.time_bias_s}",
        f"resolution_degps = {gyro.resolution_degps}",
        *_drift_lines("degps", gyro.drift_degps, gyro.drift_time_constant_s),
    ]
    lines += _magnetometer_lines(spec.magnetometer) + _sun_lines(spec.sun)
    for name, radar in spec.radars.items():
        lines += [
            "",
            f"[radars.{name}]",
            f'file = "telemetry/radar_{name}.csv"',
            f"latitude_deg = {radar.latitude_deg}",
            f"longitude_deg = {radar.longitude_deg}",
            f"height_m = {radar.height_m}",
            f"range_sd_m = {_at_least(radar.range_sd_m, radar.range_resolution_m)}",
            f"angle_sd_deg = {_at_least(radar.angle_sd_deg, radar.angle_resolution_deg)}",
            f"range_bias_sd_m = {radar.range_bias_m}",
            # over the arc of one flight an encoder's waves are hardly told from a bias
            f"angle_bias_sd_deg = {_together(radar.angle_bias_deg, radar.encoder_once_deg, radar.encoder_twice_deg)}",
            f"time_bias_sd_s = {radar.time_bias_s}",
            *_pedestal_lines(radar),
        ]
    lines += ["", "[atmosphere]", 'file = "telemetry/atmosphere.csv"']
    if spec.video is not None:
        lines += [
            "",
            "[frames]",
            'file = "telemetry/frames.csv"',
            f'folder = "telemetry/{spec.video.camera}"'
            if spec.video.format == "png"
            else f'film = "telemetry/{spec.video.camera}.{spec.video.format}"',
            f'camera = "{spec.video.camera}"',
            f"benchmark_s = {spec.video.benchmark_s}",
            *([f"time_bias_sd_s = {spec.video.time_offset_s}"] if 0.0 < spec.video.time_offset_s <= 1.0 else []),
        ]
    if spec.time.inflated_s is not None and spec.time.inflated_s >= spec.time.telemetry_from_s:
        lines += ["", "[[events]]", 'name = "aeroshell inflated"', f"t_s = {spec.time.inflated_s}"]
    return "\n".join(lines) + "\n"


def _together(*sds: float) -> float:
    """Return the one number that is told of independent errors; of a single one, that number as it was written."""
    present = [sd for sd in sds if sd > 0.0]
    return present[0] if len(present) == 1 else float(f"{np.linalg.norm(present):.4g}")


def _triad_lines(spec: Triad) -> list[str]:
    """Axes that are not square are told with the mounting, what negative values gain with the scale."""
    return [
        f"scale_sd = {_together(spec.scale, spec.scale_asymmetry)}",
        f"mount_sd_deg = {_together(spec.mount_deg, spec.nonorthogonality_deg)}",
    ]


def _drift_lines(unit: str, drift: float, time_constant_s: float) -> list[str]:
    return [f"bias_wander_sd_{unit} = {drift}", f"bias_time_constant_s = {time_constant_s}"] if drift > 0.0 else []


def _magnetometer_lines(spec: Magnetometer | None) -> list[str]:
    if spec is None:
        return []
    return [
        "",
        "[sensors.magnetometer]",
        'file = "telemetry/magnetometer.csv"',
        f'mount = "{spec.mount}"',
        f"noise_sd_ut = {_at_least(spec.noise_ut)}",
        # the analyst is told one number for electronics and hard iron together
        f"bias_sd_ut = {np.hypot(spec.bias_ut, spec.hard_iron_ut):.4g}",
        f"soft_iron_sd = {spec.soft_iron}",
        *_triad_lines(spec),
        f"resolution_ut = {spec.resolution_ut}",
        *_drift_lines("ut", spec.drift_ut, spec.drift_time_constant_s),
    ]


def _sun_lines(spec: SunSensors | None) -> list[str]:
    if spec is None:
        return []
    return [
        "",
        "[sensors.sun]",
        'file = "telemetry/sun.csv"',
        f"heads_lv_deg = [{', '.join(str(clock) for clock in spec.heads_lv_deg)}]",
        f"field_deg = {spec.field_deg}",
        f"noise_sd_deg = {_at_least(spec.noise_deg, spec.resolution_deg)}",
        f"bias_sd_deg = {spec.bias_deg}",
        f"mount_sd_deg = {spec.mount_deg}",
    ]


def _pedestal_lines(radar: Radar) -> list[str]:
    """Systematic errors that are there; a radar without any is described as it always was."""
    terms = ("mislevel", "droop", "skew", "nonorthogonality", "wander")
    sizes = {name: getattr(radar, f"{name}_deg") for name in terms}
    lines = [f"{name}_sd_deg = {size}" for name, size in sizes.items() if size > 0.0]
    if radar.wander_deg > 0.0:
        lines.append(f"wander_time_constant_s = {radar.wander_time_constant_s}")
    if radar.refraction is not None and radar.refraction.residual != 0.0:
        lines.append(f"refraction_sd = {abs(radar.refraction.residual)}")
    if radar.range_scale > 0.0:
        lines.append(f"range_scale_sd = {radar.range_scale}")
    return ([f'tracks = "{radar.tracks}"'] if radar.tracks != "cg" else []) + lines
