"""Simple bodies as the simulator knows them: rigid (joint locked), dragging against the velocity, on the ground."""

from dataclasses import replace

import numpy as np

from flightmodel.aerodynamics import AeroTable
from flightmodel.vehicle import MassProperties, Reference


def drag_table(drag_coefficient, knots=3601):
    """C_A = C_D cos alpha, C_N = C_D sin alpha: drag against the velocity at every angle of attack.

    Linear between knots 0.05 deg apart: (8.7e-4)^2 / 8 = 1e-7 of the drag.
    """
    alpha = np.linspace(0.0, np.pi, knots)
    zero = np.zeros(knots)
    row = np.column_stack([drag_coefficient * np.cos(alpha), drag_coefficient * np.sin(alpha), zero, zero])
    return AeroTable(np.array([0.0, 100.0]), alpha, np.stack([row, row]))


def rigid_vehicle(vehicle, mass_kg, inertia_kgm2, area_m2, drag_coefficient, apart_m=(0.0, 0.0, 0.0), share=0.4):
    """Two bodies that together have this mass, this inertia about the c.g., and their c.g. at the datum.

    Drag acts at the datum, so without a moment. ``apart_m`` is the vector between the two c.g.s; the shell has
    ``share`` of the mass.
    """
    apart, inertia = np.array(apart_m), np.asarray(inertia_kgm2, dtype=float)
    reduced = share * (1.0 - share) * mass_kg
    own = inertia - reduced * (apart @ apart * np.eye(3) - np.outer(apart, apart))

    def part(fraction, cg):
        tensor = tuple(map(tuple, fraction * own))
        return MassProperties(mass_kg=fraction * mass_kg, cg_from_datum_body_m=tuple(cg), inertia_kgm2=tensor)

    made = replace(
        vehicle,
        reference=Reference(area_m2=area_m2, length_m=1.0),
        aero=drag_table(drag_coefficient),
        aeroshell=part(share, (1.0 - share) * apart),
        centerbody=part(1.0 - share, -share * apart),
    )
    np.testing.assert_allclose(made.inertia, inertia, rtol=1e-14, atol=1e-15 * np.trace(inertia))
    np.testing.assert_allclose(made.cg_m, 0.0, atol=1e-16)
    return made


def on_the_ground(vehicle, mass_kg, cg_from_joint_m, inertia_kgm2, stiffness=0.0, damping=0.0):
    """One body, the shell, on a joint of the ground: the body of 1e9 kg, which what hangs on it moves by 1e-6 m."""
    heavy = 1.0e9
    joint = vehicle.joint.model_copy(
        update={
            "station_m": 0.0,
            "bending_stiffness_nmprad": stiffness,
            "bending_damping_nmsprad": damping,
            "torsion_stiffness_nmprad": 0.0,
            "torsion_damping_nmsprad": 0.0,
        }
    )

    def part(mass, cg, inertia):
        tensor = tuple(map(tuple, np.asarray(inertia, dtype=float)))
        return MassProperties(mass_kg=mass, cg_from_datum_body_m=tuple(cg), inertia_kgm2=tensor)

    return replace(
        vehicle,
        joint=joint,
        centerbody=part(heavy, (0.0, 0.0, 0.0), heavy * np.eye(3)),
        aeroshell=part(mass_kg, cg_from_joint_m, inertia_kgm2),
    )
