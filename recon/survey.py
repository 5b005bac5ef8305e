"""What do all trackers share, which no residual shows, and does anything independent contradict it?

Radars that stand on one survey err together: a latitude, a height datum or an azimuth mark that is off by ``e`` moves
the whole trajectory, and every residual stays as it is. Stated uncertainties of it are error states, each site's own
and those common to all (``sites``), and so in the covariance. What is left is said in a line (`rests_on`).

Independent evidence contradicts it: a place where the vehicle is known to have been, or a receiver and a barometer. At
a known place ``z`` with covariance ``R``, and the smoothed position ``p`` of covariance ``P_pp``,

    r = z - p,   S = P_pp + R,   chi2 = r^T S^-1 r

A common error ``e`` that the data cannot show would have moved the answer by ``P_pe / P_ee`` for each unit (Schmidt's
sensitivity), so that each single error is a hypothesis with one unknown, fitted by generalised least squares over all
places; those that leave an acceptable ``chi2`` are named. A receiver or barometer takes part in the filter: where the
trackers contradict each other, the flight is reconstructed with wide priors of the common errors, and these are named
if that makes all data consistent.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flightmodel import earth, rotations
from flightmodel.checks import Check, FloatArray, Issue
from flightmodel.statistics import chi_square_quantile
from flightmodel.telemetry import KnownPlace, Telemetry
from flightmodel.trajectory import nearest_index
from recon.kalman import ForwardPass, smoothed_covariance
from recon.measurements import SITES
from recon.problem import Problem
from recon.settings import Settings
from recon.state import KINEMATIC, States

_UNITS = {"m": ("m", 1.0), "rad": ("deg", float(np.rad2deg(1.0)))}
# single errors first; a shift to the north-west is two of them
_HYPOTHESES = (("survey north",), ("survey east",), ("height datum",), ("north",), ("survey north", "survey east"))
_OF_A_STATE = (
    "check the state's axes, angles and speed, its time (t_sd_s), the accelerometer's scale and axis, rows that are "
    "missing with their time, and the place and its time"
)
# of common errors where they are looked for: a mistyped minute of arc; the geoid's extremes; a declination (grid north)
WIDE_SD = {
    f"{SITES} survey north": 2000.0,
    f"{SITES} survey east": 2000.0,
    f"{SITES} height datum": 110.0,
    f"{SITES} north": float(np.deg2rad(3.0)),
}


@dataclass(frozen=True)
class Miss:
    """Known minus smoothed position, north, east, down, and its response to errors common to all sites."""

    place: KnownPlace
    residual_m: FloatArray  # (k,) 2 without a height, else 3
    covariance: FloatArray  # (k, k)
    response: dict[str, FloatArray]  # by error of the sites: (k,) for each unit

    @property
    def chi2(self) -> float:
        """Chi-square of the difference by itself."""
        return float(self.residual_m @ np.linalg.solve(self.covariance, self.residual_m))


def missed_places(
    problem: Problem,
    run: ForwardPass,
    states: States,
    arm_body_m: FloatArray,
    places: tuple[KnownPlace, ...],
) -> list[Miss]:
    """Differences of a trajectory from known positions.

    Parameters
    ----------
    problem, run : Problem, ForwardPass
    states : States
        Smoothed, at all nodes.
    arm_body_m : (3,) float
        Accelerometer from the datum, which is what was at the places.
    places : tuple of KnownPlace
        A time outside the trajectory is compared with its nearer end, less well by the way flown in between.
    """
    if not places:
        return []
    planet = problem.motion.planet
    nodes = nearest_index(problem.time_s, np.array([place.time_s for place in places]))
    kept = np.zeros(len(problem.time_s), dtype=bool)
    kept[nodes] = True
    _, covariances = smoothed_covariance(problem, run, kept)
    columns = {name: problem.model.column(SITES, name) for single in _HYPOTHESES[:4] for name in single}
    out = []
    for place, node in zip(places, nodes.tolist(), strict=True):
        covariance = covariances[int(kept[:node].sum())]
        state = states[node]
        datum = state.position_ecef_m - rotations.dcm_from_q(state.q_ecef_body) @ arm_body_m
        ned = earth.dcm_ned_ecef(place.latitude_rad, place.longitude_rad)[: 2 if np.isnan(place.height_m) else 3]
        height = float(earth.geodetic_from_ecef(datum, planet)[2]) if np.isnan(place.height_m) else place.height_m
        known = earth.ecef_from_geodetic(place.latitude_rad, place.longitude_rad, height, planet)
        flown = np.linalg.norm(state.velocity_ecef_mps) * (place.time_s - problem.time_s[node])
        variance = np.array([place.sd_m**2, place.sd_m**2, place.height_sd_m**2])[: len(ned)] + flown**2
        response = {}
        for name, column in columns.items():
            k = KINEMATIC + column
            if column >= 0:
                response[name] = ned @ covariance[:3, k] / covariance[k, k]
        spread = ned @ covariance[:3, :3] @ ned.T + np.diag(variance)
        out.append(Miss(place, ned @ (known - datum), spread, response))
    return out


def place_checks(misses: list[Miss], confidence: float, tracked: bool = True) -> list[Check]:
    """One check for each place that is known; one that fails names the error of all sites that would explain it.

    Without a tracker (``tracked``) it is the stated state, or what was integrated from it.
    """
    causes, component = (_causes(misses, confidence) if tracked else (_OF_A_STATE, "")) if misses else ("", "")
    out = []
    for miss in misses:
        away = float(np.linalg.norm(miss.residual_m))
        symptom = f"the trajectory passes {away:.3g} m from it"
        most = chi_square_quantile(confidence, len(miss.residual_m))
        good = f"{symptom}, within the uncertainty of both"
        check = Check.of(
            "place", f"place {miss.place.name}", miss.chi2, 0.0, most, good, symptom, advice=causes,
            source=SITES if tracked else "start",
            component=component,
        )  # fmt: skip
        out.append(check)
    return out


def _causes(misses: list[Miss], confidence: float) -> tuple[str, str]:
    """What would explain all misses, in words, and the likeliest error; the error is empty where no single one does."""

    dof = sum(len(miss.residual_m) for miss in misses)
    found: list[tuple[float, str, str]] = []
    for names in _HYPOTHESES:
        if any(name not in misses[0].response for name in names) or (found and len(names) > 1) or dof <= len(names):
            continue
        information, projected = np.zeros((len(names),) * 2), np.zeros(len(names))
        for miss in misses:
            a = np.column_stack([miss.response[name] for name in names])
            weighted = np.linalg.solve(miss.covariance, a)
            information += weighted.T @ a
            projected += weighted.T @ miss.residual_m
        size = np.linalg.lstsq(information, projected, rcond=None)[0]
        left = sum(miss.chi2 for miss in misses) - float(projected @ size)
        if left <= chi_square_quantile(confidence, dof - len(names)):
            words = " and ".join(_amount(name, float(x)) for name, x in zip(names, size, strict=True))
            found.append((left, words, " and ".join(names)))
    if not found:
        return "no single error of the radar sites explains it: check the place, its time, the sites and time tags", ""
    found.sort()
    words = "; or ".join(words for _, words, _ in found)
    return f"stated minus true, all radar sites together: {words}", found[0][2]


def _amount(name: str, size: float) -> str:
    unit, factor = _UNITS["rad" if name == "north" else "m"]
    return f"{name} {factor * size:+.3g} {unit}"


def shared_error_check(table: FloatArray, names: list[str], consistent: bool) -> Check | None:
    """Check that fails where common errors of the sites, with wide priors, make all data consistent.

    Parameters
    ----------
    table : (k, 2) float
        Estimate and standard deviation of each of the common errors, with wide priors.
    names : list of str
        Of these errors, with their owner.
    consistent : bool
        Whether all checks pass with them.
    """
    away = np.abs(table[:, 0]) / table[:, 1]
    worst = int(np.argmax(away))
    if not consistent or away[worst] < 3.0:
        return None
    component = names[worst].removeprefix(f"{SITES} ")
    words = _amount(component, float(table[worst, 0]))
    return Check.of(
        "sites", "radar sites", float(away[worst]), 0.0, 3.0, "",
        f"one error common to all radar sites would make all data consistent: stated minus true, {words}",
        advice="check survey, height datum and azimuth mark, against the receiver or barometer that differs",
        source=SITES, component=component,
    )  # fmt: skip


def unchecked_state(telemetry: Telemetry) -> list[Issue]:
    """Finding where a flight without a tracker states no place: then nothing checks where it flew."""
    state = telemetry.start.state
    if state is None or telemetry.radars or telemetry.gnss or telemetry.places:
        return []
    words = "no tracker and no [[places]]: no data check this state, its time and axes; state where the vehicle landed"
    return [Issue(words, "state-unchecked", "start", state.time_s, state.time_s)]


def rests_on(telemetry: Telemetry, settings: Settings) -> tuple[str, ...]:
    """One line each on the source of position, height and azimuth and its uncertainty, if no residual shows it."""
    radars = [r.spec for name, r in telemetry.radars.items() if name not in settings.without]
    receivers = [name for name, r in telemetry.gnss.items() if name not in settings.without and r.has_positions]
    checked = f"; checked by {', '.join(place.name for place in telemetry.places)}" if telemetry.places else ""
    if not radars and not receivers and telemetry.start.state is not None:
        return (f"position, height and azimuth rest on the state at {telemetry.start.state.time_s:g} s{checked}",)
    if not radars:
        return (f"position, height and azimuth rest on the receiver {', '.join(receivers)}{checked}",)
    also = f" and on the receiver {', '.join(receivers)}" if receivers else ""
    who = f"{', '.join(site.name for site in radars)}{also}"
    common = telemetry.sites
    rows = (
        ("position", "survey", [s.survey_sd_m for s in radars], common.survey_sd_m, "m"),
        ("height", "height datum", [s.height_sd_m for s in radars], common.height_datum_sd_m, "m"),
        ("azimuth", "azimuth zero", [s.north_sd_rad for s in radars], common.north_sd_rad, "rad"),
    )
    out = []
    for what, of, own, shared, unit in rows:
        shown, factor = _UNITS[unit]
        sizes = [f"{factor * max(own):.3g} {shown} each"] * any(own)
        sizes += [f"{factor * shared:.3g} {shown} common"] * (shared > 0.0)
        to = f"to {' and '.join(sizes)}" if sizes else "(uncertainty not stated)"
        out.append(f"{what} rests on the {of} of {who} {to}{checked}")
    return tuple(out)
