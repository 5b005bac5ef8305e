"""From which stiffness does the fit begin?

A joint may be ten times softer or a thousand times stiffer than the vehicle file states, and Gauss-Newton steps from a
joint that diverges under the flight's loads, or from one far too soft, end with another vehicle. So a few spans about
the largest dynamic pressure are fitted from several stiffnesses, counted from the one at which the stated vehicle
diverges, with wide standard deviations; the fit begins with the stiffness that explains them best.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from flightmodel.checks import DivergenceError, FloatArray
from flightmodel.trajectory import resample
from postflight.reconciliation.forward_model import (
    DAMPING_LOG_SD,
    LOADED_SD,
    SLOW_JOINT,
    STIFFNESS_LOG_SD,
    AtmosphereParameters,
    Measurements,
    steps_for,
)
from postflight.reconciliation.gauss_newton import Parameters, Problem, descend
from postflight.reconstruction import Reconstruction
from synthetic_flight.linear import critical_stiffness_nmprad, slopes_at

# over the stiffness at which the stated vehicle diverges; from one to the next two steps reach
CANDIDATES = (1.2, 1.8, 3.5, 10.0, 40.0, 200.0)
STEPS, SD_FACTOR = 2, 30.0  # as the fit's own first step
SPANS = 24  # about 10 s: several periods of the vehicle's own oscillation under load
FAST_RATIO = 0.1  # of critical damping
EVERY_LOAD = 20  # samples of the pulse, of which there are thousands


def stiffness_guess(flight: Reconstruction, problem: Problem) -> tuple[Problem, Parameters]:
    """Start of a fit, nominal but for the stiffness that explains the loaded part of the flight best; its problem.

    Raises
    ------
    DivergenceError
        Where the spans cannot be flown with any of the candidates.
    """
    start, nominal = problem.start(), problem.vehicle_parameters.nominal
    measured = loaded_part(problem.measured)
    air = AtmosphereParameters(flight.telemetry.sounding, float(measured.altitude_m.min()))
    part = replace(problem, measured=measured, air=air, sd_factor=SD_FACTOR)
    lowest, best, critical = np.inf, None, critical_stiffness(flight)
    for factor in CANDIDATES:
        vehicle = start.vehicle.copy()
        vehicle[0] = np.log(factor * critical / nominal.joint.bending_stiffness_nmprad) / STIFFNESS_LOG_SD
        vehicle[1] = damping_guess(problem, vehicle)
        try:
            *_, end = descend([resolved(part, vehicle)] * STEPS, replace(part.start(), vehicle=vehicle))
        except DivergenceError as fault:
            failed = fault
            continue
        if end.residuals.cost < lowest:
            lowest, best = end.residuals.cost, end.end.vehicle[0]
    if best is None:
        raise failed
    vehicle = start.vehicle.copy()
    vehicle[0] = best
    vehicle[1] = damping_guess(problem, vehicle)
    return resolved(problem, vehicle), replace(start, vehicle=vehicle)


def resolved(problem: Problem, x: FloatArray) -> Problem:
    """Problem with integration steps for the joint of the vehicle's parameters (v,)."""
    steps = steps_for(problem.vehicle_parameters.vehicle(x))
    if steps == problem.measured.steps:
        return problem
    return replace(problem, measured=replace(problem.measured, steps=steps))


def damping_guess(problem: Problem, x: FloatArray) -> float:
    """Damping's parameter to start with: a fast joint's is so large that its oscillation decays within a span.

    A slightly damped oscillation of many periods a span would fit, badly, at many false frequencies.
    """
    vehicle = problem.vehicle_parameters.vehicle(x)
    if steps_for(vehicle) is SLOW_JOINT:
        return 0.0
    ratio = vehicle.joint.bending_damping_nmsprad / vehicle.critical_damping_nmsprad()
    return max(0.0, float(np.log(FAST_RATIO / ratio)) / DAMPING_LOG_SD)


def critical_stiffness(flight: Reconstruction) -> float:
    """Bending stiffness, N m/rad, below which the stated vehicle diverges at the flight's largest load."""
    pulse = flight.required_loads()
    stated = pulse.vehicle
    loads = pulse.dynamic_pressure_pa[::EVERY_LOAD].tolist()
    at = zip(loads, slopes_at(stated, pulse.mach[::EVERY_LOAD]), strict=True)
    return max(critical_stiffness_nmprad(stated, slopes, load) for load, slopes in at)


def loaded_part(measured: Measurements) -> Measurements:
    """Return the spans about the largest dynamic pressure."""
    peak = int(np.argmax(measured.dynamic_pressure_pa))
    first = max(min(peak - SPANS // 2, measured.spans - SPANS), 0)
    part = slice(first, min(first + SPANS, measured.spans))

    def of(values: FloatArray) -> FloatArray:
        return values[part]

    return replace(
        measured,
        start=resample(measured.start, measured.start.time_s[part.start : part.stop + 1]),
        dynamic_pressure_pa=of(measured.dynamic_pressure_pa),
        altitude_m=of(measured.altitude_m),
        time_s=of(measured.time_s),
        rate_radps=of(measured.rate_radps),
        specific_force_mps2=of(measured.specific_force_mps2),
        first_deflection_sd=LOADED_SD,
    )
