"""Which stiffness does the joint's oscillation frequency alone imply?

The fit only limits the search to within a factor of two of its stiffness. Lateral rates and specific force,
rotated into axes that do not spin, are cut into overlapping windows. The logarithm of their spectra over the noise is
averaged along the frequency ``f(K; q, Mach, V)`` that the linear model (`flightmodel.linear`) predicts for the
joint's mode in every window, for both senses of rotation. The stiffness ``K`` with the largest mean is the estimate.
Start, damping, offset and wind take no part; the uncertainty of masses, stations, inertias and coefficients is
propagated by differences.

Assumed: small angles, constant dynamic pressure over a window, and a spin slow against the mode (both senses are
averaged, so that their opposite shifts cancel).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flightmodel.checks import FloatArray, GateError
from flightmodel.linear import linear_matrix, modes, slopes_at
from flightmodel.statistics import jackknife_variance
from flightmodel.vehicle import Vehicle
from postflight.reconciliation.forward_model import STIFFNESS_LOG_SD, VehicleParameters
from postflight.reconstruction import Reconstruction

RATE_HZ = 50.0  # ten samples a period of the joint at 5 Hz
WINDOW, HOP, PADDED = 256, 32, 2048  # 5 s resolve 0.2 Hz; a hop of 0.6 s follows the pressure; padded to 0.02 Hz
LEAST_PRESSURE_PA = 20.0  # below it hardly anything drives the joint
# of the stiffness to look about: farther off the vehicle's oscillation in the flow passes for a softer joint's
FACTORS = np.exp(np.linspace(np.log(0.5), np.log(2.0), 141))
MOST_SPIN = 0.1  # of the joint's frequency: the mode is off by the square of it, a percent
EDGE = 5  # of `FACTORS` at either end: a largest mean there belongs to a line outside
BLOCKS = 6  # whose scatter gives the sd
DIFFERENCE = 0.05  # of a standard deviation
# mean logarithm of power over noise along the best track: noise alone -0.2 +/- 0.17, the best of all its tracks 0.2
LEAST_LOG_POWER = 0.65


@dataclass(frozen=True)
class ModalStiffness:
    """Stiffness by the joint's frequency.

    Parameters
    ----------
    stiffness_nmprad, sd_nmprad : float
        The sd combines the scatter between parts of the pulse and the vehicle's uncertainty.
    time_s : (n,) float
        Middles of the windows.
    frequency_hz : (k,) float
        Both senses of rotation.
    power : (n, k) float
        Logarithm of the spectra over their noise, rates and force together.
    joint_hz, aerodynamic_hz : (n,) float
        Frequencies of the linear model with this stiffness.
    factor, mean_log_power : (m,) float
        Of the stiffness looked about, and mean logarithm of power over noise along its track.
    """

    stiffness_nmprad: float
    sd_nmprad: float
    time_s: FloatArray
    frequency_hz: FloatArray
    power: FloatArray
    joint_hz: FloatArray
    aerodynamic_hz: FloatArray
    factor: FloatArray
    mean_log_power: FloatArray


def stiffness_from_modes(flight: Reconstruction, about_nmprad: float) -> ModalStiffness:
    """Track the joint's mode through the pressure pulse, for stiffnesses from half to twice a given one.

    Raises
    ------
    GateError
        Where vehicle or sensors are missing, the pulse is shorter than a few windows, or no mode stands out.
    """
    pulse = flight.required_loads()
    nominal = pulse.vehicle
    about = about_nmprad / nominal.joint.bending_stiffness_nmprad
    t, log_power = _spectra(flight, pulse.time_s)
    pressure = np.interp(t, pulse.time_s, pulse.dynamic_pressure_pa)
    use = pressure > LEAST_PRESSURE_PA
    if use.sum() < BLOCKS:
        message = f"modes: {use.sum()} windows with more than {LEAST_PRESSURE_PA:g} Pa; {BLOCKS} are wanted"
        raise GateError(message, code="too-few-data")
    t, log_power, pressure = t[use], log_power[use], pressure[use]
    flow = pressure, np.interp(t, pulse.time_s, pulse.mach), np.interp(t, pulse.time_s, pulse.airspeed_mps)
    frequency = np.asarray(np.fft.fftfreq(PADDED, 1.0 / RATE_HZ), dtype=np.float64)
    power = np.array([_track_power(frequency, log_power, track) for track in _tracks(nominal, about, flow)])
    mean_log_power = power.mean(axis=1)
    if mean_log_power.max() < LEAST_LOG_POWER:
        message = (
            f"modes: largest mean logarithm of power over noise {mean_log_power.max():.2f}, at least "
            f"{LEAST_LOG_POWER:g} is wanted: the joint's oscillation cannot be detected in the pulse"
        )
        raise GateError(message, code="not-observable")
    if not EDGE <= np.argmax(mean_log_power) < len(FACTORS) - EDGE:
        message = (
            f"modes: from {FACTORS[0] * about_nmprad:.0f} to {FACTORS[-1] * about_nmprad:.0f} N m/rad the power along "
            "the joint's frequency has its maximum at an end: the spectral line is not the joint's"
        )
        raise GateError(message, code="not-observable")
    best = _peak(mean_log_power)
    parts = np.array_split(np.arange(len(t)), BLOCKS)
    without = np.array([_peak(np.delete(power, part, axis=1).mean(axis=1)) for part in parts])
    factor = about * float(np.exp(best))
    aerodynamic, joint = _frequencies(_stiffer(nominal, factor), flow)
    _check_spin(flight, joint, t)
    sd = float(np.hypot(np.sqrt(jackknife_variance(without)), _vehicle_sd(nominal, factor, flow)))
    stiffness = nominal.joint.bending_stiffness_nmprad * factor
    order = np.argsort(frequency)
    return ModalStiffness(
        stiffness, stiffness * sd, t, frequency[order], log_power[:, order], joint, aerodynamic, FACTORS, mean_log_power
    )


def _check_spin(flight: Reconstruction, joint_hz: FloatArray, time_s: FloatArray) -> None:
    """Refuse a spin that is not slow against the mode."""
    bet = flight.solution
    during = (bet.imu_time_s >= time_s[0]) & (bet.imu_time_s <= time_s[-1])
    spin_hz = float(np.median(np.abs(bet.rate_body_radps[during, 0]))) / (2.0 * np.pi)
    mode_hz = float(np.nanmedian(joint_hz))
    if spin_hz > MOST_SPIN * mode_hz:
        message = (
            f"modes: the vehicle spins at {60.0 * spin_hz:.0f} rpm, more than {MOST_SPIN:g} of the joint's "
            f"{mode_hz:.1f} Hz: the model of a vehicle without spin does not apply"
        )
        raise GateError(message, code="spin-too-fast")


def _spectra(flight: Reconstruction, span_s: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Times (n,) and logarithms (n, PADDED) of power over noise, means of rates and force."""
    bet = flight.solution
    grid = np.arange(span_s[0], span_s[-1], 1.0 / RATE_HZ)
    if len(grid) < WINDOW + HOP:
        raise GateError(
            f"modes: {len(grid) / RATE_HZ:.1f} s of pulse; at least {(WINDOW + HOP) / RATE_HZ:.1f} s are wanted",
            code="too-few-data",
        )
    rate = np.column_stack([np.interp(grid, bet.imu_time_s, c) for c in bet.rate_body_radps.T])
    force = np.column_stack([np.interp(grid, bet.imu_time_s, c) for c in bet.specific_force_body_mps2.T])
    despun = np.exp(1j * np.cumsum(rate[:, 0]) / RATE_HZ)
    starts = np.arange(0, len(grid) - WINDOW, HOP)
    total = np.zeros((len(starts), PADDED))
    for lateral in (rate[:, 1] + 1j * rate[:, 2], force[:, 1] + 1j * force[:, 2]):
        # differences reduce the leakage of slow motion
        difference = np.diff(lateral * despun, append=0.0)
        pieces = difference[starts[:, None] + np.arange(WINDOW)] * np.hanning(WINDOW)
        power = np.abs(np.fft.fft(pieces, PADDED, axis=1)) ** 2
        total += 0.5 * np.log(power / np.median(power, axis=1, keepdims=True))
    return grid[starts] + 0.5 * WINDOW / RATE_HZ, total


def _tracks(nominal: Vehicle, about: float, flow: tuple[FloatArray, FloatArray, FloatArray]) -> FloatArray:
    """Frequencies of the joint's mode (factors, n), Hz, interpolated linearly between every tenth of `FACTORS`."""
    coarse = FACTORS[::10]
    known = np.array([_frequencies(_stiffer(nominal, about * factor), flow)[1] for factor in coarse])
    return np.column_stack([np.interp(np.log(FACTORS), np.log(coarse), column) for column in known.T])


def _stiffer(nominal: Vehicle, factor: float) -> Vehicle:
    return VehicleParameters(nominal).vehicle(_at_stiffness(nominal, factor))


def _at_stiffness(nominal: Vehicle, factor: float) -> FloatArray:
    x = np.zeros(len(VehicleParameters(nominal).names))
    x[0] = np.log(factor) / STIFFNESS_LOG_SD
    return x


def _frequencies(vehicle: Vehicle, flow: tuple[FloatArray, FloatArray, FloatArray]) -> tuple[FloatArray, FloatArray]:
    """Frequencies of the aerodynamic and the joint's mode, Hz, each (n,); NaN where one does not oscillate."""
    out = np.full((2, len(flow[0])), np.nan)
    pressure, mach, speed = flow
    at = zip(slopes_at(vehicle, mach), pressure.tolist(), speed.tolist(), strict=True)
    for k, (slopes, load, fast) in enumerate(at):
        found = modes(linear_matrix(vehicle, slopes, load, fast)).frequencies_hz
        out[1, k] = found[-1] if len(found) else np.nan
        out[0, k] = found[-2] if len(found) > 1 else np.nan
    return out[0], out[1]


def _track_power(frequency_hz: FloatArray, log_power: FloatArray, track_hz: FloatArray) -> FloatArray:
    """Mean log power of both senses of rotation at a track's frequencies, (n,); zero if the mode does not oscillate."""
    step = frequency_hz[1]
    known = np.isfinite(track_hz)
    near = np.where(known, np.nan_to_num(track_hz) / step, 0.0)
    rows, low = np.arange(len(track_hz)), np.floor(near).astype(int)
    share = near - low
    out = np.zeros(len(track_hz))
    for sense in (1, -1):
        here, there = (log_power[rows, (sense * k) % len(frequency_hz)] for k in (low, low + 1))
        out += 0.5 * ((1.0 - share) * here + share * there)
    return np.where(known, out, 0.0)


def _peak(mean_log_power: FloatArray) -> float:
    """Logarithm of the factor at the largest mean, by a parabola."""
    k = int(np.clip(np.argmax(mean_log_power), 1, len(mean_log_power) - 2))
    left, middle, right = mean_log_power[k - 1 : k + 2]
    curvature = left - 2.0 * middle + right
    shift = 0.0 if curvature >= 0.0 else float(np.clip(0.5 * (left - right) / curvature, -1.0, 1.0))
    return float(np.log(FACTORS[k]) + shift * np.log(FACTORS[1] / FACTORS[0]))


def _vehicle_sd(nominal: Vehicle, factor: float, flow: tuple[FloatArray, FloatArray, FloatArray]) -> float:
    """Sd of the log stiffness due to the vehicle's uncertainty, at a fixed joint frequency."""
    parameters = VehicleParameters(nominal)

    def mean_log_hz(x: FloatArray) -> float:
        return float(np.nanmean(np.log(_frequencies(parameters.flown(x), flow)[1])))

    x = _at_stiffness(nominal, factor)
    base = mean_log_hz(x)
    slopes = {}
    for k, name in enumerate(parameters.names):
        if name not in ("damping", "offset y", "offset z"):
            moved = x.copy()
            moved[k] += DIFFERENCE
            slopes[name] = (mean_log_hz(moved) - base) / DIFFERENCE
    by_stiffness = slopes.pop("stiffness") / STIFFNESS_LOG_SD
    return float(np.sqrt(sum(s**2 for s in slopes.values())) / abs(by_stiffness))
