"""Parts of a reconstruction by what they must obey: start, accelerometer's root, accepted readings, held-out noise."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import norm

from flightmodel import earth, rotations
from recon import atmosphere, fault_detection, setup
from recon.estimate import accelerometer_root
from recon.imu_screening import TransientOffset
from recon.propagation import correct
from recon.reconstruct import reconstruct
from recon.settings import Settings
from recon.state import packed


def test_a_start_is_the_datum_s_where_the_antenna_moves_about_it():
    # a turning body: places of the antenna by its attitude at three instants, and its velocity by their difference
    place, velocity = earth.ecef_from_geodetic(0.6, -1.9, 60e3), np.array([900.0, -2300.0, 400.0])
    arm, w = np.array([1.7, -0.4, 0.6]), np.array([0.7, -1.1, 0.5])
    q = rotations.exp(np.array([0.8, -0.3, 1.9]))
    step = 1e-3

    def antenna(t):
        # body rates are against inertial space, of which the Earth's axes turn away
        turned = rotations.multiply(
            rotations.exp(-t * earth.OMEGA_ECEF_RADPS), rotations.multiply(q, rotations.exp(t * w))
        )
        return place + t * velocity + rotations.rotate(turned, arm)

    seen = antenna(0.0), (antenna(step) - antenna(-step)) / (2.0 * step)
    rate = SimpleNamespace(
        time_s=np.array([9.0, 11.0]), measured_sensor=np.array([w, w]), spec=SimpleNamespace(dcm_body_sensor=np.eye(3))
    )
    model = SimpleNamespace(size=18, prior_sd=np.ones(18))
    state, _ = setup._start_by_inertial_sensors(
        (*seen, arm), (q, np.eye(3), np.zeros((3, 9))), 10.0, rate, model, earth.WGS84
    )
    np.testing.assert_allclose(state.position_ecef_m, place, rtol=0.0, atol=1e-8)
    # differences of 6e6 m over 2 ms: 1e-6 m/s
    np.testing.assert_allclose(state.velocity_ecef_mps, velocity, rtol=0.0, atol=1e-5)


def test_the_accelerometer_s_root_holds_what_goes_together():
    # of attitude and corrected force: the covariance that the joint one of the states gives through finite differences
    rng = np.random.default_rng(2)
    kept, dcm = 3, rotations.dcm_from_q(rotations.exp(np.array([0.2, -0.1, 0.4])))
    half = rng.standard_normal((18, 18)) * np.repeat([10.0, 1.0, 1e-3, 1e-2, 1e-4], [3, 3, 3, 3, 6])[:, None]
    joint = half @ half.T
    measured, errors = np.array([-60.0, 3.0, -2.0]), 1e-3 * rng.standard_normal(9)
    problem = SimpleNamespace(
        kept=np.ones(kept, dtype=bool), node_index=np.zeros(kept, dtype=int),
        motion=SimpleNamespace(force_sensor_mps2=measured[None], dcm_body_force=dcm),
    )  # fmt: skip
    states = SimpleNamespace(sensor_errors=np.tile(errors, (kept, 1)))
    root = accelerometer_root(problem, states, np.tile(packed(joint), (kept, 1)))[1]
    step = np.maximum(1e-3 * np.sqrt(np.diag(joint)[9:]), 1e-9)
    partials = np.column_stack(
        [
            (correct(measured[None], errors + s * e, dcm)[0] - correct(measured[None], errors - s * e, dcm)[0])
            / (2 * s)
            for s, e in zip(step, np.eye(9), strict=True)
        ]
    )
    together = joint[6:9, 9:] @ partials.T
    np.testing.assert_allclose(root[3:] @ root[3:].T, partials @ joint[9:, 9:] @ partials.T, rtol=1e-5)
    np.testing.assert_allclose(root[:3] @ root[3:].T, together, rtol=1e-4)
    # and no more of the attitude's variance than there is
    assert np.linalg.eigvalsh(joint[6:9, 6:9] - root[:3] @ root[:3].T).min() > -1e-12


@pytest.mark.parametrize(
    ("found", "offset"), [(0.0, 3.6), (0.0, 3.8), (1.0, 4.6), (1.0, 4.9), (-1.0, 2.5), (-1.0, 2.8)]
)
def test_readings_are_accepted_at_a_thousand_to_one(monkeypatch, found, offset):
    # one Gaussian reading of the offset with unit sd, ``found``: right where it is a thousand times likelier without
    score = np.zeros((1, 6))
    score[0, 4] = -found
    monkeypatch.setattr(fault_detection, "offset_scores", lambda *_: (score, np.eye(6)[None]))
    problem = SimpleNamespace(
        time_s=np.arange(10.0), model=SimpleNamespace(wander=SimpleNamespace(considered=np.zeros(3, dtype=bool)))
    )
    runs = (TransientOffset(1, 1, 3.0, 5.0, offset),)
    against = norm.logpdf(found) - norm.logpdf(found, offset)
    assert abs(against - np.log(1000.0)) > 0.1
    assert (fault_detection.unsupported_offsets(problem, None, runs) == ()) == (against > np.log(1000.0))


def test_held_out_readings_noise_is_in_what_is_predicted_of_them(mini_sense):
    # a radar that is held out moves nothing: with twice its noise stated only the prediction's variance grows, by 3
    telemetry, _ = mini_sense(1)
    west = telemetry.radars["west"]
    assert west.spec.elevation_sd_rad is None
    noisy = replace(west.spec, range_sd_m=2.0 * west.spec.range_sd_m, angle_sd_rad=2.0 * west.spec.angle_sd_rad)
    settings = Settings(output_rate_hz=2.0, without=("west",))
    one = reconstruct(telemetry, settings).held_out
    two = reconstruct(
        replace(telemetry, radars=telemetry.radars | {"west": replace(west, spec=noisy)}), settings
    ).held_out
    for component, sd in (("range", west.spec.range_sd_m), ("elevation", west.spec.angle_sd_rad)):
        grown, was = (t[t.component == component].predicted_sd.to_numpy() for t in (two, one))
        np.testing.assert_allclose(grown**2 - was**2, 3.0 * sd**2, rtol=1e-6)


def test_a_density_s_sd_is_of_the_density_not_of_its_logarithm():
    # half as dense again as the sounding: what an sd to either side does to the ratio
    samples = SimpleNamespace(altitude_m=np.linspace(30e3, 50e3, 200))
    height = atmosphere._knots(samples.altitude_m, atmosphere._KNOT_M)
    k = len(height)
    n = np.ones(200)
    model = SimpleNamespace(samples=samples, air=SimpleNamespace(density_sd=0.1 * n, wind_sd_mps=5.0 * n))
    estimate, sd = np.zeros(3 * k), np.full(3 * k, 0.02)
    estimate[:k] = 4.0
    at, more, less = (atmosphere._profile(model, height, estimate + side * sd, sd) for side in (0.0, 1.0, -1.0))
    want = 0.5 * (more.density_ratio - less.density_ratio)
    np.testing.assert_allclose(at.density_ratio_sd, want, rtol=1e-4)
    assert at.density_ratio.min() > 1.4
