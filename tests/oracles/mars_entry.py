"""A ballistic Mars entry integrated apart from the package: its own constants, frame and air, and what sensors read.

Inertial axes that are planet-fixed at time zero; J2 gravity; air that turns with the planet, an exponential in three
pieces after Viking's densities (Seiff and Kirk 1977: 1.6e-2 kg/m^3 at the ground, 1.5e-3 at 25 km, 1.6e-5 at 60 km,
1e-7 at 90 km), times a smooth random departure. The vehicle trims at a small angle whose plane turns slowly, which
lifts it to the side. The numbers are of Pathfinder: 585 kg, 2.65 m, entry at 3522.2 km, 7.26 km/s, 14 deg down.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

GM, J2, RADIUS_M, SPIN_RADPS = 4.282837e13, 1.9566e-3, 3396.19e3, 7.0882e-5
POLAR_M = 3376.20e3
AREA_M2, MASS_KG = 0.25 * np.pi * 2.65**2, 585.3
_KNOTS_M = np.array([-10e3, 0.0, 25e3, 60e3, 90e3, 130e3, 250e3])
_LOG_RHO = np.log([3.9e-2, 1.6e-2, 1.5e-3, 1.6e-5, 1.0e-7, 5e-10, 1e-14])
# in hydrostatic balance: 7.7 mbar at the ground; 215, 220, 212, 195, 170, 150 K at 0, 20, 40, 60, 80, 120 km
LOG_RHO_OF_A_STORM = np.log([4.3e-2, 1.9e-2, 2.0e-3, 9.4e-5, 4.8e-6, 4.7e-8, 1e-12])


@dataclass(frozen=True)
class Entry:
    """Truth of one entry, planet-fixed axes, at times (n,), and the errors behind what is measured and stated."""

    time_s: np.ndarray
    position_m: np.ndarray
    velocity_mps: np.ndarray
    density_kgpm3: np.ndarray
    height_m: np.ndarray
    airspeed_mps: np.ndarray
    axial_mps2: np.ndarray
    c_a: float
    measured_mps2: np.ndarray
    stated_spherical: np.ndarray
    mass_kg: float = MASS_KG

    @property
    def pressure_pa(self) -> np.ndarray:
        """Weight of the air above, (n,); above the first row as high as there."""
        per_metre = self.density_kgpm3 * GM / np.sum(self.position_m**2, axis=1)
        fine = np.linspace(self.height_m[-1], self.height_m[0], 20001)
        down = np.exp(np.interp(fine, self.height_m[::-1], np.log(per_metre)[::-1]))
        layer = 0.5 * (down[1:] + down[:-1]) * (fine[1] - fine[0])
        above = down[-1] * 7e3
        return np.interp(self.height_m, fine, np.concatenate([np.cumsum(layer[::-1])[::-1], [0.0]]) + above)

    @property
    def temperature_k(self) -> np.ndarray:
        """By the gas law, (n,)."""
        return self.pressure_pa / (8314.32 / 43.49 * self.density_kgpm3)

    @property
    def sound_speed_mps(self) -> np.ndarray:
        """By JANAF's heat capacity of CO2, J/(mol K) at 100 to 400 K, in which 4.5 % are rigid diatomic molecules."""
        printed = np.polyfit([1.0, 2.0, 2.9815, 4.0], [29.208, 32.359, 37.129, 41.325], 3)
        capacity = 0.955 * np.polyval(printed, self.temperature_k / 100.0) + 0.045 * 29.1
        return np.sqrt(capacity / (capacity - 8.3145) * 8314.32 / 43.49 * self.temperature_k)


STATE = np.array([3522.2e3, 22.6, 338.0, 7264.2, -14.06, 253.1])  # m, deg, deg, m/s, deg, deg: inertial, at entry
STATE_SD = np.array([1500.0, 0.02, 0.03, 0.7, 0.03, 0.03])
C_A, C_A_SD, MASS_SD = 1.70, 0.02, 0.001
NOISE_MPS2, BIAS_MPS2, SCALE, TRIM_DEG = 0.02, 0.03, 0.002, 2.0


def fly(
    seed: int,
    rate_hz: float = 16.0,
    to_s: float = 170.0,
    state: np.ndarray = STATE,
    lift: float = 0.0,
    log_rho: np.ndarray = _LOG_RHO,
) -> Entry:
    """Fly an entry dispersed about a stated state and measure it.

    ``lift`` is a part of the drag, in any direction; ``log_rho`` is of the density at its knots.
    """
    rng = np.random.default_rng(seed)
    true_state = state + STATE_SD * rng.standard_normal(6)
    c_a = C_A * (1.0 + C_A_SD * rng.standard_normal())
    mass = MASS_KG * (1.0 + MASS_SD * rng.standard_normal())
    shift, waves = 0.15 * rng.standard_normal(), rng.standard_normal((2, 3))
    trim, roll, roll_rate = np.deg2rad(TRIM_DEG) * abs(rng.standard_normal()), 6.28 * rng.random(), 0.2 * rng.random()

    def density(height):
        wave = sum(
            w[0] * np.sin(height / s) + w[1] * np.cos(height / s)
            for w, s in zip(waves.T, (4e3, 9e3, 20e3), strict=True)
        )
        return np.exp(np.interp(height, _KNOTS_M, log_rho) + shift + 0.04 * wave)

    def air_of(r, v):
        level = np.hypot(r[0], r[1])
        latitude = np.arctan2(r[2], level * (POLAR_M / RADIUS_M) ** 2)
        for _ in range(4):
            curve = RADIUS_M**2 / np.hypot(RADIUS_M * np.cos(latitude), POLAR_M * np.sin(latitude))
            height = level / np.cos(latitude) - curve
            latitude = np.arctan2(r[2], level * (1.0 - (1.0 - (POLAR_M / RADIUS_M) ** 2) * curve / (curve + height)))
        u = v - np.cross([0.0, 0.0, SPIN_RADPS], r)
        return height, density(height), u

    def forces(t, r, v):
        _, rho, u = air_of(r, v)
        speed = np.linalg.norm(u)
        pressure = 0.5 * rho * speed**2 * AREA_M2 / mass
        along = u / speed
        side = np.cross(along, r)
        side = side / np.linalg.norm(side)
        up, turn = np.cross(side, along), roll + roll_rate * t
        across = np.cos(turn) * side + np.sin(turn) * up
        # C_A along the axis, C_N of a blunt body a fifth of C_A times the angle
        axis = np.cos(trim) * along + np.sin(trim) * across
        normal = -np.sin(trim) * along + np.cos(trim) * across
        axial = pressure * c_a
        return -axial * axis - 0.2 * axial * trim * normal + axial * lift * across, axial

    def slope(t, y):
        r, v = y[:3], y[3:]
        size = np.linalg.norm(r)
        z2 = 5.0 * (r[2] / size) ** 2
        k = 1.5 * J2 * (RADIUS_M / size) ** 2
        gravity = -GM / size**3 * r * np.array([1.0 + k * (1.0 - z2), 1.0 + k * (1.0 - z2), 1.0 + k * (3.0 - z2)])
        return np.concatenate([v, gravity + forces(t, r, v)[0]])

    t = np.arange(0.0, to_s, 1.0 / rate_hz)
    lat, lon, path, azimuth = np.deg2rad(true_state[[1, 2, 4, 5]])
    up = np.array([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)])
    east = np.array([-np.sin(lon), np.cos(lon), 0.0])
    north = np.cross(up, east)
    heading = np.cos(azimuth) * north + np.sin(azimuth) * east
    start = np.concatenate([true_state[0] * up, true_state[3] * (np.cos(path) * heading + np.sin(path) * up)])
    flown = solve_ivp(slope, (0.0, t[-1]), start, t_eval=t, rtol=1e-10, atol=1e-6, max_step=0.5).y.T
    r, v = flown[:, :3], flown[:, 3:]
    parts = [air_of(a, b) for a, b in zip(r, v, strict=True)]
    axial = np.array([forces(k, a, b)[1] for k, a, b in zip(t, r, v, strict=True)])
    bias, scale = BIAS_MPS2 * rng.standard_normal(), SCALE * rng.standard_normal()
    measured = -axial * (1.0 + scale) + bias + NOISE_MPS2 * rng.standard_normal(len(t))
    angle = -SPIN_RADPS * t
    c, s, no, one = np.cos(angle), np.sin(angle), 0.0 * t, 1.0 + 0.0 * t
    turn = np.moveaxis(np.array([[c, -s, no], [s, c, no], [no, no, one]]), 2, 0)
    fixed = np.einsum("nij,nj->ni", turn, r)
    moving = np.einsum("nij,nj->ni", turn, v) - np.cross([0.0, 0.0, SPIN_RADPS], fixed)
    return Entry(
        t, fixed, moving, np.array([p[1] for p in parts]), np.array([p[0] for p in parts]),
        np.linalg.norm(moving, axis=1), axial, c_a, measured, state, mass,
    )  # fmt: skip


FLIGHT = """name = "entry"
t0_utc = "1997-07-04T16:51:12Z"
planet = "mars"

[start.state]
t_s = 0.0
axes = "inertial"
radius_m = {0[0]:.1f}
latitude_deg = {0[1]}
longitude_deg = {0[2]}
speed_mps = {0[3]}
flight_path_deg = {0[4]}
azimuth_deg = {0[5]}
radius_sd_m = {1[0]}
latitude_sd_deg = {1[1]}
longitude_sd_deg = {1[2]}
speed_sd_mps = {1[3]}
flight_path_sd_deg = {1[4]}
azimuth_sd_deg = {1[5]}

[drag]
c_a = 1.70
c_a_sd_percent = 2.0
diameter_m = 2.65
mass_kg = 585.3
mass_sd_percent = 0.1

[motion]
model = "ballistic"
trim_sd_deg = 2.0

[sensors.accelerometer]
file = "accelerometer.csv"
measures = ["ax"]
axes = ["+x", "+y", "+z"]
columns = {{ ax = {{ column = "ax_mps2", unit = "mps2" }} }}
noise_sd_mps2 = 0.02
bias_sd_mps2 = 0.03
scale_sd = 0.002
time_bias_sd_s = 0.0
"""


def write(entry: Entry, folder) -> None:
    """Flight folder of an entry with one accelerometer channel."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "flight.toml").write_text(FLIGHT.format(entry.stated_spherical, STATE_SD))
    rows = np.column_stack([entry.time_s, entry.measured_mps2])
    np.savetxt(folder / "accelerometer.csv", rows, fmt="%.6f", delimiter=",", header="t_s,ax_mps2", comments="")


INERTIAL = """
[attitude_prior]
t_s = 0.0
q_ecef_body = [{0}]
sd_deg = 0.2

[motion]
model = "strapdown"

[sensors.accelerometer]
file = "accelerometer.csv"
axes = ["+x", "+y", "+z"]
columns.ax = {{ column = "x", unit = "mps2" }}
columns.ay = {{ column = "y", unit = "mps2" }}
columns.az = {{ column = "z", unit = "mps2" }}
noise_sd_mps2 = 0.02
bias_sd_mps2 = 0.02
scale_sd = 0.001
position_from_datum_body_m = [0.0, 0.0, 0.0]

[sensors.rates]
file = "rates.csv"
axes = ["+x", "+y", "+z"]
columns.p = {{ column = "x", unit = "radps" }}
columns.q = {{ column = "y", unit = "radps" }}
columns.r = {{ column = "z", unit = "radps" }}
noise_sd_degps = 0.02
bias_sd_degps = 0.01
scale_sd = 0.001
"""


def write_inertial(entry: Entry, folder, seed: int) -> None:
    """Flight folder of an entry with three accelerometers and gyros, body x along the velocity; no tracker."""
    rng, spin = np.random.default_rng([seed, 3]), np.array([0.0, 0.0, SPIN_RADPS])
    t, r, v = entry.time_s, entry.position_m, entry.velocity_mps
    along = v / np.linalg.norm(v, axis=1)[:, None]
    side = np.cross(along, r)
    side = side / np.linalg.norm(side, axis=1)[:, None]
    body = np.stack([along, side, np.cross(along, side)], axis=2)
    size = np.linalg.norm(r, axis=1)[:, None]
    z2, k = 5.0 * (r[:, 2:] / size) ** 2, 1.5 * J2 * (RADIUS_M / size) ** 2
    gravity = -GM / size**3 * r * np.hstack([1.0 + k * (1.0 - z2), 1.0 + k * (1.0 - z2), 1.0 + k * (3.0 - z2)])
    sensed = CubicSpline(t, v)(t, 1) - gravity + 2.0 * np.cross(spin, v) + np.cross(spin, np.cross(spin, r))
    change = CubicSpline(t, body.reshape(-1, 9))(t, 1).reshape(-1, 3, 3)
    skew = np.einsum("nji,njk->nik", body, change)
    turning = np.column_stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]]) + np.einsum("nji,j->ni", body, spin)
    folder.mkdir(parents=True, exist_ok=True)
    readings = {"accelerometer": np.einsum("nji,nj->ni", body, sensed), "rates": turning}
    for name, noise, bias in (("accelerometer", 0.02, 0.02), ("rates", np.deg2rad(0.02), np.deg2rad(0.01))):
        off = bias * rng.standard_normal(3) + noise * rng.standard_normal((len(t), 3))
        rows = np.column_stack([t, readings[name] * (1.0 + 0.001 * rng.standard_normal(3)) + off])
        np.savetxt(folder / f"{name}.csv", rows, fmt="%.10f", delimiter=",", header="t_s,x,y,z", comments="")
    known = Rotation.from_matrix(body[0]) * Rotation.from_rotvec(np.deg2rad(0.2) * rng.standard_normal(3))
    q = ", ".join(f"{x:.12f}" for x in known.as_quat()[[3, 0, 1, 2]])
    head = FLIGHT.format(entry.stated_spherical, STATE_SD).partition("[motion]")[0]
    (folder / "flight.toml").write_text(head + INERTIAL.format(q))
