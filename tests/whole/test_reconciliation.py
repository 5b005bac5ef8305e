"""The joint that explains a flight: derivatives, and an unknown joint recovered.

The flown vehicle has another joint, offset, stability, masses and coefficients than the vehicle file states.
"""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from click.testing import CliRunner

from flightmodel import rotations
from flightmodel.checks import GateError
from flightmodel.flightfolder import read_flight
from postflight.cli import cli
from postflight.flight import Flight
from postflight.reconciliation.command import credibility
from postflight.reconciliation.fit import mismatched_spans, reconcile, reconcile_with_freeplay, select_laws
from postflight.reconciliation.forward_model import (
    ATTITUDE,
    CREEP,
    DEFLECTION,
    DEFLECTION_RATE,
    RATE,
    VELOCITY,
    AtmosphereParameters,
    SpanFlights,
    TrialVehicle,
    VehicleParameters,
    fly_spans,
    select_measurements,
)
from postflight.reconciliation.gauss_newton import VACUUM_SD, Parameters, Problem
from postflight.reconciliation.posterior import joint_table, posterior_summary, sample, vehicle_file_lines
from postflight.reconstruction import reconstruct
from synthetic_flight import simulate
from synthetic_flight.folder import simulate_to_folder
from tests.recon import dispersed
from tests.wide_flights import flown as flown_wide
from tests.wide_flights import wide_flight

pytestmark = pytest.mark.slow
SEED = 5
STIFFER, MORE_DAMPING, OFFSET_M = 1.2, 1.3, (0.0025, -0.0012)


FREEPLAY_DEG, CREEP_SHARE, CREEP_S = 0.1, 0.15, 6.0


@pytest.fixture(scope="module")
def flown(tmp_path_factory):
    """Folder, truth and vehicle of a dispersed flight."""
    return fly(tmp_path_factory, 0.0)


@pytest.fixture(scope="module")
def loose(tmp_path_factory):
    """The same with freeplay."""
    folder, _, vehicle = fly(tmp_path_factory, FREEPLAY_DEG)
    return reconstruct(Flight(read_flight(folder))), vehicle


@pytest.fixture(scope="module")
def creeping(tmp_path_factory):
    """The same with creep."""
    folder, truth, vehicle = fly(tmp_path_factory, 0.0, CREEP_SHARE)
    return reconstruct(Flight(read_flight(folder))), truth, vehicle


def fly(tmp_path_factory, freeplay_deg, creep_share=0.0):
    scenario = dispersed.dispersed_scenario("irve2_reference", SEED)
    vehicle = scenario.vehicle
    body, joint = vehicle.centerbody, vehicle.joint
    y, z = np.array(OFFSET_M) * vehicle.mass_kg / body.mass_kg
    vehicle = replace(
        vehicle,
        centerbody=body.model_copy(update={"cg_from_datum_body_m": (body.cg_from_datum_body_m[0], float(y), float(z))}),
        joint=joint.model_copy(
            update={
                "bending_stiffness_nmprad": joint.bending_stiffness_nmprad * STIFFER,
                "bending_damping_nmsprad": joint.bending_damping_nmsprad * MORE_DAMPING,
                "freeplay_deg": freeplay_deg,
                "creep_share": creep_share,
                "creep_time_s": CREEP_S,
            }
        ),
        aero=vehicle.aero.scaled(ca=0.97, cn=1.06, cm=0.93, cmq_shift=0.1),
    )
    folder = tmp_path_factory.mktemp("reconciled") / "flight"
    truth = simulate_to_folder(replace(scenario, vehicle=vehicle), SEED, folder)
    return folder, truth, vehicle


@pytest.fixture(scope="module")
def problem(flown):
    flight = reconstruct(Flight(read_flight(flown[0])))
    measured = select_measurements(flight)
    air = AtmosphereParameters(flight.telemetry.sounding, float(measured.altitude_m.min()))
    return Problem(measured, VehicleParameters(flight.telemetry.required_vehicle()), air)


def near(problem: Problem) -> Parameters:
    """Parameters away from the nominal ones, spans deflected and moving."""
    rng = np.random.default_rng(1)
    u = problem.start()
    motion = u.motion.copy()
    motion[:, ATTITUDE] = 1e-3 * rng.standard_normal((len(motion), 3))
    motion[:, RATE] += 1e-3 * rng.standard_normal((len(motion), 3))
    motion[:, DEFLECTION] = [1e-6, 0.02, 0.03] * rng.standard_normal((len(motion), 3))
    motion[:, DEFLECTION_RATE] = [1e-3, 0.1, 0.1] * rng.standard_normal((len(motion), 3))
    motion[:, VELOCITY] = 0.1 * rng.standard_normal((len(motion), 3))
    air = np.array([0.01, 1.0, 1.0])[:, None] * rng.standard_normal(u.air.shape)
    warmer = rng.standard_normal(u.warmer_k.shape)
    instruments = rng.standard_normal(u.instruments.shape)
    return Parameters(0.3 * rng.standard_normal(u.vehicle.shape), instruments, air, warmer, motion)


def test_gradient_is_that_of_the_cost(problem):
    """Of every group of unknowns, along a random direction, against central differences."""
    u = near(problem)
    right = problem.normal_equations(u, problem.linearize(u)).right
    rng = np.random.default_rng(2)
    first = problem.first_motion
    groups = {
        "vehicle": slice(0, problem.first_instrument),
        "instruments": slice(problem.first_instrument, problem.first_instrument + 20),
        "air": slice(problem.first_instrument + 20, problem.first_temperature),
        "temperature": slice(problem.first_temperature, first),
        "motion": slice(first, problem.count),
    }
    of_motion = np.tile(np.repeat([1e-7, 1e-5], [12, 3]), problem.measured.spans)
    sizes = {"vehicle": 1e-4, "instruments": 1e-2, "air": 1e-5, "temperature": 1e-3, "motion": of_motion}
    for name, part in groups.items():
        step = np.zeros(problem.count)
        step[part] = sizes[name] * rng.standard_normal(part.stop - part.start)
        difference = problem.residuals(u.plus(step)).cost - problem.residuals(u.plus(-step)).cost
        # the air's differences of 1e-7 to 1e-4 scatter by 0.2 % themselves: spans cross kinks of the coefficient table
        assert right @ step == pytest.approx(-0.25 * difference, rel=5e-3 if name == "air" else 2e-3), name


def test_noise_has_no_information_on_a_scale(problem):
    """A scale that acted on measured rates would lower the cost by scaling their noise."""
    u, rng = problem.start(), np.random.default_rng(3)
    predicted = problem.predict(u)
    noisy = replace(problem)
    sd = np.divide(1.0, problem.weight, out=np.zeros_like(problem.weight), where=problem.weight > 0.0)
    noisy.__dict__["data"] = predicted.windows + 30.0 * sd * rng.standard_normal(sd.shape)
    normal = noisy.normal_equations(u, noisy.linearize(u))
    for number in (3, 4, 5, 12, 13, 14):  # scale of gyros; errors of the accelerometer that the trajectory left
        k = problem.first_instrument + number
        assert abs(normal.right[k]) < 4.0 * 30.0 * np.sqrt(normal.matrix.diagonal[normal.place[k]])


def flown_spans(measured, truth, vehicle):
    """True motion at the starts of spans, with the creep where the joint has it, and the spans flown from there."""
    at = [int(np.argmin(np.abs(truth.time_s - t))) for t in measured.start.time_s]
    path, state = truth.trajectory, truth.state_eci[at]
    place = replace(
        measured.start, position_ecef_m=path.position_ecef_m[at], velocity_ecef_mps=path.velocity_ecef_mps[at]
    )
    q_body_shell = rotations.multiply(rotations.conjugate(state[:, 6:10]), state[:, 10:14])
    shell_rate = state[:, 17:20] - rotations.rotate(rotations.conjugate(q_body_shell), state[:, 14:17])
    rotation = rotations.boxminus(path.q_ecef_body[at], place.q_ecef_body)
    turning = [rotation, state[:, 14:17], rotations.log(q_body_shell), shell_rate]
    motion = np.column_stack([*turning, np.zeros((len(at), 3)), state[:, 20:]])
    spans = np.arange(measured.spans)
    zero = np.zeros_like(spans)
    true = TrialVehicle(vehicle, simulate.parameter_vector(vehicle))
    flights = SpanFlights(spans, zero, motion[:-1], zero, [true], simulate.atmosphere_table(truth.profile))
    predicted = fly_spans(replace(measured, start=place), vehicle, flights)
    return motion, predicted


def test_spans_of_the_true_flight_join(problem, flown):
    """Flown from the true motion with the true vehicle and air every span ends where the next begins."""
    _, truth, vehicle = flown
    measured = problem.measured
    motion, predicted = flown_spans(measured, truth, vehicle)
    assert np.abs(motion[:, DEFLECTION]).max() > 0.02
    # steps of 10 ms, of which the twist is slowed: well inside what joins are believed to
    assert (np.abs((predicted.end - motion[1:])[:, :12]) / VACUUM_SD[:12]).max() < 0.2
    assert np.abs(predicted.end[:, VELOCITY]).max() < 1e-4


@pytest.mark.long
@pytest.mark.parametrize(("step_m", "low", "high"), [(250.0, 0.0, 0.1), (50.0, 0.3, 1.0)])
def test_the_turbulence_of_a_flight_is_estimated(step_m, low, high, tmp_path_factory, monkeypatch):
    """Synthetic air is straight between points; knots are 125 m apart."""
    monkeypatch.setattr("synthetic_flight.weather.STEP_M", step_m)
    found = reconcile(reconstruct(Flight(read_flight(fly(tmp_path_factory, 0.0)[0]))))
    assert low < found.problem.air.turbulence_share < high


def test_an_unknown_joint_is_found(flown, monkeypatch):
    """Within 4 sd and the goals: 4 % of stiffness, 0.08 cm of offset; coverage is `benchmarks/reconciliation.py`'s."""
    folder, truth, vehicle = flown
    monkeypatch.setattr("postflight.reconciliation.command.ENTRIES", 100)
    done = CliRunner().invoke(cli, ["reconcile", str(folder)], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    run = next((folder / "runs").glob("*/joint.csv")).parent
    table = pd.read_csv(run / "joint.csv").set_index("quantity")
    assert table.found["bending stiffness"] == pytest.approx(vehicle.joint.bending_stiffness_nmprad, rel=0.04)
    for name, true in (
        ("bending stiffness", vehicle.joint.bending_stiffness_nmprad),
        ("free-free frequency", vehicle.free_free_frequency_hz()),
        ("damping ratio", vehicle.joint.bending_damping_nmsprad / vehicle.critical_damping_nmsprad()),
        ("c.g. offset y", 100.0 * vehicle.cg_m[1]),
        ("c.g. offset z", 100.0 * vehicle.cg_m[2]),
        ("static stability", 0.93),
    ):
        by_factor = table.low[name] > 0.0 and "offset" not in name and name != "static stability"
        error = np.log(table.found[name] / true) * table.found[name] if by_factor else table.found[name] - true
        assert abs(error) < 4.0 * table.sd[name], name
    facts = json.loads((run / "reconciliation.json").read_text())
    by_modes, sd = facts["stiffness_by_modes_nmprad"], facts["stiffness_by_modes_sd_nmprad"]
    assert abs(by_modes - vehicle.joint.bending_stiffness_nmprad) < 3.5 * sd < 0.15 * by_modes
    for axis in "yz":
        assert abs(table.found[f"c.g. offset {axis}"] - 100.0 * vehicle.cg_m["xyz".index(axis)]) < 0.08
    bent = pd.read_csv(run / "deflection_reconciled.csv")
    true = np.interp(bent.t_s, truth.time_s, np.rad2deg(truth.deflection.theta_rad))
    assert np.sqrt(np.mean((bent.theta_deg - true) ** 2)) < 0.15
    assert {p.name for p in run.iterdir()} >= {"joint.toml", "reconciliation.json", "joint_correlations.csv", "figures"}


@pytest.mark.long
def test_a_joint_bent_by_degrees_on_a_fast_spin_keeps_its_damping(tmp_path):
    """23 deg at 57 rpm: by the fit's own integration steps the damping comes out 10 % low, 10 sd."""
    one = wide_flight(61001, bent=True)
    telemetry, truth = flown_wide(one, tmp_path / "flight")
    assert np.rad2deg(np.nanmax(truth.deflection.theta_rad)) > 15.0
    fit = reconcile(reconstruct(Flight(telemetry)))
    assert fit.problem.step_error is not None
    assert all(check.passed for check in credibility(fit))
    row = joint_table(fit).set_index("quantity").loc["damping ratio"]
    true = one.flown.joint.bending_damping_nmsprad / one.flown.critical_damping_nmsprad()
    assert abs(np.log(row.found / true)) < 4.0 * row.sd / row.found < 0.06


@pytest.mark.long
def test_freeplay_is_found(loose):
    flight, vehicle = loose
    found = reconcile_with_freeplay(flight, select_measurements(flight, loaded=True))
    assert found.converged
    assert not mismatched_spans(found).any()
    row = joint_table(found).set_index("quantity").loc["freeplay"]
    assert abs(row.found - FREEPLAY_DEG) < 4.0 * row.sd < 0.05
    stiffness = found.vehicle.joint.bending_stiffness_nmprad
    assert stiffness == pytest.approx(vehicle.joint.bending_stiffness_nmprad, rel=0.06)
    assert f"freeplay_deg = {row.found:.4f}"[:-1] in vehicle_file_lines(found)


@pytest.mark.long
def test_freeplay_is_separated_from_a_plain_joint(loose, flown):
    """And what the evidence rejects is not in the fitted joint."""
    selection = select_laws(loose[0], ("freeplay",))
    assert selection.log_odds["freeplay"] > 3.0
    assert selection.fit.problem.vehicle_parameters.laws == ("freeplay",)
    plain = select_laws(reconstruct(Flight(read_flight(flown[0]))), ("freeplay", "hardening"))
    assert plain.log_odds["freeplay"] < 0.0
    assert "freeplay" not in plain.fit.problem.vehicle_parameters.laws


def test_spans_of_a_true_flight_with_creep_join(creeping):
    """And the gradient by its creep is that of the cost."""
    flight, truth, vehicle = creeping
    measured = select_measurements(flight)
    motion, predicted = flown_spans(measured, truth, vehicle)
    assert np.abs(motion[:, CREEP]).max() > 0.002
    assert np.abs((predicted.end - motion[1:])[:, CREEP]).max() < np.deg2rad(2e-4)
    air = AtmosphereParameters(flight.telemetry.sounding, float(measured.altitude_m.min()))
    problem = Problem(measured, VehicleParameters(flight.telemetry.required_vehicle(), ("creep",)), air)
    u = near(problem)
    u.motion[:, CREEP] = 0.01 * np.random.default_rng(4).standard_normal((len(u.motion), 2))
    right = problem.normal_equations(u, problem.linearize(u)).right
    for columns, size in (
        ([5, 6], 1e-4),
        (problem.first_motion + problem.motion * np.arange(measured.spans) + CREEP.start, 1e-7),
    ):
        step = np.zeros(problem.count)
        step[columns] = size * np.random.default_rng(5).standard_normal(len(columns))
        difference = problem.residuals(u.plus(step)).cost - problem.residuals(u.plus(-step)).cost
        assert right @ step == pytest.approx(-0.25 * difference, rel=2e-3)


@pytest.mark.long
def test_creep_is_found_and_one_stiffness_is_red(creeping, flown):
    """And a plain flight has none."""
    flight, _, vehicle = creeping
    selection = select_laws(flight, ("creep",))
    assert selection.log_odds["creep"] > 20.0
    table = joint_table(selection.fit).set_index("quantity")
    for name, true in (("creep share", CREEP_SHARE), ("creep time", CREEP_S),
                       ("bending stiffness", vehicle.joint.bending_stiffness_nmprad)):  # fmt: skip
        assert abs(table.found[name] - true) < 4.0 * table.sd[name], name
    assert "creep_share = 0.1" in vehicle_file_lines(selection.fit)
    assert not [each.code for each in credibility(selection.fit) if not each.passed]
    assert "joint-creep" in [each.code for each in credibility(selection.compared["creep"][0]) if not each.passed]
    plain = select_laws(reconstruct(Flight(read_flight(flown[0]))), ("creep",))
    assert plain.log_odds["creep"] < 0.0
    assert "joint-creep" not in [each.code for each in credibility(plain.fit) if not each.passed]


@pytest.mark.long
def test_the_posterior_is_that_of_new_fits(flown):
    """Interpolated log probability against new fits, two sd away; widths against the linear problem."""
    found = reconcile(reconstruct(Flight(read_flight(flown[0]))))
    sampled = sample(found)
    assert np.abs(sampled.refit_error).max() < 2.0  # of a cost of four there
    table = posterior_summary(sampled).set_index("quantity")
    for name in ("stiffness_nmprad", "cg_offset_y_cm", "cg_offset_z_cm", "static_stability"):
        assert table.sd[name] == pytest.approx(table.linear_sd[name], rel=0.3), name


def test_a_flight_without_a_pulse_is_refused(flown):
    flight = reconstruct(Flight(read_flight(flown[0])))
    with pytest.raises(GateError) as refusal:
        select_measurements(replace(flight, loads=None, missing=("no vehicle is given",)))
    assert refusal.value.codes == ("input-missing",)
    high = replace(flight, air=replace(flight.air, altitude_m=flight.air.altitude_m + 200e3))
    with pytest.raises(GateError) as refusal:
        select_measurements(high)
    assert refusal.value.codes == ("time-not-covered",)
