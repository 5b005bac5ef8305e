"""The smoothed trajectory against GTSAM's batch solution of the same readings.

GTSAM integrates the inertial sensors between track points by its own preintegration (on its own manifold), linearises
by its own factors and solves for all nodes at once by its own Gauss-Newton steps and sparse QR elimination: no filter,
no smoother, no covariance handed from node to node. Ours to write were the radars' factors, with numerical partials.
Its factors know a frame that does not turn, gravity that does not change, sensors with a bias only, and attitude held
through a step. So the nodes live in inertial axes; each interval has the gravitation of where it is (evaluated anew
after each solution until nothing moves); scale and mounting errors are zero in this flight's data and data sheets; and
the specific force of each step is given in the axes of the step's start. Half a second lies between track points, 101
nodes in all, through the whole pulse.

What may differ: integration between samples (1e-5 of what the pulse does), gravity's gradient, which moves a node's
partials by 1e-6 t^2, and diffuse priors about another mean, 1e-5 of a standard deviation. Together below 0.02 sd.
"""

from dataclasses import replace

import numpy as np
import pytest

from flightmodel import earth, rotations
from flightmodel.telemetry import RadarRecord, TriadRecord
from recon.reconstruct import reconstruct
from recon.settings import Settings

from .conftest import ACCELEROMETER, CG, IMU, RATES, SITES, START, body_rate, measure_radar, measure_triad

gtsam = pytest.importorskip("gtsam", reason="gtsam has no wheel for this platform: the batch solution is not compared")

TRACK_STEP_S, SPAN_S, SUBSTEP_S = 0.5, 50.0, 0.01
ARM = CG - IMU
BIAS_ONLY = {"scale_sd": 0.0, "mount_sd_rad": 0.0, "resolution": 0.0}
FORCE, RATE = replace(ACCELEROMETER, **BIAS_ONLY), replace(RATES, **BIAS_ONLY)
X, V, B = (lambda k, c=c: gtsam.symbol(c, k) for c in "xvb")


def R(k):
    return gtsam.symbol("r", k)


@pytest.fixture(scope="module")
def telemetry(mini_truth, mini_sense):
    rng = np.random.default_rng(77)
    whole, _ = mini_sense(77, prior_time_s=START)
    t = np.arange(START - 1.0, START + SPAN_S + 1.0, 0.01) + 0.0013
    force, _ = measure_triad(FORCE, mini_truth.specific_force_imu(t), rng)
    rate, _ = measure_triad(RATE, body_rate(t), rng)
    tags = START + TRACK_STEP_S * np.arange(round(SPAN_S / TRACK_STEP_S) + 1)
    radars = {s.name: RadarRecord(s, tags, measure_radar(mini_truth, s, tags, rng)[0]) for s in SITES}
    return replace(whole, accelerometer=TriadRecord(FORCE, t, force), rates=TriadRecord(RATE, t, rate), radars=radars)


@pytest.fixture(scope="module")
def ours(telemetry):
    # two points in a hundred thousand fail this gate: GTSAM has none
    return reconstruct(telemetry, Settings(output_rate_hz=1.0 / TRACK_STEP_S, gate_probability=0.99999))


class Batch:
    """The factor graph."""

    def __init__(self, telemetry, truth):
        self.radars = list(telemetry.radars.values())
        self.time_s = self.radars[0].time_s
        self.steps = [self.substeps(telemetry, a, a + TRACK_STEP_S) for a in self.time_s[:-1]]
        rate = telemetry.rates
        self.rate = np.column_stack([np.interp(self.time_s, rate.time_s, c) for c in rate.measured_sensor.T])
        self.to_ecef = [rotations.dcm_from_q(earth.q_ecef_eci(t)) for t in self.time_s]
        # a start far from the truth, of which the diffuse prior knows nothing
        at = truth.trajectory(self.time_s[:1], IMU)
        back = self.to_ecef[0].T
        position = at.position_ecef_m[0] + [40.0, -30.0, 20.0]
        speed = at.velocity_ecef_mps[0] + np.cross(earth.OMEGA_ECEF_RADPS, position) + [3.0, -2.0, 4.0]
        turn = back @ rotations.dcm_from_q(telemetry.attitude_prior.q_ecef_body)
        self.start = gtsam.Pose3(gtsam.Rot3(turn), back @ position), back @ speed
        self.attitude_sd = telemetry.attitude_prior.sd_rad

    def substeps(self, telemetry, a, b):
        """Mean specific force (in the axes of each substep's start) and rate (k, 3), body axes."""
        edges = np.linspace(a, b, round((b - a) / SUBSTEP_S) + 1)
        means = []
        for record in (telemetry.accelerometer, telemetry.rates):
            fine = np.linspace(a, b, 10 * (len(edges) - 1) + 1)
            x = np.column_stack([np.interp(fine, record.time_s, c) for c in record.measured_sensor.T])
            half = 0.5 * (x[1:] + x[:-1])
            means.append(half.reshape(-1, 10, 3).mean(axis=1) @ record.spec.dcm_body_sensor.T)
        force, rate = means
        return rotations.rotate(rotations.exp(0.5 * SUBSTEP_S * rate), force), rate

    def preintegrated(self, k, gravity, bias):
        params = gtsam.PreintegrationParams(gravity)
        params.setAccelerometerCovariance(np.eye(3) * FORCE.noise_sd**2 / 100.0)
        params.setGyroscopeCovariance(np.eye(3) * RATE.noise_sd**2 / 100.0)
        params.setIntegrationCovariance(np.eye(3) * 1e-12)
        out = gtsam.PreintegratedImuMeasurements(params, bias)
        for force, rate in zip(*self.steps[k], strict=True):
            out.integrateMeasurement(force, rate, SUBSTEP_S)
        return out

    def guess(self):
        """Dead reckoning from the start."""
        values, bias = gtsam.Values(), gtsam.imuBias.ConstantBias()
        state = gtsam.NavState(*self.start)
        for k in range(len(self.time_s)):
            values.insert(X(k), state.pose())
            values.insert(V(k), state.velocity())
            if k < len(self.steps):
                gravity = earth.gravitation(state.position() + 0.5 * TRACK_STEP_S * state.velocity())
                state = self.preintegrated(k, gravity, bias).predict(state, bias)
        values.insert(B(0), bias)
        for i in range(len(self.radars)):
            values.insert(R(i), np.zeros(4))
        return values

    def graph(self, values):
        """All factors, gravitation taken at ``values``."""
        graph = gtsam.NonlinearFactorGraph()
        sigmas = gtsam.noiseModel.Diagonal.Sigmas
        bias = values.atConstantBias(B(0))
        for k in range(len(self.steps)):
            ends = [values.atPose3(X(j)).translation() for j in (k, k + 1)]
            speeds = [values.atVector(V(j)) for j in (k, k + 1)]
            middle = 0.5 * (ends[0] + ends[1]) + TRACK_STEP_S / 8.0 * (speeds[0] - speeds[1])
            pim = self.preintegrated(k, earth.gravitation(middle), bias)
            graph.add(gtsam.ImuFactor(X(k), V(k), X(k + 1), V(k + 1), B(0), pim))
        graph.add(gtsam.PriorFactorPose3(X(0), self.start[0], sigmas(np.r_[self.attitude_sd, np.full(3, 1000.0)])))
        graph.add(gtsam.PriorFactorVector(V(0), self.start[1], sigmas(np.full(3, 100.0))))
        both = np.repeat([FORCE.bias_sd, RATE.bias_sd], 3)
        graph.add(gtsam.PriorFactorConstantBias(B(0), gtsam.imuBias.ConstantBias(), sigmas(both)))
        for i, record in enumerate(self.radars):
            s = record.spec
            sd = np.array([s.range_bias_sd_m, s.angle_bias_sd_rad, s.angle_bias_sd_rad, s.time_bias_sd_s])
            graph.add(gtsam.PriorFactorVector(R(i), np.zeros(4), sigmas(sd)))
            for k, z in enumerate(record.range_az_el):
                noise = np.array([s.range_sd_m, s.angle_sd_rad / np.cos(z[2]), s.angle_sd_rad])
                graph.add(gtsam.CustomFactor(sigmas(noise), [X(k), V(k), R(i)], self.radar_factor(k, s, z)))
        return graph

    def radar_factor(self, k, site, z):
        """Residual ``predicted - measured`` and its partials by pose, velocity and the radar's four errors."""
        moves = np.repeat([1e-3, 1.0, 1.0, 1e-3], [3, 3, 3, 1])  # pose (rotation, translation), velocity, time tag
        dcm, rate = self.to_ecef[k], self.rate[k]

        def error(this, values, jacobians):
            pose, speed = values.atPose3(this.keys()[0]), values.atVector(this.keys()[1])
            e = values.atVector(this.keys()[2])

            def seen(d):
                moved = pose.retract(d[:6])
                c = moved.rotation().matrix()
                place = dcm @ (moved.translation() + c @ ARM)
                inertial = dcm @ (speed + d[6:9] + c @ np.cross(rate, ARM))
                return place - (e[3] + d[9]) * (inertial - np.cross(earth.OMEGA_ECEF_RADPS, place))

            offsets = [np.zeros(10)] if jacobians is None else [np.zeros(10), *np.diag(moves), *np.diag(-moves)]
            points = np.array([seen(d) for d in offsets])
            h = earth.radar_from_ecef(points, site.latitude_rad, site.longitude_rad, site.height_m)
            if jacobians is not None:
                partials = ((h[1:11] - h[11:]) / (2.0 * moves[:, None])).T
                jacobians[0], jacobians[1] = partials[:, :6], partials[:, 6:9]
                jacobians[2] = np.column_stack([np.eye(3), partials[:, 9]])
            return h[0] + e[:3] - z

        return error

    def solve(self):
        """Solution and its graph."""
        values = self.guess()
        params = gtsam.GaussNewtonParams()
        params.setLinearSolverType("MULTIFRONTAL_QR")
        params.setRelativeErrorTol(1e-9)
        params.setAbsoluteErrorTol(1e-7)
        for _ in range(8):
            graph = self.graph(values)
            before = np.array([values.atPose3(X(k)).translation() for k in range(len(self.time_s))])
            values = gtsam.GaussNewtonOptimizer(graph, values, params).optimize()
            after = np.array([values.atPose3(X(k)).translation() for k in range(len(self.time_s))])
            if np.abs(after - before).max() < 1e-3:
                break
        return graph, values


def pose_covariances(linear, count):
    """Covariances (n, 6, 6) of rotation and translation, body axes, from GTSAM's whitened partials of all factors.

    Its own marginals come by Cholesky of the information, which this problem's 1 km beside 1 mm do not allow.
    """
    a, _ = linear.jacobian()  # columns in order of keys, of which those of the poses ("x") are the last
    scale = np.linalg.norm(a, axis=0)
    root = np.linalg.qr(a / scale, mode="r")
    rows = np.linalg.inv(root)[-6 * count :] / scale[-6 * count :, None]
    return np.array([part @ part.T for part in rows.reshape(count, 6, -1)])


@pytest.fixture(scope="module")
def theirs(telemetry, mini_truth):
    """Datum's position, velocity, attitude (n, 10), Earth-fixed, and the sd (n, 6) of position and rotation."""
    batch = Batch(telemetry, mini_truth)
    graph, values = batch.solve()
    poses = pose_covariances(graph.linearize(values), len(batch.time_s))
    gyro = values.atConstantBias(B(0)).gyroscope()
    out, sd = [], []
    for k in range(len(batch.time_s)):
        pose, dcm = values.atPose3(X(k)), batch.to_ecef[k]
        c = dcm @ pose.rotation().matrix()
        place = dcm @ pose.translation() - c @ IMU
        speed = dcm @ values.atVector(V(k)) - c @ np.cross(batch.rate[k] - gyro, IMU)
        q = rotations.q_from_dcm(c[None])[0]
        out.append(np.concatenate([place, speed - np.cross(earth.OMEGA_ECEF_RADPS, place), q]))
        p = poses[k]
        moved = np.zeros((3, 6))  # the datum moves with the accelerometer and turns about it
        moved[:, :3], moved[:, 3:] = c @ rotations.skew(IMU), c
        sd.append(np.sqrt(np.concatenate([np.diag(moved @ p @ moved.T), np.diag(p)[:3]])))
    return np.array(out), np.array(sd)


def test_smoothed_trajectory_is_the_batch_solution(ours, theirs, record_property):
    a, (b, _) = ours.smoothed, theirs
    assert len(a.time_s) == len(b)
    difference = np.hstack(
        [
            a.position_ecef_m - b[:, 0:3],
            a.velocity_ecef_mps - b[:, 3:6],
            rotations.boxminus(a.q_ecef_body, b[:, 6:10]),
        ]
    )
    ratio = np.abs(difference) / np.sqrt(np.diagonal(a.covariance, axis1=1, axis2=2))
    for name, part in (("position", slice(0, 3)), ("velocity", slice(3, 6)), ("attitude", slice(6, 9))):
        record_property(f"{name} against GTSAM, of 1 sd", f"{ratio[:, part].max():.2g} against 0.02")
    assert ratio.max() < 0.02


def test_standard_deviations_are_the_batch_solution_s(ours, theirs, record_property):
    sd = np.sqrt(np.diagonal(ours.smoothed.covariance, axis1=1, axis2=2))[:, [0, 1, 2, 6, 7, 8]]
    apart = np.abs(sd / theirs[1] - 1.0).max(axis=0)
    record_property("sd of position, attitude against GTSAM", " ".join(f"{x:.2g}" for x in apart) + " against 0.01")
    assert apart.max() < 0.01
