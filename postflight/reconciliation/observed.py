"""What a simulated flight is held against: corrected inertial sensors over windows, in short spans.

Rates and specific force at the accelerometer are what the joint's motion was felt by; angle of attack and normal
acceleration follow from them, from the attitude and from the air. Deflections by misalignment and trim are made of the
same sensors and would count them twice.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flightmodel.checks import FloatArray, GateError
from flightmodel.instruments import TriadSpec
from flightmodel.rotations import skew
from flightmodel.trajectory import Trajectory, resample
from postflight.pipeline import Flight
from postflight.sensed import sensed, whole_windows

START_ALTITUDE_M = 100e3
WINDOW_S = 0.04  # of the joint's swinging at 2.5 Hz it passes 98 %, and the simulated flight is averaged alike
WINDOWS = 10  # a span
SPAN_S = WINDOWS * WINDOW_S
LEAST_SPANS = 20
LOADED = 0.1  # of the largest dynamic pressure
# bending and its rate (about x, y, z) at the first start, as known before: at rest above the air; swinging under load
REST_SD, LOADED_SD = np.deg2rad([1e-3, 0.1, 0.1, 0.1, 1.0, 1.0]), np.deg2rad([1e-3, 3.0, 3.0, 0.1, 30.0, 30.0])


@dataclass(frozen=True)
class Observed:
    """Windows of corrected sensors, body axes, and where each of ``s`` spans starts.

    Parameters
    ----------
    start : Trajectory
        Of the datum, at the starts of the spans and at the end of the last, ``s + 1`` points.
    dynamic_pressure_pa, altitude_m : (s,) float
        At the middles of the spans, by the sounding.
    time_s : (s, WINDOWS) float
        Middles of the windows.
    rate_radps, specific_force_mps2 : (s, WINDOWS, 3) float
        NaN where sensors are missing; specific force at the accelerometer.
    rate_sd_radps, force_sd_mps2 : float
        White noise of a window, each axis.
    rate_response, force_response : (4, 3, 9) float
        Response to nine unit normals that stand for the triad's constant errors: of the gyros as their sheet states
        bias, scale and mounting, of the accelerometer as the reconstruction left them. First the part that is always
        there, then what is to be multiplied by the true x, y and z.
    clock_sd_s : (2,) float
        Of the gyros' and of the accelerometer's clock.
    accelerometer_m : (3,) float
        From the datum, body axes.
    first_bending_sd : (6,) float
        Of the shell's rotation vector against the body, rad, and its rate, rad/s, at the first start.
    """

    start: Trajectory
    dynamic_pressure_pa: FloatArray
    altitude_m: FloatArray
    time_s: FloatArray
    rate_radps: FloatArray
    specific_force_mps2: FloatArray
    rate_sd_radps: float
    force_sd_mps2: float
    rate_response: FloatArray
    force_response: FloatArray
    clock_sd_s: FloatArray
    accelerometer_m: FloatArray
    first_bending_sd: FloatArray

    @property
    def spans(self) -> int:
        """Number of spans."""
        return len(self.time_s)


def observe(flight: Flight, loaded: bool = False) -> Observed:
    """Take what a joint can be reconciled with from a reconstructed flight, 100 km down to the end of the pulse.

    Parameters
    ----------
    flight : Flight
    loaded : bool
        Begin only where a tenth of the largest dynamic pressure loads the joint: in thinner air a shell with freeplay
        rattles between the edges of its dead band, and no start of a span tells where it will strike.

    Raises
    ------
    GateError
        Where sensors or vehicle are missing, or no pressure pulse was reconstructed.
    """
    pulse, bet, air = flight.required_pulse(), flight.reconstruction, flight.air
    accelerometer, rates = flight.telemetry.required_triads()
    falling = (air.altitude_m < START_ALTITUDE_M) & (air.flight_path_angle_rad < 0.0)
    if loaded:
        falling &= air.dynamic_pressure_pa > LOADED * pulse.dynamic_pressure_pa.max()
    if not falling.any():
        raise GateError("reconciliation: the reconstruction never comes below 100 km")
    first_s = float(np.ceil(air.time_s[np.argmax(falling)] / WINDOW_S) * WINDOW_S)
    last_s = float(pulse.time_s[np.flatnonzero(pulse.through_pulse)[-1]])
    spans = int((last_s - first_s) / SPAN_S)
    starts = np.asarray(first_s + SPAN_S * np.arange(max(spans, 0) + 1), dtype=np.float64)
    t = (starts[:-1, None] + WINDOW_S * (np.arange(WINDOWS) + 0.5)).ravel()
    whole = whole_windows(bet, t)
    if spans < LEAST_SPANS or whole.mean() < 0.5:
        raise GateError(
            f"reconciliation: {whole.sum() * WINDOW_S:.1f} s of whole sensor data between 100 km ({first_s:.1f} s) "
            f"and the end of the pressure pulse ({last_s:.1f} s); at least {LEAST_SPANS * SPAN_S:g} s and half of the "
            "time are wanted"
        )
    means = sensed(bet, t, np.zeros(3), 0.5 * WINDOW_S)
    near = np.abs(bet.smoothed.time_s[:, None] - t).argmin(axis=0)
    shape = (spans, WINDOWS)

    def windows(values: FloatArray) -> FloatArray:
        return np.where(whole[:, None], values, np.nan).reshape(*shape, 3)

    middle = starts[:-1] + 0.5 * SPAN_S
    return Observed(
        resample(bet.smoothed, starts),
        np.interp(middle, air.time_s, air.dynamic_pressure_pa),
        np.interp(middle, air.time_s, air.altitude_m),
        t.reshape(shape),
        windows(means.rate_radps),
        windows(means.specific_force_sensor_mps2),
        float(rates.spec.noise_sd / np.sqrt(means.samples)),
        float(accelerometer.spec.noise_sd / np.sqrt(means.samples)),
        _rate_response(rates.spec),
        _affine(means.specific_force_sensor_mps2[whole], bet.accelerometer_root[near][whole, 3:]),
        np.array([rates.spec.time_bias_sd_s, accelerometer.spec.time_bias_sd_s]),
        accelerometer.spec.position_from_datum_body_m,
        LOADED_SD if loaded else REST_SD,
    )


def _rate_response(spec: TriadSpec) -> FloatArray:
    """Response (4, 3, 9) to unit normals of bias, scale and mounting."""
    out = np.zeros((4, 3, 9))
    out[0, :, 0:3] = spec.bias_sd * np.eye(3)
    out[1:, :, 3:6] = spec.scale_sd * np.einsum("kj,ij->kij", np.eye(3), np.eye(3))
    out[1:, :, 6:9] = spec.mount_sd_rad * skew(np.eye(3))
    return out


def _affine(values: FloatArray, responses: FloatArray) -> FloatArray:
    """Response (4, 3, 9) of which ``responses`` (n, 3, 9) to readings (n, 3) are made, without the readings' noise."""
    ones = np.column_stack([np.ones(len(values)), values])
    fitted, *_ = np.linalg.lstsq(ones, responses.reshape(len(values), -1), rcond=None)
    return np.asarray(fitted.reshape(4, *responses.shape[1:]))
