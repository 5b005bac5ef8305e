"""Air of the day from data made by the model itself: what was put in comes out, as well as is claimed."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from flightmodel import rotations
from flightmodel.atmosphere import sounding_correlation, standard_atmosphere
from flightmodel.checks import GateError
from flightmodel.vehicle import vehicle_from_toml, vehicle_path
from recon import atmosphere

KNOWN = replace(standard_atmosphere(), wind_sd_mps=np.full(41, 4.0), density_sd=np.full(41, 0.03))
VEHICLE = vehicle_from_toml(vehicle_path("irve2_reference"))
DRAG = atmosphere.Drag(
    VEHICLE.aero, VEHICLE.reference.area_m2 / VEHICLE.mass_kg, 0.03, 0.07, VEHICLE.reference.length_m, 0.02
)


def descent(spin_rpm=6.0, attitude_sd=1e-5):
    """A fall from 70 to 22 km at a lateral angle of a few degrees, nose down, spinning about the nose's axis."""
    t = np.arange(0.0, 130.0, 0.4)
    speed = np.interp(t, [0, 15, 25, 40, 130], [1600.0, 1450.0, 950.0, 250.0, 100.0])
    altitude = 70e3 - 0.98 * 0.4 * np.cumsum(speed)
    velocity = np.column_stack([0.1 * speed, 0.15 * speed, 0.98 * speed])
    down = rotations.exp(np.array([0.0, -0.5 * np.pi, 0.0]))
    tip = rotations.exp(np.column_stack([0.04 * np.sin(3 * t), 0.1 + 0.05 * np.cos(3 * t), 0.0 * t]))
    turn = rotations.exp(np.column_stack([spin_rpm * 2 * np.pi / 60.0 * t, 0 * t, 0 * t]))
    dcm = rotations.dcm_from_q(rotations.multiply(down, rotations.multiply(tip, turn)))
    root = np.tile(np.diag([0.02] * 3 + [attitude_sd] * 3), (len(t), 1, 1))
    own = np.tile(np.hstack([0.01 * np.eye(3), np.zeros((3, 9))]), (len(t), 1, 1))
    return atmosphere.AirSamples(t, altitude, velocity, dcm, np.full((len(t), 3), -10.0), root, own)


def pushed(samples, seen, rng=None):
    """Samples with the forces that the model makes of what each of them sees (n, SEEN), with its noise."""
    force = atmosphere._Model(samples, KNOWN, DRAG).forces(seen)[0]
    if rng is not None:
        part = np.array([atmosphere._AXIAL_PART, atmosphere._LATERAL_PART, atmosphere._LATERAL_PART])
        force = force + np.hypot(atmosphere._MODEL_FLOOR_MPS2, part * np.abs(force[:, :1])) * rng.standard_normal(
            force.shape
        )
    return replace(samples, specific_force_body_mps2=force)


def drawn(samples, rng):
    """What the samples see when every unknown is drawn from its prior, and density and winds at the knots."""
    height = atmosphere._knots(samples.altitude_m, atmosphere._KNOT_M)
    at = atmosphere._interpolation(samples.altitude_m, height)
    seen = np.zeros((len(samples.time_s), atmosphere._UNKNOWNS))
    knots = []
    for k, length in enumerate((5000.0, 3000.0, 3000.0)):
        root = np.linalg.cholesky(sounding_correlation(height, length))
        knots.append(root @ rng.standard_normal(len(height)))
        seen[:, k] = at @ knots[-1]
    sd = np.array([DRAG.ca_constant_sd, 0.07, 0.3, 0.1, *[np.deg2rad(1.0)] * 4])
    own = sd * rng.standard_normal(8)
    seen[:, 3:11] = own
    q, mach = atmosphere._Model(samples, KNOWN, DRAG).forces(np.zeros_like(seen))[1:]
    apart = np.abs(np.subtract.outer(np.log(mach), np.log(mach)))
    root = np.linalg.cholesky(np.exp(-apart / np.log(2.0)) + 1e-9 * np.eye(len(mach)))
    seen[:, atmosphere._SHAPE] = root @ rng.standard_normal(len(mach))
    seen[:, atmosphere._FORCE :] = rng.standard_normal(12)
    shape = seen[q >= 0.5 * q.max(), atmosphere._SHAPE].mean()
    return seen, height, np.array(knots), own[0] + DRAG.ca_shape_sd * shape


def test_sounding_without_errors_is_left_as_it_is():
    samples = descent()
    found = atmosphere.reconstruct_air(
        pushed(samples, np.zeros((len(samples.time_s), atmosphere._UNKNOWNS))), KNOWN, DRAG
    )
    assert np.abs(found.profile.density_ratio - 1.0).max() < 1e-6
    assert np.abs(found.profile[["wind_north_change_mps", "wind_east_change_mps"]]).to_numpy().max() < 1e-4
    assert np.abs(found.drag.ratio - 1.0).max() < 1e-12
    assert all(v.passed for v in found.consistency_checks)


def test_a_mass_that_falls_in_flight_is_no_thin_air():
    """A third of the mass goes: with the mass of each time the air is the sounding's, with one mass it is not."""
    samples = descent()
    felt = pushed(samples, np.zeros((len(samples.time_s), atmosphere._UNKNOWNS)))
    heavy = np.where(samples.time_s > np.median(samples.time_s), 1.5, 1.0)
    lighter = replace(felt, specific_force_body_mps2=heavy[:, None] * felt.specific_force_body_mps2)
    stepped = replace(DRAG, area_per_mass_m2pkg=heavy * DRAG.area_per_mass_m2pkg)
    ratio = [atmosphere.reconstruct_air(lighter, KNOWN, drag).drag["ratio"].to_numpy() for drag in (stepped, DRAG)]
    np.testing.assert_allclose(ratio[0], 1.0, atol=0.02)
    assert np.ptp(ratio[1]) > 0.4


@pytest.fixture(scope="module")
def many():
    """Sixteen days drawn from the prior: normalised errors of density, winds and C_A, and sds over prior."""
    rows = []
    for seed in range(16):
        rng = np.random.default_rng(seed)
        samples = descent()
        seen, height, knots, true_ca = drawn(samples, rng)
        found = atmosphere.reconstruct_air(pushed(samples, seen, rng), KNOWN, DRAG)
        p, at = found.profile, np.isin(height, found.profile.altitude_m)
        truth = [np.exp(0.03 * knots[0, at]), 4.0 * knots[1, at], 4.0 * knots[2, at]]
        z = [
            (p.density_ratio - truth[0]) / p.density_ratio_sd,
            (p.wind_north_change_mps - truth[1]) / p.wind_north_sd_mps,
            (p.wind_east_change_mps - truth[2]) / p.wind_east_sd_mps,
        ]
        ca = (found.parameters.estimate[0] - true_ca) / found.parameters.sd[0]
        rows.append((np.array(z), ca, (p.density_ratio_sd / 0.03).mean(), (p.wind_north_sd_mps / 4.0).mean(), found))
    return rows


@pytest.mark.long
@pytest.mark.parametrize("which", [0, 1, 2])
def test_errors_are_as_large_as_claimed_at_every_height(many, which):
    values = np.array([row[0][which] for row in many]) ** 2
    low, high = chi2.ppf([0.0001, 0.9999], len(many)) / len(many)
    # winds carry the air's structure between knots on top, which the model's own data have none of
    assert (values.mean(axis=0) > (low if which == 0 else 0.5 * low)).all()
    assert (values.mean(axis=0) < high).all()


@pytest.mark.long
def test_density_and_drag_share_a_factor_and_say_so(many):
    low, high = chi2.ppf([0.0001, 0.9999], len(many)) / len(many)
    assert low < np.mean([row[1] ** 2 for row in many]) < high
    sd = many[0][4].parameters.sd[0]
    assert 0.3 * 0.03 < sd < 0.8 * 0.03


@pytest.mark.long
def test_flight_teaches_about_the_air(many):
    assert np.mean([row[2] for row in many]) < 0.75
    assert np.mean([row[3] for row in many]) < 0.9


@pytest.mark.long
def test_days_like_the_prior_turn_no_verdict_red(many):
    assert not [v.name for row in many for v in row[4].consistency_checks if not v.passed]


def test_spin_tells_winds_from_an_offset_of_the_body():
    """Two degrees that turn with the body and no wind, in the slow part of the fall, where both look most alike."""
    sd, offset_sd, taken = {}, {}, {}
    for spin in (0.0, 6.0):
        samples = descent(spin)
        samples = samples.rows(samples.altitude_m < 26e3)
        seen = np.zeros((len(samples.time_s), atmosphere._UNKNOWNS))
        seen[:, 9] = np.deg2rad(2.0)
        found = atmosphere.reconstruct_air(pushed(samples, seen), KNOWN, DRAG)
        sd[spin] = found.profile.wind_east_sd_mps.mean()
        offset_sd[spin] = found.parameters.sd[6]
        taken[spin] = np.abs(found.profile.wind_east_change_mps).max()
    assert sd[6.0] < 0.87 * sd[0.0]
    assert offset_sd[6.0] < 0.87 * offset_sd[0.0]
    assert taken[6.0] < 0.3 * taken[0.0]


def test_attitude_that_is_not_known_hides_the_winds():
    sd = []
    for attitude_sd in (1e-5, np.deg2rad(3.0)):
        samples = descent(attitude_sd=attitude_sd)
        found = atmosphere.reconstruct_air(
            pushed(samples, np.zeros((len(samples.time_s), atmosphere._UNKNOWNS))), KNOWN, DRAG
        )
        sd.append(found.profile.wind_north_sd_mps.iloc[:10].mean())
    assert sd[1] > 1.4 * sd[0]


@pytest.mark.parametrize(
    ("column", "code", "component"), [(0, "sounding-density", "density"), (2, "sounding-wind", "wind east")]
)
def test_layer_that_the_sounding_lacks_fails_its_check(column, code, component):
    samples = descent()
    seen = np.zeros((len(samples.time_s), atmosphere._UNKNOWNS))
    low, high = (45e3, 55e3) if column == 0 else (0.0, 32e3)
    inside = (samples.altitude_m > low) & (samples.altitude_m < high)
    seen[inside, column] = np.log(1.15) / 0.03 if column == 0 else 5.0
    checks = atmosphere.reconstruct_air(pushed(samples, seen), KNOWN, DRAG).consistency_checks
    (failed,) = (v for v in checks if v.code == code)
    assert not failed.passed
    assert failed.component.startswith(component)
    assert low <= 1e3 * float(failed.component.split(" at ")[1].split(" km")[0]) <= high


def test_force_that_is_no_air_is_told():
    samples = descent()
    rng = np.random.default_rng(0)
    pushed_samples = pushed(samples, np.zeros((len(samples.time_s), atmosphere._UNKNOWNS)))
    force = pushed_samples.specific_force_body_mps2 * (1.0 + 0.1 * rng.standard_normal((len(samples.time_s), 1)))
    found = atmosphere.reconstruct_air(replace(pushed_samples, specific_force_body_mps2=force), KNOWN, DRAG)
    assert ("force-residuals", "axial") in {(v.code, v.component) for v in found.consistency_checks if not v.passed}


def test_thin_air_is_refused_in_words():
    samples = descent()
    with pytest.raises(GateError) as refusal:
        atmosphere.reconstruct_air(
            replace(samples, specific_force_body_mps2=np.zeros((len(samples.time_s), 3))), KNOWN, DRAG
        )
    assert refusal.value.codes == ("too-few-data",)


# ------------------------------------------------------------------------------------------- standard deviations


def straight_fall():
    """A fall along the axis in still air of known wind: the axial force sees density and C_A, and nothing else."""
    samples = descent(spin_rpm=0.0)
    down = rotations.dcm_from_q(rotations.exp(np.array([0.0, -0.5 * np.pi, 0.0])))
    speed = np.linalg.norm(samples.velocity_ned_mps, axis=1)
    n = len(speed)
    return replace(
        samples,
        velocity_ned_mps=np.column_stack([np.zeros(n), np.zeros(n), speed]),
        dcm_ned_body=np.tile(down, (n, 1, 1)),
        error_root_ned=np.tile(1e-6 * np.eye(6), (n, 1, 1)),
        force_root_body_mps2=np.zeros((n, 3, 12)),
    )


def sds_by_hand(noise, height, altitude, log_mach, pulse):
    """Sd of log density at ``height`` and of log C_A, mean over the pulse, of Gauss processes seen with white noise.

    Sounding 3 %, half of the variance constant, half correlated over 5 km; C_A 3 %, of which 2 % are correlated over a
    factor of two in Mach number.
    """

    def air(a, b):
        return 0.03**2 * (0.5 + 0.5 * np.exp(-np.abs(np.subtract.outer(a, b)) / 5000.0))

    def ca(a, b):
        apart = np.abs(np.subtract.outer(a, b))
        return 0.03**2 - 0.02**2 + 0.02**2 * np.exp(-apart / np.log(2.0))

    seen = air(altitude, altitude) + ca(log_mach, log_mach) + np.diag(noise**2)
    of_pulse = ca(log_mach[pulse], log_mach).mean(axis=0)
    cross = np.vstack([air(height, altitude), of_pulse])
    prior = np.append(np.full(len(height), 0.03**2), of_pulse[pulse].mean())
    return np.sqrt(prior - np.einsum("ij,ji->i", cross, np.linalg.solve(seen, cross.T))), np.sqrt(prior)


def test_sds_are_those_of_two_gauss_processes_that_are_seen_as_one():
    samples = straight_fall()
    still = replace(KNOWN, wind_sd_mps=np.full(41, 1e-6))
    model = atmosphere._Model(samples, still, DRAG)
    force, q, mach = model.forces(np.zeros((len(samples.time_s), atmosphere._UNKNOWNS)))
    samples = replace(samples, specific_force_body_mps2=force)
    found = atmosphere.reconstruct_air(samples, still, DRAG)
    keep = -force[:, 0] >= atmosphere.LEAST_AXIAL_MPS2
    axial = -force[keep, 0]
    noise = np.hypot(atmosphere._MODEL_FLOOR_MPS2 / axial, atmosphere._AXIAL_PART)
    height = found.profile.altitude_m.to_numpy()
    want, before = sds_by_hand(noise, height, samples.altitude_m[keep], np.log(mach[keep]), q[keep] >= 0.5 * q.max())
    assert found.parameters.sd[0] == pytest.approx(want[-1], rel=0.04)
    assert found.parameters.prior_sd[0] == pytest.approx(before[-1], rel=0.02)
    np.testing.assert_allclose(found.profile.density_ratio_sd, want[:-1], rtol=0.04)
    # and C_A's shape costs a part of what is known of density
    exact = atmosphere.reconstruct_air(samples, still, replace(DRAG, ca_shape_sd=0.0))
    assert found.profile.density_ratio_sd.mean() > 1.05 * exact.profile.density_ratio_sd.mean()


def test_coefficient_wrong_by_a_quarter_fails_its_check():
    samples = descent()
    seen = np.zeros((len(samples.time_s), atmosphere._UNKNOWNS))
    seen[:, 3] = np.log(1.25)
    checks = atmosphere.reconstruct_air(pushed(samples, seen), KNOWN, DRAG).consistency_checks
    assert "pre-flight-drag" in {v.code for v in checks if not v.passed}


def test_flow_that_turns_within_a_window_keeps_its_angle():
    """A body that coasts at 12 deg to the flow and spins by half a turn a window: C_A is that at 12 deg."""
    table = VEHICLE.aero
    quick = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 181)
    axis = rotations.dcm_from_q(rotations.exp(np.array([0.0, -0.5 * np.pi + np.deg2rad(12.0), 0.0])))
    spun = rotations.dcm_from_q(rotations.exp(np.column_stack([quick, 0.0 * quick, 0.0 * quick])))
    mean = (axis @ spun).mean(axis=0)
    samples = atmosphere.AirSamples(
        np.zeros(1), np.array([50e3]), np.array([[0.0, 0.0, 1000.0]]), mean[None], np.zeros((1, 3)),
        np.zeros((1, 6, 6)), np.zeros((1, 3, 12)),
    )  # fmt: skip
    force, q, mach = atmosphere._Model(samples, KNOWN, DRAG).forces(np.zeros((1, atmosphere._UNKNOWNS)))
    ca, cn = table.at(mach, np.deg2rad(12.0))[0, :2]
    load = q[0] * DRAG.area_per_mass_m2pkg
    assert force[0, 0] == pytest.approx(-load * ca, rel=1e-3)
    # across, the mean of what turns by half a turn: 2 / pi of it
    assert np.linalg.norm(force[0, 1:]) == pytest.approx(load * cn * 2.0 / np.pi, rel=0.02)
