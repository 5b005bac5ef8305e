import numpy as np

from estimators.pulse import PulseData
from estimators.trim import trim_model
from flightmodel import rotations
from flightmodel.deflection import lv_clock, rotation_vector_body_shell
from flightmodel.vehicle import vehicle_from_toml, vehicle_path

VEHICLE = vehicle_from_toml(vehicle_path("irve2_reference"))
AERO = VEHICLE.aero


def pulse_of(rng, n):
    """Ideal data of a bent shell in trim: force exactly by rotation, moments exactly in balance; any plane."""
    model = trim_model(VEHICLE)
    mach = rng.uniform(2.6, 4.5, n)
    theta_yz = np.deg2rad(rng.uniform(-4.0, 4.0, (n, 2)))
    theta, plane = np.linalg.norm(theta_yz, axis=1), lv_clock(theta_yz)
    # the shell trims where eq. [6] says, found here by bisection rather than by the estimator's look-up
    z = model.offset_yz_m + model.xbar_m * theta_yz
    low, high = np.zeros(n), np.full(n, 0.5)
    for _ in range(60):
        middle = 0.5 * (low + high)
        c = AERO.at(mach, middle)
        short = -(c[:, 2] * 3.0 + c[:, 1] * model.x_cg_m) / c[:, 0] < np.linalg.norm(z, axis=1)
        low, high = np.where(short, middle, low), np.where(short, high, middle)
    alpha = low[:, None] * z / np.linalg.norm(z, axis=1, keepdims=True)
    c = AERO.at(mach, low)
    axial = rng.uniform(30.0, 85.0, n)
    in_shell = np.column_stack([-axial, -(axial * c[:, 1] / c[:, 0])[:, None] * alpha / low[:, None]])
    force = rotations.rotate(rotations.exp(rotation_vector_body_shell(theta, plane)), in_shell)
    root = np.array([[0.05, 0, 0], [0.01, 0.09, 0], [0.0, -0.04, 0.12]])
    flow_root = np.deg2rad(np.array([[0.25, 0.0], [0.1, 0.2]]))
    speed = mach * 320.0
    pulse = PulseData(
        time_s=430.0 + 0.05 * np.arange(n),
        specific_force_body_mps2=force,
        specific_force_cov=np.tile(root @ root.T, (n, 1, 1)),
        rate_body_radps=np.zeros((n, 3)),
        angular_acceleration_body_radps2=np.zeros((n, 3)),
        angular_acceleration_sd_radps2=0.0,
        flow_yz_rad=alpha + theta_yz,
        flow_cov=np.tile(flow_root @ flow_root.T, (n, 1, 1)),
        mach=mach,
        dynamic_pressure_pa=axial * VEHICLE.mass_kg / (c[:, 0] * VEHICLE.reference.area_m2),
        dynamic_pressure_sd_pa=np.full(n, 20.0),
        airspeed_mps=speed,
        vehicle=VEHICLE,
    )
    return pulse, theta_yz
