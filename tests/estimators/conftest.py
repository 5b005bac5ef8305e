import numpy as np

from estimators.loads import FlightLoads
from estimators.trim import trim_model
from flightmodel import rotations
from flightmodel.deflection import lv_clock, rotation_vector_body_shell
from flightmodel.vehicle import vehicle_from_toml, vehicle_path

VEHICLE = vehicle_from_toml(vehicle_path("irve2_reference"))
AERO = VEHICLE.aero


def pulse_of(rng, n, theta_yz=None, vehicle=VEHICLE):
    """Ideal data of a deflected shell in trim: force exactly by rotation, moments exactly in balance; any plane.

    A deflection history that is given is flown through a smooth pulse, by ``vehicle``; the analyst has `VEHICLE`.
    """
    model, smooth = trim_model(vehicle), theta_yz is not None
    mach = np.linspace(4.5, 2.6, n) if smooth else rng.uniform(2.6, 4.5, n)
    theta_yz = theta_yz if smooth else np.deg2rad(rng.uniform(-4.0, 4.0, (n, 2)))
    theta, plane = np.linalg.norm(theta_yz, axis=1), lv_clock(theta_yz)
    # the shell trims where eq. [6] says, found here by bisection rather than by the estimator's look-up
    z = model.offset_yz_m + model.xbar_m * theta_yz
    low, high = np.zeros(n), np.full(n, 0.5)
    for _ in range(60):
        middle = 0.5 * (low + high)
        c = vehicle.aero.at(mach, middle)
        short = -(c[:, 2] * 3.0 + c[:, 1] * model.x_cg_m) / c[:, 0] < np.linalg.norm(z, axis=1)
        low, high = np.where(short, middle, low), np.where(short, high, middle)
    alpha = low[:, None] * z / np.linalg.norm(z, axis=1, keepdims=True)
    c = vehicle.aero.at(mach, low)
    axial = 50.0 + 35.0 * np.sin(np.linspace(0.3, 2.8, n)) if smooth else rng.uniform(30.0, 85.0, n)
    in_shell = np.column_stack([-axial, -(axial * c[:, 1] / c[:, 0])[:, None] * alpha / low[:, None]])
    force = rotations.rotate(rotations.exp(rotation_vector_body_shell(theta, plane)), in_shell)
    root = np.array([[0.05, 0, 0], [0.01, 0.09, 0], [0.0, -0.04, 0.12]])
    flow_root = np.deg2rad(np.array([[0.25, 0.0], [0.1, 0.2]]))
    speed = mach * 320.0
    loads = FlightLoads(
        time_s=430.0 + 0.05 * np.arange(n),
        specific_force_body_mps2=force,
        force_noise_sd_mps2=0.01,
        force_root_mps2=np.tile(np.hstack([root, np.zeros((3, 6))]), (n, 1, 1)),
        flow_root_rad=np.zeros((n, 2, 9)),
        rate_body_radps=np.zeros((n, 3)),
        angular_acceleration_body_radps2=np.zeros((n, 3)),
        angular_acceleration_sd_radps2=0.0,
        flow_yz_rad=alpha + theta_yz,
        flow_cov=np.tile(flow_root @ flow_root.T, (n, 1, 1)),
        wind_flow_sd_rad=np.full(n, np.deg2rad(0.15)),
        altitude_m=60000.0 - 800.0 * 0.05 * np.arange(n),
        mach=mach,
        dynamic_pressure_pa=axial * vehicle.mass_kg / (c[:, 0] * VEHICLE.reference.area_m2),
        dynamic_pressure_sd_pa=np.full(n, 20.0),
        airspeed_mps=speed,
        vehicle=VEHICLE,
    )
    return loads, theta_yz
