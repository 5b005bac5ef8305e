"""Write ``mean_winds.csv``: zonal-mean east wind by month, latitude and altitude, in balance with NRLMSIS 2.1.

On a surface of constant geopotential the zonal mean of the steady wind is in gradient balance,

    u^2 tan(lat) / R + f u = -(1 / rho) dp/dy |_Phi,   dp/dy |_Phi = dp/dy |_z + rho dPhi/dy |_z,

with ``f = 2 Omega sin(lat)`` and ``Phi`` the geopotential of normal gravity (Somigliana) at geometric height ``z``:
height is geodetic in the model, and gravity's change with latitude alone would be worth 3 % of pressure at 50 km.
``p`` and ``rho`` are means over 24 longitudes at one time of day, which are means over local time too: tides and
stationary waves drop out. Within 15 deg of the equator the balance fails and the wind is linear in latitude between
there. The 15th of each month; F10.7 = 120, Ap = 9 (mean conditions, passed so that nothing is downloaded). The mean
north wind is an order smaller and left at zero.

Assumed to be good to 10 m/s; `tests.synthetic_flight.test_weather` compares with published jets. Model: Emmert et al.,
"NRLMSIS 2.1", J. Geophys. Res. Space Phys. 127, 2022, through pymsis (MIT); its output is a work of the United States
Government. Balance: Fleming et al., "Zonal mean temperature, pressure, zonal wind and geopotential height as functions
of latitude", Adv. Space Res. 10(12), 1990 (CIRA-86 was made so). Run: ``python tools/mean_winds.py`` (needs ``msis``).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from flightmodel.earth import FLATTENING, OMEGA_RADPS, SEMI_MAJOR_M

F107, AP, YEAR = 120.0, 9.0, 2009
LATITUDE_DEG = np.arange(-80.0, 81.0, 10.0)
ALTITUDE_KM = np.arange(0.0, 111.0, 5.0)
LONGITUDE_DEG = np.arange(0.0, 360.0, 15.0)
STEP_DEG, BALANCED_DEG = 5.0, 15.0
BOLTZMANN = 1.380649e-23
M_RATIO = 0.00344978650684
GRAVITY_EQUATOR, SOMIGLIANA, ECCENTRICITY2 = 9.7803253359, 0.00193185265241, 0.00669437999014


def geopotential(latitude_rad: np.ndarray, height_m: np.ndarray) -> np.ndarray:
    """Geopotential above the ellipsoid, m^2/s^2, of normal gravity and its gradient (WGS-84)."""
    sin2 = np.sin(latitude_rad) ** 2
    surface = GRAVITY_EQUATOR * (1.0 + SOMIGLIANA * sin2) / np.sqrt(1.0 - ECCENTRICITY2 * sin2)
    radius = SEMI_MAJOR_M / (1.0 + FLATTENING + M_RATIO - 2.0 * FLATTENING * sin2)
    return surface * radius * height_m / (radius + height_m)


def zonal_mean(month: int, latitude_deg: float) -> tuple[np.ndarray, np.ndarray]:
    """Zonal mean of pressure Pa and density kg/m^3 over `ALTITUDE_KM`."""
    import pymsis

    time, one = np.datetime64(f"{YEAR}-{month:02d}-15T12:00"), [AP] * 7
    out = pymsis.calculate(time, LONGITUDE_DEG, latitude_deg, ALTITUDE_KM, [F107], [F107], [one], version=2.1)
    out = out.reshape(len(LONGITUDE_DEG), len(ALTITUDE_KM), 11).astype(float)
    number = np.nan_to_num(out[..., 1:10]).sum(axis=-1)
    return (number * BOLTZMANN * out[..., 10]).mean(axis=0), out[..., 0].mean(axis=0)


def balanced(month: int, latitude_deg: float) -> np.ndarray:
    """East wind, m/s, over `ALTITUDE_KM` in gradient balance."""
    z, lat = 1000.0 * ALTITUDE_KM, np.deg2rad(latitude_deg)
    south, north = np.deg2rad([latitude_deg - STEP_DEG, latitude_deg + STEP_DEG])
    (p_south, _), (p_north, _) = (zonal_mean(month, latitude_deg + side * STEP_DEG) for side in (-1.0, 1.0))
    pressure, density = zonal_mean(month, latitude_deg)
    radius = SEMI_MAJOR_M + z
    along = radius * (north - south)
    # of the logarithm: over 10 deg of latitude pressure at 80 km changes by a third
    push = pressure / density * np.log(p_north / p_south) / along
    push = push + (geopotential(north, z) - geopotential(south, z)) / along
    f, curve = 2.0 * OMEGA_RADPS * np.sin(lat), np.tan(lat) / radius
    root = np.sqrt(np.maximum(f * f - 4.0 * curve * push, 0.0))
    return np.asarray(-2.0 * push / (f + np.sign(f) * root))


def wind(month: int, latitude_deg: float) -> np.ndarray:
    """East wind, m/s, over `ALTITUDE_KM`."""
    if abs(latitude_deg) >= BALANCED_DEG:
        return balanced(month, latitude_deg)
    share = 0.5 * (latitude_deg + BALANCED_DEG) / BALANCED_DEG
    return (1.0 - share) * balanced(month, -BALANCED_DEG) + share * balanced(month, BALANCED_DEG)


if __name__ == "__main__":
    lines = [
        "# zonal-mean east wind, m/s, in gradient balance with the pressures of NRLMSIS 2.1; made by mean_winds.py",
        "# through pymsis (MIT). Model output, a work of the United States Government: public domain there.",
        "month,latitude_deg," + ",".join(f"z{z:.0f}km" for z in ALTITUDE_KM),
    ]
    for month in range(1, 13):
        for latitude in LATITUDE_DEG:
            lines.append(f"{month},{latitude:.0f}," + ",".join(f"{u:.0f}" for u in wind(month, latitude)))
    table = Path(__file__).parents[1] / "flightmodel" / "data" / "atmosphere" / "mean_winds.csv"
    table.write_text("\n".join(lines) + "\n")
