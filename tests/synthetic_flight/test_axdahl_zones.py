"""Axdahl's three zones come out of the nonlinear simulator where the linear model puts them.

Authority: the linear model (itself held to printed eigenvalues in test_linear.py) against flights of the kernel
at terminal speed in air of one density. Zones: divergent below a stiffness that hardly depends on damping; stable at
moderate stiffness and damping; oscillating ever wider at high stiffness where C_mq > 0.
"""

import numpy as np
import pytest

from flightmodel.linear import DIVERGENT, STABLE, UNSTABLE
from tests.oracles import axdahl_zones
from tests.oracles.axdahl_zones import JointGrid

from .test_linear import PRESSURE_PA, SPEED_MPS, r1_slopes

STIFFNESS = np.geomspace(2.2e3, 4.0e4, 14)
DAMPING = np.geomspace(2e-3, 0.3, 9)


def grid_of(vehicle, cmq, damping=DAMPING):
    return JointGrid(vehicle, r1_slopes(cmq), PRESSURE_PA, SPEED_MPS, STIFFNESS, damping)


def test_zones_lie_as_axdahl_has_them(vehicle):
    # the static limit hardly moves with damping; stable at moderate stiffness; unstable again when stiff
    found = axdahl_zones.linear_map(grid_of(vehicle, 0.2))
    soft = found.zone == DIVERGENT
    below = found.critical_stiffness_nmprad > STIFFNESS
    assert (soft == below[:, None]).all()
    moderate = (STIFFNESS > 4.0e3) & (STIFFNESS < 9.0e3)
    assert (found.zone[moderate][:, DAMPING > 0.1] == STABLE).all()
    assert (found.zone[STIFFNESS > 2.0e4][:, DAMPING < 0.15] == UNSTABLE).all()
    # without propelling pitch damping nothing but divergence is left once the joint is damped by 5 %
    damped = axdahl_zones.linear_map(grid_of(vehicle, -0.2, DAMPING[DAMPING > 0.05]))
    assert (damped.zone[~below] == STABLE).all()


@pytest.mark.slow
def test_flown_zones_agree_with_the_linear_model(vehicle, measured):
    grid = grid_of(vehicle, 0.2)
    linear, flown = axdahl_zones.linear_map(grid), axdahl_zones.flown_map(grid)
    # a fall of 120 s is 340 s at this pressure: growth below 0.01 1/s is hidden by the other modes' beat
    clear = np.abs(linear.growth_rate_radps) > 0.01
    measured("share of the grid within 0.01 1/s of a boundary", 1.0 - clear.mean(), 0.10)
    measured("zones that differ, away from the boundary", np.mean((linear.zone != flown.zone)[clear]), 0.0)
    measured("zones that differ, anywhere", np.mean(linear.zone != flown.zone), 0.05)
    assert {STABLE, UNSTABLE, DIVERGENT} == set(linear.zone.ravel().tolist()) == set(flown.zone.ravel().tolist())
    # growth itself: two modes of like growth beat, and gravity grows by 1.8 % along the fall
    grows = linear.growth_rate_radps > 0.02
    difference = np.abs(flown.growth_rate_radps - linear.growth_rate_radps)[grows]
    allowed = 0.01 + 0.02 * linear.growth_rate_radps[grows]
    measured("growth rate, of 0.01 1/s + 2 %", np.max(difference / allowed), 1.0)
    figure = axdahl_zones.figure_axdahl_zones(linear, flown)
    assert len(figure.axes) == 1
