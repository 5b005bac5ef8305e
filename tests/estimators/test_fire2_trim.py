"""Project FIRE II, a rigid body: trim and pitch follow from its published coefficients as NASA TN D-4183 has them."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from estimators.trim import TrimModel, moment_term, solve_trim
from flightmodel.aerodynamics import AeroTable

from .conftest import pulse_of

DATA = Path(__file__).parents[1] / "data" / "fire2"
DEFINITION = json.loads((DATA / "fire2_definition.json").read_text())
LENGTH_M, AREA_M2 = DEFINITION["reference_diameter_m"], DEFINITION["reference_area_m2"]
FORWARD_M = DEFINITION["cg_forward_of_moment_reference_m"]
PUBLISHED_SLOPE = -0.1423  # C_m,alpha about the c.g., 1/rad


def fire2():
    """Balance about the c.g. of coefficients that refer to a station behind it; deflection shifts nothing."""
    rows = np.genfromtxt(DATA / "fire2_aerodynamics_mach35.csv", delimiter=",", names=True)
    uniform = np.arange(0.0, rows["alpha_deg"][-1] + 1.0, 5.0)
    columns = [np.interp(uniform, rows["alpha_deg"], sign * rows[c]) for c, sign in (("CX", -1), ("CR", 1), ("CM", 1))]
    table = np.stack([*columns, np.zeros(len(uniform))], axis=-1)
    aero = AeroTable(np.array([30.0, 40.0]), np.deg2rad(uniform), np.stack([table, table]))
    inertia = np.diag([DEFINITION["inertia_kgm2"][k] for k in ("Ix_roll", "Iy", "Iz")])
    return TrimModel(aero, -FORWARD_M, 0.0, np.zeros(2), LENGTH_M, AREA_M2, inertia)


def test_trim_angle_for_an_offset_is_that_of_the_published_slope():
    # about the c.g. C_A z = -C_m,alpha l alpha, within the table's first knot of 5 deg; printed to four digits
    model = fire2()
    alpha = np.deg2rad(np.array([1.0, 2.5, 5.0]))
    offset = model.offset_for_angle(np.full(3, 35.0), alpha)
    axial = model.aero.at(35.0, alpha)[:, 0]
    np.testing.assert_allclose(offset * axial / (LENGTH_M * alpha), -PUBLISHED_SLOPE, rtol=5e-4)


def test_rigid_pitching_at_the_frequency_of_the_published_slope_needs_no_bending():
    """With the angular acceleration of ``w^2 = -q S l C_m,alpha / I`` the balance closes at every angle of the swing.

    A tenth of the frequency more and it does not: what closes it is the frequency.
    """
    loads, _ = pulse_of(np.random.default_rng(0), 60)
    model, pressure = fire2(), 4000.0
    frequency = np.sqrt(-pressure * AREA_M2 * LENGTH_M * PUBLISHED_SLOPE / DEFINITION["inertia_kgm2"]["Iy"])
    assert frequency / (2.0 * np.pi) == pytest.approx(1.11, abs=0.005)  # Hz at 4 kPa, without spin
    angle = np.deg2rad(4.0) * np.sin(0.3 * np.arange(60.0))
    flow = np.column_stack([np.zeros(60), angle])
    for faster, closes in ((1.0, True), (1.1, False)):
        # nose up (towards -z) is a turn about +y; the flow's side is where the body's axis does not point
        turn = np.column_stack([np.zeros(60), -((faster * frequency) ** 2) * angle, np.zeros(60)])
        moving = replace(
            loads,
            flow_yz_rad=flow,
            mach=np.full(60, 35.0),
            dynamic_pressure_pa=np.full(60, pressure),
            rate_body_radps=np.zeros((60, 3)),
            angular_acceleration_body_radps2=turn,
        )
        moment = moment_term(model, moving)
        found = solve_trim(replace(model, xbar_m=1e-9), moving.mach, flow, moment)
        worst = np.rad2deg(np.abs(found).max())
        # C_A falls by 0.5 % to 4 deg
        assert (worst < 0.05) == closes
