"""Inputs that are wrong but plausible: what is done to a sound flight, and whom a check must suspect first.

A case changes a `Package`. ``suspects`` are the sources, one of which must come first in what is named; an empty tuple
says that nothing needs to be named, for the answers stay right.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from tests.wrong.package import Package

ACCELEROMETER, RATES, CAMERA, SITES = "accelerometer", "rates", "camera", "sites"
SOUNDING, VEHICLE, PRIOR, BOTH = "atmosphere", "vehicle", "attitude_prior", ("accelerometer", "rates")
TRIADS = {
    ACCELEROMETER: ["ax_suba_mps2", "ay_suba_mps2", "az_suba_mps2"],
    RATES: ["p_body_degps", "q_body_degps", "r_body_degps"],
}
PEAK_S = 439.0  # about the peak of dynamic pressure, whatever the flight


@dataclass(frozen=True)
class Case:
    """One wrong input; ``film`` where it needs a video, ``filmed`` where it is seen with one too."""

    name: str
    suspects: tuple[str, ...]
    change: Callable[[Package], None]
    film: bool = False
    filmed: bool = False


def cases(package: Package) -> list[Case]:
    """All cases that a flight can have."""
    found = [*_clocks(), *_mountings(), *_scales(), *_radars(package), *_sites(package), *_prior(), *_spoilt(package)]
    found += [replace(case, filmed=True) for case in (*_film(), *_air(), *_vehicle())]
    return [case for case in found if not case.film or package.film is not None]


def _late(table: str, by_s: float) -> Callable[[Package], None]:
    def change(p: Package) -> None:
        p.tables[table]["t_s"] += by_s

    return change


def _clocks() -> Iterator[Case]:
    for name, words in ((RATES, "gyros"), (ACCELEROMETER, "accelerometer")):
        for by_s in (-1.0, -0.5, -0.2, -0.05, 0.2):
            yield Case(f"{words} {abs(by_s):g} s {'early' if by_s < 0 else 'late'}", (name,), _late(name, by_s))

    def drift(p: Package) -> None:
        t = p.tables[RATES]["t_s"]
        p.tables[RATES]["t_s"] = t.iloc[0] + (t - t.iloc[0]) * 1.002

    yield Case("gyros' clock fast by 0.2 %", (RATES,), drift)


def _mixed(table: str, matrix: np.ndarray) -> Callable[[Package], None]:
    """Readings multiplied from the left by a matrix."""

    def change(p: Package) -> None:
        columns = TRIADS[table]
        p.tables[table][columns] = p.tables[table][columns].to_numpy() @ np.asarray(matrix).T

    return change


def _about(axis: str, deg: float) -> np.ndarray:
    return Rotation.from_euler(axis, deg, degrees=True).as_matrix()


def _mountings() -> Iterator[Case]:
    for deg in (5.0, 45.0, 90.0, 180.0):
        # the package's own z is the long axis
        yield Case(f"accelerometer turned {deg:g} deg about roll", BOTH, _mixed(ACCELEROMETER, _about("z", deg)))
    for deg in (45.0, 180.0):
        yield Case(f"gyros turned {deg:g} deg about roll", BOTH, _mixed(RATES, _about("x", deg)))
    yield Case("accelerometer tilted 3 deg", BOTH, _mixed(ACCELEROMETER, _about("x", 3.0)))
    yield Case("gyros tilted 3 deg", BOTH, _mixed(RATES, _about("y", 3.0)))
    yield Case("q and r exchanged", (RATES,), _mixed(RATES, np.array([[1, 0, 0], [0, 0, 1], [0, 1, 0]])))
    yield Case(
        "accelerometer's x and y exchanged", BOTH, _mixed(ACCELEROMETER, np.array([[0, 1, 0], [1, 0, 0], [0, 0, 1]]))
    )
    for k, axis in enumerate("pqr"):
        yield Case(f"sign of {axis}", (RATES,), _mixed(RATES, np.diag([1 - 2 * (j == k) for j in range(3)])))
    for k, axis in enumerate("xyz"):
        yield Case(
            f"sign of the accelerometer's {axis}",
            (ACCELEROMETER,),
            _mixed(ACCELEROMETER, np.diag([1 - 2 * (j == k) for j in range(3)])),
        )


def _scales() -> Iterator[Case]:
    eye = np.eye(3)
    for part in (0.02, 0.1):
        yield Case(
            f"accelerometer's scale {100 * part:g} % large", (ACCELEROMETER,), _mixed(ACCELEROMETER, (1 + part) * eye)
        )
        yield Case(f"gyros' scale {100 * part:g} % large", (RATES,), _mixed(RATES, (1 + part) * eye))
    yield Case("accelerometer in g read as m/s2", (ACCELEROMETER,), _mixed(ACCELEROMETER, eye / 9.80665))
    yield Case("g taken as 9.81 m/s2", (), _mixed(ACCELEROMETER, eye * 9.81 / 9.80665))
    yield Case("rates in rad/s read as deg/s", (RATES,), _mixed(RATES, np.deg2rad(eye)))

    def bias(table: str, column: str, by: float) -> Callable[[Package], None]:
        def change(p: Package) -> None:
            p.tables[table][column] += by

        return change

    yield Case("accelerometer's bias 1 m/s2", (ACCELEROMETER,), bias(ACCELEROMETER, "ax_suba_mps2", 1.0))
    yield Case("gyro's bias 1 deg/s", (RATES,), bias(RATES, "q_body_degps", 1.0))


def _added(column: str, by: float, which: slice) -> Callable[[Package], None]:
    def change(p: Package) -> None:
        for name in p.radars[which]:
            p.tables[name][column] += by

    return change


def _radars(package: Package) -> Iterator[Case]:
    first, both = package.radars[0], slice(None)
    one = slice(0, 1)
    yield Case("both azimuths + 0.5 deg", (SITES, *package.radars), _added("az_deg", 0.5, both))
    yield Case("both elevations + 0.1 deg", (SITES, *package.radars), _added("el_deg", 0.1, both))
    yield Case("both ranges + 100 m", (SITES, *package.radars), _added("range_m", 100.0, both))
    yield Case("one radar's range + 100 m", tuple(package.radars), _added("range_m", 100.0, one))
    yield Case("one radar's azimuth + 0.2 deg", tuple(package.radars), _added("az_deg", 0.2, one))
    yield Case("one radar's elevation + 0.1 deg", tuple(package.radars), _added("el_deg", 0.1, one))
    for by_s in (0.1, 0.5, 1.0):
        leap = ", a leap second" if by_s == 1.0 else ""
        yield Case(f"one radar {by_s:g} s late{leap}", tuple(package.radars), _late(first, by_s))

    def both_late(p: Package) -> None:
        for name in p.radars:
            p.tables[name]["t_s"] += 0.5

    yield Case("both radars 0.5 s late", (*package.radars, *BOTH, PRIOR), both_late)
    yield Case("one radar in local time", tuple(package.radars), _late(first, -4 * 3600.0))

    def wander(p: Package) -> None:
        t, rng = p.tables[first]["t_s"].to_numpy(), np.random.default_rng(1)
        keep = np.exp(-np.diff(t, prepend=t[0]) / 20.0)
        for column in ("az_deg", "el_deg"):
            x, value = np.empty(len(t)), 0.03 * rng.standard_normal()
            for k, part in enumerate(keep):
                value = part * value + 0.03 * np.sqrt(1.0 - part**2) * rng.standard_normal()
                x[k] = value
            p.tables[first][column] += x

    def noise(p: Package) -> None:
        rng = np.random.default_rng(2)
        p.tables[first]["range_m"] += 20.0 * rng.standard_normal(len(p.tables[first]))

    def refraction(p: Package) -> None:
        for name in p.radars:
            el = np.deg2rad(p.tables[name]["el_deg"])
            p.tables[name]["el_deg"] += np.rad2deg(3e-4 / np.tan(np.maximum(el, 0.05)))

    yield Case("one radar's wander 0.03 deg, not stated", (first,), wander)
    yield Case("one radar's range noise 20 m, not stated", (first,), noise)
    yield Case("refraction not corrected", (SITES, *package.radars), refraction)


def _site(key: str, by: float, which: slice) -> Callable[[Package], None]:
    def change(p: Package) -> None:
        for name in p.radars[which]:
            p.spec["radars"][name][key] = round(p.spec["radars"][name][key] + by, 6)

    return change


def _sites(package: Package) -> Iterator[Case]:
    one, both, radars = slice(0, 1), slice(None), tuple(package.radars)
    yield Case("both sites' heights of another datum (+ 36 m)", (SITES, *radars), _site("height_m", 36.0, both))
    yield Case("one site's height of another datum (+ 36 m)", radars, _site("height_m", 36.0, one))
    yield Case("one site's latitude + 0.01 deg", radars, _site("latitude_deg", 0.01, one))
    yield Case("both sites' latitudes + 0.01 deg", (SITES, *radars), _site("latitude_deg", 0.01, both))

    def exchanged(p: Package) -> None:
        entry = p.spec["radars"][radars[0]]
        entry["latitude_deg"], entry["longitude_deg"] = entry["longitude_deg"], entry["latitude_deg"]

    def sign(p: Package) -> None:
        p.spec["radars"][radars[0]]["longitude_deg"] *= -1.0

    def swapped(p: Package) -> None:
        a, b = (p.spec["radars"][name] for name in radars[:2])
        for key in ("latitude_deg", "longitude_deg", "height_m"):
            a[key], b[key] = b[key], a[key]

    yield Case("one site's latitude and longitude exchanged", radars, exchanged)
    yield Case("one site's longitude without its sign", radars, sign)
    yield Case("the two sites exchanged", (SITES, *radars), swapped)


def _air() -> Iterator[Case]:
    def winds(matrix: np.ndarray) -> Callable[[Package], None]:
        def change(p: Package) -> None:
            columns = ["wind_n_mps", "wind_e_mps"]
            p.tables["atmosphere"][columns] = p.tables["atmosphere"][columns].to_numpy() @ matrix.T

        return change

    def density(factor: Callable[[np.ndarray], np.ndarray | float]) -> Callable[[Package], None]:
        def change(p: Package) -> None:
            table = p.tables["atmosphere"]
            table["rho_kgpm3"] *= factor(table["alt_m"].to_numpy())

        return change

    def another_day(p: Package) -> None:
        table, rng = p.tables["atmosphere"], np.random.default_rng(3)
        h = table["alt_m"].to_numpy() / 1e3
        table["rho_kgpm3"] *= 1.0 - 0.15 * np.exp(-(((h - 50.0) / 15.0) ** 2))
        table["wind_n_mps"] = 15.0 * np.sin(h / 9.0 + rng.uniform(0, 6))
        table["wind_e_mps"] = 50.0 * np.sin(h / 25.0)

    def heights(p: Package) -> None:
        p.tables["atmosphere"]["alt_m"] += 36.0

    yield Case("sounding of another day", (SOUNDING,), another_day)
    yield Case("sounding's heights above sea level (36 m)", (), heights)
    yield Case("wind's direction reversed", (SOUNDING,), winds(-np.eye(2)))
    yield Case("wind in knots read as m/s", (SOUNDING,), winds(np.eye(2) / 0.514444))
    yield Case("north and east wind exchanged", (SOUNDING,), winds(np.array([[0.0, 1.0], [1.0, 0.0]])))
    yield Case("wind against magnetic north", (SOUNDING,), winds(_about("z", 11.0)[:2, :2]))
    yield Case("density 10 % high", (SOUNDING, VEHICLE), density(lambda _: 1.1))
    yield Case("density 20 % high above 45 km", (SOUNDING, VEHICLE), density(lambda h: np.where(h > 45e3, 1.2, 1.0)))


def _scaled(path: str, factor: float) -> Callable[[Package], None]:
    """Values of the vehicle file times a factor; ``path`` is section and key."""

    def change(p: Package) -> None:
        section, key = path.split(".")
        p.vehicle[section][key] = (np.array(p.vehicle[section][key]) * factor).tolist()

    return change


def _vehicle() -> Iterator[Case]:
    def both(*changes: Callable[[Package], None]) -> Callable[[Package], None]:
        return lambda p: [change(p) for change in changes] and None

    def offset(matrix: list[list[float]]) -> Callable[[Package], None]:
        def change(p: Package) -> None:
            cg = np.array(p.vehicle["centerbody"]["cg_from_datum_body_m"])
            p.vehicle["centerbody"]["cg_from_datum_body_m"] = [cg[0], *(np.array(matrix) @ cg[1:]).tolist()]

        return change

    def station(p: Package) -> None:
        for body in ("aeroshell", "centerbody"):
            p.vehicle[body]["cg_from_datum_body_m"][0] -= 0.05

    def accelerometer(values: list[float]) -> Callable[[Package], None]:
        def change(p: Package) -> None:
            place = np.array(p.vehicle["sensors"]["suba"]["position_from_datum_body_m"])
            p.vehicle["sensors"]["suba"]["position_from_datum_body_m"] = (place * values).tolist()

        return change

    mass = [_scaled("aeroshell.mass_kg", 1.1), _scaled("centerbody.mass_kg", 1.1)]
    inertia = [_scaled("aeroshell.inertia_kgm2", 1.5), _scaled("centerbody.inertia_kgm2", 1.5)]
    yield Case("mass 10 % high", (VEHICLE, SOUNDING), both(*mass))
    yield Case("inertia of another vehicle (50 % high)", (VEHICLE,), both(*inertia))
    yield Case("reference area 10 % small", (VEHICLE, SOUNDING), _scaled("reference.area_m2", 0.9))
    yield Case("reference length 2.5 m for 3 m", (VEHICLE,), _scaled("reference.length_m", 2.5 / 3.0))
    yield Case("c.g. offset of wrong sign", (VEHICLE,), offset([[-1.0, 0.0], [0.0, -1.0]]))
    yield Case("c.g. offset in the other axis", (VEHICLE,), offset([[0.0, 1.0], [1.0, 0.0]]))
    yield Case("c.g. stations 5 cm aft", (VEHICLE,), station)
    yield Case("joint 10 cm aft", (VEHICLE,), _scaled("joint.station_m", 1.5))
    yield Case(
        "accelerometer's lateral position of wrong sign", (VEHICLE, ACCELEROMETER), accelerometer([1.0, -1.0, -1.0])
    )
    yield Case("accelerometer's station of wrong sign", (VEHICLE, ACCELEROMETER), accelerometer([-1.0, 1.0, 1.0]))


def _prior() -> Iterator[Case]:
    def turned(about: str, deg: float) -> Callable[[Package], None]:
        def change(p: Package) -> None:
            w, x, y, z = p.spec["attitude_prior"]["q_ecef_body"]
            body = Rotation.from_quat([x, y, z, w])
            if about == "vertical":
                up = np.array([0.2110, -0.7650, 0.6084])  # Wallops
                body = Rotation.from_rotvec(np.deg2rad(deg) * up / np.linalg.norm(up)) * body
            else:
                body = body * Rotation.from_euler(about, deg, degrees=True)
            x, y, z, w = body.as_quat()
            p.spec["attitude_prior"]["q_ecef_body"] = [float(v) for v in (w, x, y, z)]

        return change

    def scalar_last(p: Package) -> None:
        q = p.spec["attitude_prior"]["q_ecef_body"]
        p.spec["attitude_prior"]["q_ecef_body"] = [*q[1:], q[0]]

    def later(p: Package) -> None:
        p.spec["attitude_prior"]["t_s"] += 10.0

    def local(p: Package) -> None:
        p.spec["t0_utc"] = p.spec["t0_utc"].replace("T12:", "T08:")

    yield Case("attitude prior against magnetic north", (PRIOR,), turned("vertical", 11.0))
    yield Case("attitude prior turned 180 deg about roll", (PRIOR,), turned("x", 180.0))
    yield Case("attitude prior turned 30 deg about roll", (PRIOR,), turned("x", 30.0))
    yield Case("attitude prior's scalar last", (PRIOR,), scalar_last)
    yield Case("attitude prior 10 s late", (PRIOR,), later)
    yield Case("t0 in local time, all else after t0", (), local)


def _spoilt(package: Package) -> Iterator[Case]:
    def rows(p: Package, table: str, start: float, length: float) -> np.ndarray:
        t = p.tables[table]["t_s"]
        return ((t >= start) & (t < start + length)).to_numpy()

    def gap(table: str, length: float) -> Callable[[Package], None]:
        def change(p: Package) -> None:
            p.tables[table] = p.tables[table][~rows(p, table, PEAK_S, length)]

        return change

    def frozen(table: str, length: float) -> Callable[[Package], None]:
        def change(p: Package) -> None:
            mine, columns = rows(p, table, PEAK_S, length), p.tables[table].columns[1:]
            p.tables[table].loc[mine, columns] = p.tables[table].loc[mine, columns].iloc[0].to_numpy()

        return change

    def repeated(table: str, length: float) -> Callable[[Package], None]:
        def change(p: Package) -> None:
            mine, columns = rows(p, table, PEAK_S, length), p.tables[table].columns[1:]
            later = np.flatnonzero(mine) + mine.sum()
            p.tables[table].iloc[later, 1:] = p.tables[table].loc[mine, columns].to_numpy()

        return change

    def clipped(table: str, column: str, part: float) -> Callable[[Package], None]:
        def change(p: Package) -> None:
            values = p.tables[table][column]
            p.tables[table][column] = values.clip(part * values.min(), part * values.max())

        return change

    def filtered(table: str, lag_s: float) -> Callable[[Package], None]:
        def change(p: Package) -> None:
            t = p.tables[table]["t_s"].to_numpy()
            keep = np.exp(-float(np.median(np.diff(t))) / lag_s)
            for column in TRIADS[table]:
                p.tables[table][column] = p.tables[table][column].ewm(alpha=1.0 - keep, adjust=False).mean()

        return change

    radar = package.radars[-1]
    yield Case("accelerometer without 3 s at the peak", (ACCELEROMETER,), gap(ACCELEROMETER, 3.0))
    yield Case("gyros without 3 s at the peak", (RATES,), gap(RATES, 3.0))
    yield Case("accelerometer frozen for 2 s", (ACCELEROMETER,), frozen(ACCELEROMETER, 2.0))
    yield Case("gyros frozen for 2 s", (RATES,), frozen(RATES, 2.0))
    yield Case("one radar frozen for 5 s", (radar,), frozen(radar, 5.0))
    yield Case("2 s of the accelerometer repeated", (ACCELEROMETER,), repeated(ACCELEROMETER, 2.0))
    yield Case("2 s of the gyros repeated", (RATES,), repeated(RATES, 2.0))
    yield Case(
        "accelerometer's long axis clipped at 60 %", (ACCELEROMETER,), clipped(ACCELEROMETER, "az_suba_mps2", 0.6)
    )
    yield Case("gyro clipped at 50 %", (RATES,), clipped(RATES, "q_body_degps", 0.5))
    yield Case("gyros through a low-pass of 0.1 s", (RATES,), filtered(RATES, 0.1))
    yield Case("accelerometer through a low-pass of 0.1 s", (ACCELEROMETER,), filtered(ACCELEROMETER, 0.1))


def _film() -> Iterator[Case]:
    def camera(key: str, value: object) -> Callable[[Package], None]:
        def change(p: Package) -> None:
            p.vehicle["cameras"][p.spec["frames"]["camera"]][key] = value

        return change

    def benchmark(at_s: float) -> Callable[[Package], None]:
        def change(p: Package) -> None:
            p.spec["frames"]["benchmark_s"] = at_s

        return change

    def pictures(function: Callable[[np.ndarray], np.ndarray]) -> Callable[[Package], None]:
        def change(p: Package) -> None:
            p.pictures = function

        return change

    def late(by_s: float) -> Callable[[Package], None]:
        def change(p: Package) -> None:
            p.tables["frames"]["t_s"] += by_s
            p.spec["frames"]["benchmark_s"] += by_s

        return change

    def drift(p: Package) -> None:
        t = p.tables["frames"]["t_s"]
        p.tables["frames"]["t_s"] = (t.iloc[0] + (t - t.iloc[0]) * 30.0 / 29.97 * 1.01).round(6)

    yield Case("benchmark frame at 435 s", (CAMERA,), benchmark(435.0), True)
    yield Case("benchmark frame at 441 s", (CAMERA,), benchmark(441.0), True)
    for by_s in (-1.0, -0.3, 0.3, 1.0):
        yield Case(f"film {abs(by_s):g} s {'early' if by_s < 0 else 'late'}", (CAMERA,), late(by_s), True)
    yield Case("film's clock fast by 1 %", (CAMERA,), drift, True)
    yield Case("film mirrored", (CAMERA,), pictures(lambda x: cv2.flip(x, 1)), True)
    yield Case("film upside down", (CAMERA,), pictures(lambda x: cv2.flip(x, -1)), True)
    yield Case("camera mounted at 198 deg for 153", (CAMERA,), camera("clock_lv_deg", 198.0), True)
    yield Case("camera mounted at 333 deg for 153", (CAMERA,), camera("clock_lv_deg", 333.0), True)
    yield Case("camera 0.3 m further aft", (CAMERA,), camera("station_m", 1.1), True)
    yield Case("lens of another camera", (CAMERA,), camera("focal_px", [380.0, 380.0]), True)
    yield Case("lens without its distortion, centre of the picture", (CAMERA,), lens, True)


def lens(p: Package) -> None:
    """State a pinhole-like lens about the middle of the picture."""
    mine = p.vehicle["cameras"][p.spec["frames"]["camera"]]
    mine |= {"distortion": [0.0, 0.0, 0.0, 0.0], "centre_px": [340.0, 260.0]}
