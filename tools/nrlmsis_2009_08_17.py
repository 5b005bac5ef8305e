"""Write ``nrlmsis_2009_08_17.csv``: NRLMSIS 2.1 over Wallops Island at IRVE-II's launch, 17 August 2009, 12:52 UTC.

NRLMSIS 2.1 (Emmert et al., "NRLMSIS 2.1: An Empirical Model of Nitric Oxide Incorporated Into MSIS", J. Geophys. Res.
Space Phys. 127, 2022), run through pymsis (MIT). Solar and geomagnetic indices are passed, so nothing is downloaded:
F10.7 = 67, its 81-day mean 68, Ap = 4. They are rounded values of the deep solar minimum of August 2009 (the ARRL
bulletin of 28 August 2009 gives 67.6 to 66.4 sfu and A = 3 to 11 for 20 to 26 August); the day's own three-hourly
indices are not used. Below 110 km they matter little: F10.7 = 100 and Ap = 15 would change density by 1.3 % and
temperature by 5 K at most. The model's output is a work of the United States Government, free of copyright there.
Run: ``python tools/nrlmsis_2009_08_17.py`` (needs the ``dev`` extra).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

TIME = np.datetime64("2009-08-17T12:52")
LATITUDE_DEG, LONGITUDE_DEG = 37.84, -75.48
F107, F107A, AP = 67.0, 68.0, 4.0
ALTITUDE_KM = np.concatenate([np.arange(0.0, 130.0, 1.0), np.arange(130.0, 200.0, 2.0), np.arange(200.0, 401.0, 10.0)])
# pymsis' species after total mass density: N2, O2, O, He, H, Ar, N, anomalous O, NO (absent ones are NaN)
MOLAR_GPMOL = np.array([28.0134, 31.9988, 15.9994, 4.0026, 1.00797, 39.948, 14.0067, 15.9994, 30.0061])


def rows(f107: float = F107, f107a: float = F107A, ap: float = AP) -> np.ndarray:
    """Altitude m, density kg/m^3, temperature K, mean molar mass g/mol, ``(n, 4)``."""
    import pymsis

    out = pymsis.calculate(
        TIME, LONGITUDE_DEG, LATITUDE_DEG, ALTITUDE_KM, [f107], [f107a], [[ap] * 7], version=2.1
    ).reshape(len(ALTITUDE_KM), 11)
    number = np.nan_to_num(out[:, 1:10].astype(float))
    molar = number @ MOLAR_GPMOL / number.sum(axis=1)
    return np.column_stack([1000.0 * ALTITUDE_KM, out[:, 0], out[:, 10], molar])


if __name__ == "__main__":
    lines = [
        "# NRLMSIS 2.1 at 37.84 N 75.48 W, 2009-08-17T12:52Z, F10.7 67, F10.7a 68, Ap 4; made by nrlmsis_2009_08_17.py",
        "# through pymsis (MIT). Model output, a work of the United States Government: public domain there.",
        "altitude_m,density_kgpm3,temperature_k,molar_mass_gpmol",
    ]
    lines += [f"{z:.0f},{rho:.5e},{t:.2f},{m:.4f}" for z, rho, t, m in rows()]
    table = Path(__file__).parents[1] / "flightmodel" / "data" / "atmosphere" / "nrlmsis_2009_08_17.csv"
    table.write_text("\n".join(lines) + "\n")
