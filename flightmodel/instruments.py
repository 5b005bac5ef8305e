"""What sensor makers and estimators must both know of an instrument: where it sits, how it errs on paper."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flightmodel.checks import FloatArray


@dataclass(frozen=True)
class TriadSpec:
    """Three orthogonal sensors (accelerometers or rate gyros) on the centerbody.

    Parameters
    ----------
    name : str
        As in the flight file.
    position_from_datum_body_m : (3,) float
        Where the triad sits, body axes, m.
    dcm_body_sensor : (3, 3) float
        Nominal mounting: ``v_body = dcm_body_sensor @ v_sensor``.
    noise_sd, bias_sd, scale_sd, mount_sd_rad : float
        White noise per sample (m/s^2 or rad/s), bias, scale factor, mounting rotation per axis; one standard
        deviation each, as the data sheet gives them.
    resolution : float
        Quantisation step, m/s^2 or rad/s; 0 for none.
    """

    name: str
    position_from_datum_body_m: FloatArray
    dcm_body_sensor: FloatArray
    noise_sd: float
    bias_sd: float
    scale_sd: float
    mount_sd_rad: float
    resolution: float = 0.0


@dataclass(frozen=True)
class RadarSite:
    """A tracking radar: slant range, azimuth from true north, elevation, refraction removed.

    Parameters
    ----------
    name : str
        As in the flight file.
    latitude_rad, longitude_rad, height_m : float
        WGS-84.
    range_sd_m, angle_sd_rad : float
        White noise per sample; the angle's across the line of sight, so azimuth scatters ``1 / cos(elevation)`` more.
    range_bias_sd_m, angle_bias_sd_rad, time_bias_sd_s : float
        Systematic errors, constant over a flight, one standard deviation.
    """

    name: str
    latitude_rad: float
    longitude_rad: float
    height_m: float
    range_sd_m: float
    angle_sd_rad: float
    range_bias_sd_m: float
    angle_bias_sd_rad: float
    time_bias_sd_s: float


def dcm_body_from_clocking(x_axis_lv_rad: float, y_axis_lv_rad: float) -> FloatArray:
    """Mounting of a package whose x and y axes are clocked in the LV frame; z completes the right-hand set.

    Returns
    -------
    (3, 3) float
        ``dcm_body_sensor``.
    """
    from flightmodel.deflection import lv_direction

    x_axis, y_axis = lv_direction(x_axis_lv_rad), lv_direction(y_axis_lv_rad)
    return np.column_stack([x_axis, y_axis, np.cross(x_axis, y_axis)])
