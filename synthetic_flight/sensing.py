"""What would the instruments on and around the vehicle have measured of a true flight?

Truth plus the errors of real instruments: those of the tables in `flightmodel.instruments`, with the sizes of the
scenario, and the simulator's own (bandwidth, dropouts, quantisation). Each instrument draws from its own generator;
systematic errors are drawn once a flight, each from a child of its own.

A **radar**, in the order of the echo's way: time of the stamp, transit, refraction and delay in the air, lag of the
servo, errors of the pedestal and range scale as their rows say, waves of the encoders (once and twice a turn), tilt of
the pedestal (an exact rotation against the local vertical), slow wander, bias, noise, quantisation, lost points.

A **Sun head** sees the Sun inside its cone while the Sun stands above the Earth's limb. Per head: mounting, constant
part and noise normal to the line of sight, and the pull of the sunlit Earth, by which the direction turns towards
``s + w (u . s)+ (R / r)^2 nadir`` (``u`` up, ``w`` the weight ``albedo``): a crude model of the light that comes back,
largest over the subsolar point and zero on the night side.

References
----------
Range Commanders Council 753-95 (error model of tracking radars). Bean and Dutton, 1966, for the air
(`flightmodel.refraction`).
"""

from __future__ import annotations

import numpy as np
from scipy.constants import speed_of_light

from flightmodel import earth, rotations
from flightmodel.checks import BoolArray, FloatArray, GateError
from flightmodel.geomagnetism_and_sun import is_sun_visible, magnetic_field_ecef_t, sun_direction_ecef
from flightmodel.instruments import (
    BUTTERWORTH,
    GNSS,
    RADAR,
    SUN,
    dcm_body_from_sun_head,
    sun_angles_from_direction,
)
from flightmodel.refraction import refracted
from flightmodel.trajectory import interpolate_rows
from flightmodel.vehicle import Vehicle
from synthetic_flight.instrument_errors import (
    Accelerometer,
    Attitude,
    Gnss,
    Magnetometer,
    Radar,
    Rates,
    SunSensors,
    child,
    clock_late_s,
    filtered,
    gauss_markov,
    kept,
    measured,
    sampled,
)
from synthetic_flight.simulate import Truth


def sample_times(start_s: float, stop_s: float, rate_hz: float, offset_s: float = 0.0) -> FloatArray:
    """Times of samples at a rate, rounded to a microsecond so that files hold them exactly."""
    n = int(np.floor((stop_s - start_s - offset_s) * rate_hz + 1e-9)) + 1
    return np.round(start_s + offset_s + np.arange(n) / rate_hz, 6)


def sense_accelerometer(
    truth: Truth, vehicle: Vehicle, mount: str, spec: Accelerometer, start_s: float, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Times (n,) and specific force ``(n, 3)``, m/s^2, at the package's location and in its own axes.

    Where the three elements have places of their own, each feels the specific force there.
    """
    package, errors = vehicle.sensors[mount], spec.errors
    at = sample_times(start_s, truth.time_s[-1], spec.rate_hz)
    place, dcm = np.array(package.position_from_datum_body_m), package.dcm_body_sensor

    late_s = clock_late_s(errors, rng)

    def felt(position_from_datum_body_m: FloatArray) -> FloatArray:
        return sampled(at, truth.time_s, truth.specific_force_body(position_from_datum_body_m), errors, late_s) @ dcm

    if spec.elements_sensor_m:
        places = [place + dcm @ np.array(element) for element in spec.elements_sensor_m]
        ideal = np.column_stack([felt(each)[:, axis] for axis, each in enumerate(places)])
    else:
        ideal = felt(place)
    return measured(at, ideal, errors, rng)


def sense_rates(truth: Truth, spec: Rates, start_s: float, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """Times (n,) and rates ``(n, 3)`` of the body against inertial space, body axes, rad/s."""
    at = sample_times(start_s, truth.time_s[-1], spec.rate_hz)
    late_s = clock_late_s(spec.errors, rng)
    ideal = sampled(at, truth.time_s, truth.trajectory.omega_body_eci_body_radps, spec.errors, late_s)
    return measured(at, ideal, spec.errors, rng)


def sense_magnetometer(
    truth: Truth, vehicle: Vehicle, spec: Magnetometer, start_s: float, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Times (n,) and magnetic field ``(n, 3)`` in the package's own axes, tesla.

    The Earth's field at the package's own place, distorted by the vehicle's iron (symmetric matrix) and added to the
    field of its magnets; both are fixed to the vehicle.
    """
    package = vehicle.sensors[spec.mount]
    at = sample_times(start_s, truth.time_s[-1], spec.rate_hz)
    # the low-pass needs what was before the first sample
    rows = truth.time_s >= start_s - abs(spec.delay_s) - (10.0 / spec.bandwidth_hz if spec.bandwidth_hz > 0.0 else 0.1)
    t, q = truth.time_s[rows], truth.trajectory.q_ecef_body[rows]
    arm = np.broadcast_to(package.position_from_datum_body_m, (len(t), 3))
    place = truth.trajectory.position_ecef_m[rows] + rotations.rotate(q, arm)
    field = rotations.rotate(rotations.conjugate(q), magnetic_field_ecef_t(place, truth.trajectory.epoch_utc))
    soft_iron, hard_iron_t = spec.sizes["soft_iron_sd"][0], spec.sizes["bias_sd"][1]
    if soft_iron > 0.0:
        upper = np.triu(soft_iron * child(rng, "soft iron").standard_normal((3, 3)))
        field = field @ (np.eye(3) + upper + np.triu(upper, 1).T)
    if hard_iron_t > 0.0:
        field = field + hard_iron_t * child(rng, "hard iron").standard_normal(3)
    return measured(at, sampled(at, t, field, spec.errors) @ package.dcm_body_sensor, spec.errors, rng)


def sense_attitude(truth: Truth, spec: Attitude, rng: np.random.Generator) -> FloatArray:
    """Quaternion (4,) ECEF from body at one time, as stated by an external source."""
    q = rotations.slerp(truth.time_s, truth.trajectory.q_ecef_body, np.array([spec.t_s]))[0]
    return rotations.boxplus(q, np.deg2rad(spec.sd_deg) * rng.standard_normal(3))


def sense_sun(
    truth: Truth, spec: SunSensors, start_s: float, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Times (n,) and azimuth and elevation ``(n, heads, 2)``, rad, in each head's axes; NaN where it sees no Sun.

    Each head draws from a generator of its own, by its number.
    """
    at = sample_times(start_s, truth.time_s[-1], spec.rate_hz)
    seen_at = np.clip(at - spec.delay_s, truth.time_s[0], truth.time_s[-1])
    position = interpolate_rows(seen_at, truth.time_s, truth.trajectory.position_ecef_m)
    to_sun = sun_direction_ecef(truth.trajectory.epoch_utc, seen_at)
    lit = is_sun_visible(position, to_sun)
    to_body = rotations.conjugate(rotations.slerp(truth.time_s, truth.trajectory.q_ecef_body, seen_at))
    radius = np.linalg.norm(position, axis=1, keepdims=True)
    up = position / radius
    noon = np.maximum(np.sum(up * to_sun, axis=1, keepdims=True), 0.0)
    earthlight = -spec.albedo * noon * (earth.SEMI_MAJOR_M / radius) ** 2 * up
    sun_body, earth_body = rotations.rotate(to_body, to_sun), rotations.rotate(to_body, earthlight)
    heads = [
        _head(sun_body, earth_body, lit, clock, spec, child(rng, f"head {k}"))
        for k, clock in enumerate(np.deg2rad(spec.heads_lv_deg))
    ]
    angles = np.stack(heads, axis=1)
    if spec.dropouts:
        keep = kept(at, spec.dropouts.errors, child(rng, "dropouts"))
        return at[keep], angles[keep]
    return at, angles


def _head(
    sun_body: FloatArray,
    earth_body: FloatArray,
    lit: BoolArray,
    clock_lv_rad: float,
    spec: SunSensors,
    rng: np.random.Generator,
) -> FloatArray:
    """Azimuth and elevation ``(n, 2)`` of one head."""
    noise, bias, mount = (size for (size,) in SUN.from_scenario(spec).values())
    step = np.deg2rad(spec.resolution_deg)
    dcm = dcm_body_from_sun_head(clock_lv_rad) @ rotations.dcm_from_q(rotations.exp(mount * rng.standard_normal(3)))
    sun, glow = sun_body @ dcm, earth_body @ dcm
    edge = np.cos(0.5 * np.deg2rad(spec.field_deg))
    # the Earth fills half the sky: a head has its middle in view or takes none of its light
    light = sun + np.where(glow[:, 2:] > edge * np.linalg.norm(glow, axis=1, keepdims=True), glow, 0.0)
    angles = sun_angles_from_direction(light)
    error = bias * rng.standard_normal(2) + noise * rng.standard_normal(angles.shape)
    error[:, 0] /= np.maximum(np.cos(angles[:, 1]), 1e-3)
    angles = angles + error
    angles[:, 0] = np.mod(angles[:, 0] + np.pi, 2.0 * np.pi) - np.pi
    if step > 0.0:
        angles = np.round(angles / step) * step
    angles[~lit | (sun[:, 2] < edge)] = np.nan
    return np.asarray(angles)


def sense_gnss(
    truth: Truth, spec: Gnss, start_s: float, rng: np.random.Generator, name: str = "gnss"
) -> tuple[FloatArray, FloatArray]:
    """Times (n,) and fixes ``(n, 6)`` of a receiver's antenna: position ECEF m, velocity ECEF m/s.

    Noise and wander are drawn in north, east and down. A positive time bias stamps a fix later than it was measured.

    Raises
    ------
    GateError
        Where fewer than two fixes are left.
    """
    from scipy.interpolate import CubicHermiteSpline  # a fifth of a second, for commands that do not simulate

    at = sample_times(start_s, truth.time_s[-1] - 0.05, spec.rate_hz, spec.offset_s)
    size = {key: values[0] for key, values in GNSS.from_scenario(spec).items()}
    late = size["time_bias_sd_s"] * rng.standard_normal()
    seen_at = np.clip(at - late, truth.time_s[0], truth.time_s[-1])
    path, arm = truth.trajectory, np.array(spec.antenna_from_datum_body_m)
    q = path.q_ecef_body
    # of the body against the Earth
    turn = path.omega_body_eci_body_radps - rotations.rotate(rotations.conjugate(q), earth.OMEGA_ECEF_RADPS)
    position = path.position_ecef_m + rotations.rotate(q, np.broadcast_to(arm, path.position_ecef_m.shape))
    velocity = path.velocity_ecef_mps + rotations.rotate(q, np.cross(turn, arm))
    place = CubicHermiteSpline(truth.time_s, position, velocity)(seen_at)
    moving = interpolate_rows(seen_at, truth.time_s, velocity)
    across, up = size["horizontal_sd_m"], size["vertical_sd_m"]
    of_place = rng.standard_normal((len(at), 3)) * [across, across, up]
    across, up = size["speed_sd_mps"], size["vertical_speed_sd_mps"]
    of_speed = rng.standard_normal((len(at), 3)) * [across, across, up]
    if size["wander_sd_m"] > 0.0:
        wandering = child(rng, "wander")
        of_place += gauss_markov(at, size["wander_sd_m"], size["wander_time_constant_s"], 3, wandering)
    if size["velocity_wander_sd_mps"] > 0.0:
        sd, tau_s = size["velocity_wander_sd_mps"], size["velocity_wander_time_constant_s"]
        of_speed += gauss_markov(at, sd, tau_s, 3, child(rng, "velocity wander"))
    fixes = np.column_stack(
        [place + earth.ecef_from_ned(of_place, place), moving + earth.ecef_from_ned(of_speed, place)]
    )
    keep = np.ones(len(at), dtype=bool)
    if spec.dropouts:
        keep = kept(at, spec.dropouts.errors, child(rng, "dropouts"))
    if keep.sum() < 2:
        raise GateError(
            f"gnss.{name}: {keep.sum()} fixes from {start_s + spec.offset_s:g} s to the flight's end at "
            f"{truth.time_s[-1]:.2f} s; two are the least: raise rate_hz, or shorten its dropouts",
            code="track-short",
        )
    return at[keep], fixes[keep]


LOWEST_RAD = np.deg2rad(0.5)


def sense_radar(
    truth: Truth, spec: Radar, start_s: float, rng: np.random.Generator, name: str = "radar"
) -> tuple[FloatArray, FloatArray]:
    """Times (n,) and slant range m, azimuth, elevation rad ``(n, 3)`` of the vehicle's true c.g. (or its datum).

    A fourth column is the range rate, m/s, where the radar measures one.

    Angle noise is that of the beam: normal to the line of sight, so azimuth scatters by ``1 / cos(elevation)`` more. A
    positive time bias stamps a point later than it was measured.

    Raises
    ------
    GateError
        Where fewer than two points are left, with ``name`` and what took them.
    """
    at = sample_times(start_s, truth.time_s[-1] - 0.05, spec.rate_hz, spec.offset_s)
    if len(at) < 2:
        raise GateError(
            f"radars.{name}: {len(at)} points from {start_s + spec.offset_s:g} s to the flight's end at "
            f"{truth.time_s[-1]:.2f} s; two are the least: raise rate_hz or lower offset_s",
            code="track-short",
        )
    size = RADAR.from_scenario(spec)
    bias_sd = np.array([size["range_bias_sd_m"][0], *[size["angle_bias_sd_rad"][0]] * 2])
    bias = bias_sd * rng.standard_normal(3)
    late = size["time_bias_sd_s"][0] * rng.standard_normal()
    seen_at = np.clip(at - late, truth.time_s[0], truth.time_s[-1])
    arrived = echo(truth, spec, seen_at)
    noise_sd = np.array([size["range_sd_m"][0], *[size["angle_sd_rad"][0]] * 2])
    noise = noise_sd * rng.standard_normal(arrived.shape)
    noise[:, 1] /= np.cos(arrived[:, 2])
    # the stated bandwidth is not exactly the servo's
    lag = 1.0 + drawn(rng, "servo lag", size["servo_lag_sd"][0], 1)
    observed = in_air(arrived, spec) + lag * servo_lag(truth, spec, seen_at)
    measured = observed + pedestal_errors(observed, spec, rng) + wander(at, observed, spec, rng) + bias + noise
    steps = (spec.range_resolution_m, *np.deg2rad([spec.angle_resolution_deg] * 2))
    for column, step in enumerate(steps):
        if step > 0.0:
            measured[:, column] = np.round(measured[:, column] / step) * step
    measured[:, 1] = np.mod(measured[:, 1], 2.0 * np.pi)
    if spec.range_rate_sd_mps > 0.0:
        measured = np.column_stack([measured, range_rates(truth, spec, at, seen_at, child(rng, "range rate"))])
    keep = np.ones(len(at), dtype=bool)
    if spec.dropouts:
        keep &= kept(at, spec.dropouts.errors, child(rng, "dropouts"))
    near = np.full(len(at), True) if spec.max_range_m is None else arrived[:, 0] <= spec.max_range_m
    above = arrived[:, 2] >= np.deg2rad(spec.min_elevation_deg)
    if (keep & near & above).sum() < 2:
        highest, nearest = np.rad2deg(arrived[:, 2].max()), arrived[:, 0].min()
        raise GateError(
            f"radars.{name}: fewer than two of {len(at)} points are tracked; elevation is {highest:.2f} deg at most "
            f"(min_elevation_deg = {spec.min_elevation_deg:g}), range {nearest:.0f} m at least (max_range_m = "
            f"{'none' if spec.max_range_m is None else format(spec.max_range_m, 'g')}), dropouts take "
            f"{(~keep).sum()}; put the radar elsewhere or leave it out",
            code="track-short",
        )
    keep &= near & above
    return at[keep], measured[keep]


def echo(truth: Truth, spec: Radar, time_s: FloatArray) -> FloatArray:
    """Geometric slant range m, azimuth, elevation rad ``(n, 3)`` of the echo that arrives at a time.

    With ``transit_time`` it shows the vehicle where it was hit, ``R / c`` earlier.
    """
    from scipy.interpolate import CubicHermiteSpline  # a fifth of a second

    if spec.tracks == "cg":
        path = CubicHermiteSpline(truth.time_s, truth.state_eci[:, 0:3], truth.state_eci[:, 3:6])
    else:
        datum = truth.trajectory
        path = CubicHermiteSpline(truth.time_s, datum.position_ecef_m, datum.velocity_ecef_mps)
    site = np.deg2rad([spec.latitude_deg, spec.longitude_deg])

    def geometric(at: FloatArray) -> FloatArray:
        position = path(at)
        ecef = rotations.rotate(earth.q_ecef_eci(at), position) if spec.tracks == "cg" else position
        return earth.radar_from_ecef(ecef, site[0], site[1], spec.height_m)

    now = geometric(time_s)
    if not spec.transit_time:
        return now
    # the range changes by 1 m in the half millisecond of transit: twice round is exact to a nanometre
    for _ in range(2):
        now = geometric(np.maximum(time_s - now[:, 0] / speed_of_light, truth.time_s[0]))
    return now


def range_rates(
    truth: Truth, spec: Radar, time_s: FloatArray, seen_at_s: FloatArray, rng: np.random.Generator
) -> FloatArray:
    """Doppler (n,): range rate of the echo, m/s, at the times the radar saw it, with Doppler errors."""
    step_s = 1e-3  # a jerk of 1000 m/s3 makes 0.2 mm/s
    before, after = (np.clip(seen_at_s + s, truth.time_s[0], truth.time_s[-1]) for s in (-step_s, step_s))
    rate = (echo(truth, spec, after)[:, 0] - echo(truth, spec, before)[:, 0]) / (after - before)
    size = {key: values[0] for key, values in RADAR.from_scenario(spec).items() if key.startswith("range_rate")}
    rate += size["range_rate_bias_sd_mps"] * child(rng, "bias").standard_normal()
    sd, tau_s = size["range_rate_wander_sd_mps"], size["range_rate_wander_time_constant_s"]
    if sd > 0.0:
        rate += gauss_markov(time_s, sd, tau_s, 1, child(rng, "wander"))[:, 0]
    return np.asarray(rate + size["range_rate_sd_mps"] * rng.standard_normal(len(time_s)))


def in_air(geometric: FloatArray, spec: Radar) -> FloatArray:
    """Range, azimuth, elevation ``(n, 3)`` with the refraction that the range's correction leaves.

    Below 0.5 deg of elevation, where layers along the horizon rule, refraction stays what it is there.
    """
    if spec.refraction is None or spec.refraction.residual == 0.0:
        return geometric
    air = spec.refraction.air
    elevation = np.maximum(geometric[:, 2], LOWEST_RAD)
    delay, refraction = refracted(geometric[:, 0], elevation, np.deg2rad(spec.latitude_deg), spec.height_m, air)
    return geometric + spec.refraction.residual * np.column_stack([delay, np.zeros_like(delay), refraction])


def servo_lag(truth: Truth, spec: Radar, time_s: FloatArray) -> FloatArray:
    """Lag ``(n, 3)`` of the angles behind a servo without velocity lag: ``- acceleration / w^2`` when slow."""
    if spec.angle_servo_hz == 0.0:
        return np.zeros((len(time_s), 3))
    # ten seconds before the first point the servo has lost its start (0.1 Hz and up)
    rows = truth.time_s >= time_s[0] - max(10.0, 3.0 / spec.angle_servo_hz)
    t = truth.time_s[rows]
    angles = np.unwrap(echo(truth, spec, t)[:, 1:], axis=0)
    w = 2.0 * np.pi * spec.angle_servo_hz
    damping = 2.0 * BUTTERWORTH * w
    behind = filtered(angles, float(t[1] - t[0]), [damping, w * w], [1.0, damping, w * w]) - angles
    return np.column_stack([np.zeros(len(time_s)), *(np.interp(time_s, t, column) for column in behind.T)])


def drawn(rng: np.random.Generator, name: str, size: float, count: int) -> FloatArray:
    """Constant errors (count,) of one standard deviation, from the named child of the generator."""
    # np.zeros keeps an absent error from costing a generator
    return size * child(rng, name).standard_normal(count) if size > 0.0 else np.zeros(count)


def pedestal_errors(observed: FloatArray, spec: Radar, rng: np.random.Generator) -> FloatArray:
    """Systematic errors ``(n, 3)`` that the pedestal adds to range, azimuth and elevation."""
    slant, az, el = observed.T
    out = np.zeros_like(observed)
    size = RADAR.from_scenario(spec)
    for row in RADAR.rows:
        if row.response is not None:
            component, response = row.response
            out[:, component] += response(drawn(rng, row.title, size[row.name][0], 1), slant, az, el)
    for turns, (name, wave_rad) in enumerate(zip(("once", "twice"), size["angle_bias_sd_rad"][1:], strict=True), 1):
        wave = drawn(rng, f"encoder {name}", wave_rad, 4)
        out[:, 1] += wave[0] * np.sin(turns * az) + wave[1] * np.cos(turns * az)
        out[:, 2] += wave[2] * np.sin(turns * el) + wave[3] * np.cos(turns * el)
    tilt_rad = size["mislevel_sd_rad"][0]
    if tilt_rad > 0.0:
        out[:, 1:] += mislevel(az, el, drawn(rng, "mislevel", tilt_rad, 2))
    return out


def mislevel(azimuth_rad: FloatArray, elevation_rad: FloatArray, tilt_rad: FloatArray) -> FloatArray:
    """Errors ``(n, 2)`` in azimuth and elevation of a pedestal rotated by ``tilt_rad`` (2,) about north and east."""
    turn = rotations.dcm_from_q(rotations.exp(np.array([*tilt_rad, 0.0])))
    level = np.column_stack(
        [
            np.cos(elevation_rad) * np.cos(azimuth_rad),
            np.cos(elevation_rad) * np.sin(azimuth_rad),
            -np.sin(elevation_rad),
        ]
    )
    north, east, down = (level @ turn).T
    az = np.arctan2(east, north) - azimuth_rad
    el = np.arctan2(-down, np.hypot(north, east)) - elevation_rad
    return np.column_stack([np.mod(az + np.pi, 2.0 * np.pi) - np.pi, el])


def wander(time_s: FloatArray, observed: FloatArray, spec: Radar, rng: np.random.Generator) -> FloatArray:
    """Gauss-Markov errors ``(n, 3)`` of range and angles; both angles have one sd normal to the line of sight."""
    out = np.zeros_like(observed)
    size = RADAR.from_scenario(spec)
    (sd,), (tau_s,) = size["range_wander_sd_m"], size["range_wander_time_constant_s"]
    if sd > 0.0:
        out[:, 0] = gauss_markov(time_s, sd, tau_s, 1, child(rng, "range wander"))[:, 0]
    (sd,), (tau_s,) = size["wander_sd_rad"], size["wander_time_constant_s"]
    if sd > 0.0:
        out[:, 1:] = gauss_markov(time_s, sd, tau_s, 2, child(rng, "wander"))
        out[:, 1] /= np.cos(observed[:, 2])
    return out
