import numpy as np

from estimators.loads import FlightLoads
from flightmodel import rotations
from flightmodel.deflection import lv_clock, rotation_vector_body_shell
from flightmodel.vehicle import vehicle_from_toml, vehicle_path

VEHICLE = vehicle_from_toml(vehicle_path("irve2_reference"))
AERO = VEHICLE.aero


def shell_to_body(theta_yz):
    """Matrices (n, 3, 3) from shell to body axes of deflections (n, 2)."""
    turn = rotation_vector_body_shell(np.linalg.norm(theta_yz, axis=1), lv_clock(theta_yz))
    return rotations.dcm_from_q(rotations.exp(turn))


def trimmed_flow(vehicle, mach, theta_yz):
    """Flow angle in shell axes (n, 2) at which the moment about the displaced c.g. vanishes: arms and forces in space.

    Nothing is small; the two equations are solved by Newton's method from differences.
    """
    turn = shell_to_body(theta_yz)
    shell, joint, length = vehicle.aeroshell, vehicle.joint_m, vehicle.reference.length_m
    moved = joint + turn @ (shell.cg_m - joint)
    cg = (shell.mass_kg * moved + vehicle.centerbody.mass_kg * vehicle.centerbody.cg_m) / vehicle.mass_kg
    nose = joint + turn @ -joint

    def moment(flow):
        size = np.linalg.norm(flow, axis=1, keepdims=True)
        side = np.column_stack([np.zeros(len(flow)), flow / np.where(size > 0.0, size, 1.0)])
        c = vehicle.aero.at(mach, size[:, 0])
        force = -c[:, :1] * [1.0, 0.0, 0.0] - c[:, 1:2] * side
        about_nose = length * c[:, 2:3] * np.cross(side, [1.0, 0.0, 0.0])
        force, about_nose = (np.einsum("nij,nj->ni", turn, v) for v in (force, about_nose))
        return (about_nose + np.cross(nose - cg, force))[:, 1:], force

    flow = np.full((len(mach), 2), 0.02)
    for _ in range(40):
        left, _ = moment(flow)
        slope = np.stack([(moment(flow + 1e-6 * e)[0] - left) / 1e-6 for e in np.eye(2)], axis=-1)
        flow = flow - 0.8 * np.linalg.solve(slope, left[:, :, None])[:, :, 0]
    assert np.abs(moment(flow)[0]).max() < 1e-9
    return flow, moment(flow)[1], turn


def pulse_of(rng, n, theta_yz=None, vehicle=VEHICLE):
    """Ideal data of a deflected shell in trim: force exactly by rotation, moments exactly in balance; any plane.

    A deflection history that is given is flown through a smooth pulse, by ``vehicle``; the analyst has `VEHICLE`.
    """
    smooth = theta_yz is not None
    mach = np.linspace(4.5, 2.6, n) if smooth else rng.uniform(2.6, 4.5, n)
    theta_yz = theta_yz if smooth else np.deg2rad(rng.uniform(-4.0, 4.0, (n, 2)))
    flow, force, turn = trimmed_flow(vehicle, mach, theta_yz)
    alpha = np.linalg.norm(flow, axis=1)
    axial = 50.0 + 35.0 * np.sin(np.linspace(0.3, 2.8, n)) if smooth else rng.uniform(30.0, 85.0, n)
    c = vehicle.aero.at(mach, alpha)
    velocity = np.column_stack([np.cos(alpha), flow * np.sinc(alpha / np.pi)[:, None]])
    velocity = np.einsum("nij,nj->ni", turn, velocity)
    lateral = np.linalg.norm(velocity[:, 1:], axis=1)
    body_flow = velocity[:, 1:] * (np.arctan2(lateral, velocity[:, 0]) / lateral)[:, None]
    root = np.array([[0.05, 0, 0], [0.01, 0.09, 0], [0.0, -0.04, 0.12]])
    flow_root = np.deg2rad(np.array([[0.25, 0.0], [0.1, 0.2]]))
    speed = mach * 320.0
    loads = FlightLoads(
        time_s=430.0 + 0.05 * np.arange(n),
        specific_force_body_mps2=force * (axial / c[:, 0])[:, None],
        force_noise_sd_mps2=0.01,
        force_root_mps2=np.tile(np.hstack([root, np.zeros((3, 6))]), (n, 1, 1)),
        flow_root_rad=np.zeros((n, 2, 9)),
        rate_root_radps=np.zeros((n, 3, 9)),
        rate_body_radps=np.zeros((n, 3)),
        angular_acceleration_body_radps2=np.zeros((n, 3)),
        angular_acceleration_sd_radps2=0.0,
        flow_yz_rad=body_flow,
        flow_cov=np.tile(flow_root @ flow_root.T, (n, 1, 1)),
        wind_flow_sd_rad=np.full(n, np.deg2rad(0.15)),
        altitude_m=60000.0 - 800.0 * 0.05 * np.arange(n),
        mach=mach,
        dynamic_pressure_pa=axial * vehicle.mass_kg / (c[:, 0] * VEHICLE.reference.area_m2),
        dynamic_pressure_sd_pa=np.full(n, 20.0),
        airspeed_mps=speed,
        vehicle=VEHICLE,
        point_from_datum_m=VEHICLE.cg_m,
    )
    return loads, theta_yz
