"""Trackers that measure a part of a position: telescopes, ranging and Doppler stations, each with its own noise."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.stats import chi2

from flightmodel import earth, rotations
from flightmodel.atmosphere import standard_sounding
from flightmodel.instruments import GnssSpec, RadarSite
from flightmodel.telemetry import GnssRecord, Motion, RadarRecord, Telemetry
from recon.estimate import estimate
from recon.settings import Settings
from recon.setup import track_points, tracking_instruments
from tests.refusing import refuses

DEG = np.pi / 180.0
EPOCH = "2023-09-24T14:41:00Z"
LAT, LON = 40.2 * DEG, -113.2 * DEG
END_S, STEP_S = 40.0, 0.2
SPEC = Motion("ballistic", drag_area_per_mass_m2pkg=0.005, drag_sd=0.3, acceleration_density=1e-6)
ANGLE_SD, ANGLE_BIAS = 5e-5, 2e-5
SITES = [
    RadarSite(n, LAT + a * DEG, LON + o * DEG, h, 10.0, ANGLE_SD, 5.0, ANGLE_BIAS, 1e-9)
    for n, a, o, h in (("uintah", 0.9, 1.9, 1900.0), ("goshute", 0.1, -1.4, 1600.0), ("sevier", -1.3, 0.4, 1500.0))
]
QUICK = Settings(output_rate_hz=1.0)


def fly(start):
    """ECEF position and velocity (n, 6) of free fall at the nodes, integrated in inertial axes."""
    t = np.arange(0.0, END_S + 1e-9, STEP_S)
    w = earth.OMEGA_ECEF_RADPS
    s0 = np.concatenate([start[:3], start[3:] + np.cross(w, start[:3])])
    sol = solve_ivp(
        lambda _t, s: np.concatenate([s[3:], earth.gravitation(s[:3])]), (0.0, END_S), s0, t_eval=t, method="DOP853",
        rtol=1e-12, atol=1e-6,
    )  # fmt: skip
    turn = earth.q_ecef_eci(t)
    r = rotations.rotate(turn, sol.y[:3].T)
    return t, np.hstack([r, rotations.rotate(turn, sol.y[3:].T) - np.cross(w, r)])


@cache
def capsule():
    """A sample-return capsule above the air: 210 to 130 km, where drag is nothing beside the angles' noise."""
    ned = earth.dcm_ned_ecef(LAT, LON)
    position = earth.ecef_from_geodetic(LAT + 0.3 * DEG, LON - 1.0 * DEG, 210e3)
    return np.concatenate([position, ned.T @ np.array([-800.0, 5500.0, 2000.0])])


def readings(path, site):
    """Range, azimuth, elevation, range rate (n, 4)."""
    z = earth.radar_from_ecef(path[:, :3], site.latitude_rad, site.longitude_rad, site.height_m)
    sight = path[:, :3] - earth.ecef_from_geodetic(site.latitude_rad, site.longitude_rad, site.height_m)
    rate = np.einsum("ni,ni->n", sight, path[:, 3:]) / np.linalg.norm(sight, axis=1)
    return np.column_stack([z, rate])


def watch(seed, sites, measures, noisy=None):
    """Telemetry of stations that measure ``measures``; ``noisy`` (n,) multiplies the noise and stands in the table."""
    rng = np.random.default_rng(seed)
    t, path = fly(capsule())
    radars = {}
    for site in sites:
        z = readings(path, site)
        sd = np.tile([site.range_sd_m, ANGLE_SD, ANGLE_SD, site.range_rate_sd_mps], (len(t), 1))
        times = np.ones(len(t)) if noisy is None else noisy
        bias = rng.standard_normal(4) * [site.range_bias_sd_m, ANGLE_BIAS, ANGLE_BIAS, site.range_rate_bias_sd_mps]
        noise = rng.standard_normal(z.shape) * sd * times[:, None]
        noise[:, 1] /= np.cos(z[:, 2])
        z = np.where([name in measures for name in ("range", "az", "el", "range_rate")], z + bias + noise, np.nan)
        rate = z[:, 3] if "range_rate" in measures else None
        own = None if noisy is None else sd * times[:, None]
        radars[site.name] = RadarRecord(site, t, z[:, :3], "datum", range_rate_mps=rate, sd=own)
    return Telemetry("capsule", EPOCH, True, None, None, None, radars, standard_sounding(), None, motion=SPEC)


def off(solution):
    """Errors (n, 6) and covariances (n, 6, 6) at the output times."""
    bet = solution.smoothed
    t, path = fly(capsule())
    rows = np.searchsorted(t, bet.time_s - 1e-6)
    assert np.allclose(t[rows], bet.time_s)
    error = np.hstack([bet.position_ecef_m, bet.velocity_ecef_mps]) - path[rows]
    return error, bet.covariance[:, :6, :6], rows


def bound(sites):
    """Cramer-Rao bound (n, 6, 6) of two angles a site: start and biases unknown, by differences of integrated falls.

    Shares gravitation and rotation formulas with the filter, nothing else.
    """
    moves = np.repeat([50.0, 0.5], 3)
    plus, minus = ([fly(capsule() + s * m * np.eye(6)[k])[1] for k, m in enumerate(moves)] for s in (1.0, -1.0))
    by_start = np.stack([(a - b) / (2.0 * m) for a, b, m in zip(plus, minus, moves, strict=True)], axis=-1)
    information = np.diag(np.concatenate([np.repeat([1e-6, 1e-4], 3), np.full(2 * len(sites), ANGLE_BIAS**-2.0)]))
    for number, site in enumerate(sites):
        elevation = readings(fly(capsule())[1], site)[:, 2]
        for k in (1, 2):
            a = np.stack([(readings(p, site) - readings(q, site))[:, k] / (2.0 * m) for p, q, m in
                          zip(plus, minus, moves, strict=True)], axis=-1)  # fmt: skip
            whole = np.zeros((len(a), len(information)))
            whole[:, :6], whole[:, 6 + 2 * number + k - 1] = a, 1.0
            sd = ANGLE_SD / np.cos(elevation) if k == 1 else np.full(len(a), ANGLE_SD)
            information += (whole / sd[:, None] ** 2).T @ whole
    start = np.linalg.inv(information)[:6, :6]
    return by_start @ start @ np.swapaxes(by_start, 1, 2)


def test_two_telescopes_are_stated_as_well_as_the_cramer_rao_bound():
    sites = SITES[:2]
    _, covariance, rows = off(estimate(watch(1, sites, ("az", "el")), QUICK))
    sd, least = (np.sqrt(np.diagonal(p, axis1=1, axis2=2)) for p in (covariance, bound(sites)[rows]))
    ratio = sd / least
    # process noise and the air's drivers are there, as small as they are
    assert ratio.max() < 1.02
    assert ratio.min() > 0.98


@pytest.mark.slow
def test_two_telescopes_reach_the_cramer_rao_bound(record_property):
    """Rms errors over 60 realisations: six unknowns each, the ratio is uncertain by 5 per cent."""
    sites = SITES[:2]
    least = np.diagonal(bound(sites), axis1=1, axis2=2)
    squares = []
    for seed in range(60):
        error, _, rows = off(estimate(watch(100 + seed, sites, ("az", "el")), QUICK))
        squares.append(np.mean(error**2 / least[rows]))
    ratio = float(np.sqrt(np.mean(squares)))
    uncertain = float(np.std(squares, ddof=1) / np.sqrt(len(squares)) / (2.0 * ratio))
    record_property("rms over Cramer-Rao", f"{ratio:.3f} +- {uncertain:.3f} against 1.1")
    assert ratio <= 1.1
    assert ratio >= 1.0 - 3.0 * uncertain


@pytest.mark.parametrize(
    ("count", "measures"),
    [(3, ("range",)), (2, ("az", "el")), (1, ("range", "az", "el", "range_rate")), (3, ("range", "range_rate"))],
    ids=["ranges", "rays", "doppler radar", "ranges and doppler"],
)
def test_errors_are_as_large_as_stated(count, measures):
    assert_errors_as_stated(lambda seed: watch(seed, SITES[:count], measures))


def assert_errors_as_stated(telemetry_of):
    """Half-way states of six flights err as their covariances say; the residuals are as large as predicted."""
    squares, seeds = 0.0, range(6)
    for seed in seeds:
        solution = estimate(telemetry_of(seed), QUICK)
        assert all(v.passed for v in solution.consistency_checks if v.code in ("nis", "edited"))
        error, covariance, rows = off(solution)
        k = len(rows) // 2
        squares += error[k] @ np.linalg.solve(covariance[k], error[k])
    low, high = chi2.ppf([0.0005, 0.9995], 6 * len(seeds))
    assert low < squares < high


def test_doppler_makes_the_velocity_better():
    plain = off(estimate(watch(3, SITES[:1], ("range", "az", "el")), QUICK))[1]
    doppler = off(estimate(watch(3, SITES[:1], ("range", "az", "el", "range_rate")), QUICK))[1]
    assert np.trace(doppler[20, 3:, 3:]) < 0.9 * np.trace(plain[20, 3:, 3:])


def test_noise_of_its_own_for_each_row():
    """Half of the rows ten times noisier: with that stated, they are weighted so."""
    t = fly(capsule())[0]
    noisy = np.where(np.arange(len(t)) % 2, 10.0, 1.0)
    telemetry = watch(5, SITES[:2], ("az", "el"), noisy)
    solution = estimate(telemetry, QUICK)
    assert all(v.passed for v in solution.consistency_checks if v.code in ("nis", "edited"))
    untold = replace(telemetry, radars={n: replace(r, sd=None) for n, r in telemetry.radars.items()})
    assert not all(v.passed for v in estimate(untold, QUICK).consistency_checks)
    least = bound(SITES[:2])
    _, covariance, rows = off(solution)
    ratio = np.sqrt(np.trace(covariance[20, :3, :3]) / np.trace(least[rows][20, :3, :3]))
    assert 1.0 < ratio < 1.6  # half of the rows, and a hundredth of the others: root of two in what noise decides


def receiver(seed, speed_sd, noisy=None):
    """A receiver's velocities alone; ``noisy`` (n,) multiplies the noise and is stated of each fix."""
    t, path = fly(capsule())
    spec = GnssSpec("gps", np.zeros(3), 1.0, 1.0, speed_sd, 2.0 * speed_sd, time_bias_sd_s=1e-6)
    times = np.ones(len(t)) if noisy is None else noisy
    sd = speed_sd * np.array([1.0, 1.0, 2.0]) * times[:, None]
    ned = np.random.default_rng([seed, 9]).standard_normal((len(t), 3)) * sd
    velocity = path[:, 3:] + ned @ earth.dcm_ned_ecef(LAT, LON)
    nothing = np.full((len(t), 2), np.nan)
    own = None if noisy is None else np.column_stack([nothing, sd[:, 1:]])
    return GnssRecord(spec, t, np.full((len(t), 3), np.nan), velocity, sd=own)


def test_velocities_alone_help_and_err_as_stated():
    def with_velocities(seed):
        return replace(watch(seed, SITES[:2], ("az", "el")), gnss={"gps": receiver(seed, 0.02)})

    assert_errors_as_stated(with_velocities)
    with_it, plain = (
        off(estimate(telemetry, QUICK))[1] for telemetry in (with_velocities(5), watch(5, SITES[:2], ("az", "el")))
    )
    k = len(plain) // 2
    assert np.trace(with_it[k, 3:, 3:]) < 0.5 * np.trace(plain[k, 3:, 3:])


def test_noise_of_its_own_for_each_velocity():
    noisy = np.where(np.arange(len(fly(capsule())[0])) % 2, 10.0, 1.0)
    telemetry = watch(5, SITES[:2], ("az", "el"))
    own = replace(telemetry, gnss={"gps": receiver(5, 0.02, noisy)})
    assert all(v.passed for v in estimate(own, QUICK).consistency_checks if v.code in ("nis", "edited"))
    one_for_all = replace(own, gnss={"gps": replace(own.gnss["gps"], sd=None)})
    assert {v.source for v in estimate(one_for_all, QUICK).consistency_checks if not v.passed} == {"gps"}


def test_points_are_where_rays_and_ranges_meet():
    for measures, count in ((("az", "el"), 2), (("range",), 3)):
        telemetry = watch(7, SITES[:count], measures)
        at, points = track_points(tracking_instruments(telemetry, QUICK, np.zeros(3)))
        assert len(at) > 60
        t, path = fly(capsule())
        true = np.column_stack([np.interp(at, t, path[:, k]) for k in range(3)])
        assert np.linalg.norm(points - true, axis=1).max() < 500.0


def test_one_telescope_alone_is_refused():
    with refuses("too-few-data"):
        estimate(watch(1, SITES[:1], ("az", "el")), QUICK)


# after the last measurement


def test_the_trajectory_is_carried_on_with_growing_sd():
    squares, seeds = 0.0, range(6)
    for seed in seeds:
        telemetry = watch(seed, SITES[:2], ("az", "el"))
        seen = {
            n: replace(r, time_s=r.time_s[:100], range_az_el=r.range_az_el[:100]) for n, r in telemetry.radars.items()
        }
        bet = estimate(replace(telemetry, radars=seen), replace(QUICK, carry_on_s=15.0))
        assert bet.smoothed.time_s[-1] == pytest.approx(telemetry.radars["uintah"].time_s[99] + 15.0, abs=1.0)
        error, covariance, _ = off(bet)
        squares += error[-1] @ np.linalg.solve(covariance[-1], error[-1])
        at_last_fix = int(np.searchsorted(bet.smoothed.time_s, 19.5))
        assert np.trace(covariance[-1, :3, :3]) > 2.0 * np.trace(covariance[at_last_fix, :3, :3])
    low, high = chi2.ppf([0.0005, 0.9995], 6 * len(seeds))
    assert low < squares < high
