"""The deflection of the aeroshell by every method that a flight has data for, and fused."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from concurrent.futures import Future
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from estimators.loads import FlightLoads
from flightmodel.airdata import pressure_pulse
from flightmodel.checks import Check, FloatArray, GateError, Issue, Progress, Result, check_type, nearest_name, part_of
from flightmodel.deflection import QUANTILE_COLUMNS, DeflectionHistory, cycle_about, mean_over
from flightmodel.events import find_peak
from flightmodel.statistics import decimals, pair
from flightmodel.tabular import Tabular
from postflight.flight import READ, RECONSTRUCT, Flight
from postflight.methods import Inputs
from postflight.reconstruction import Reconstruction
from postflight.streams import on_one_thread
from recon.consistency import doubt

if TYPE_CHECKING:  # estimators are a quarter of a second to import, for commands that only have or read a trajectory
    from estimators.agreement import Agreement
    from estimators.fusing import CameraTimeBias, Fused
    from postflight.filming import CameraAnswer
    from postflight.flown_coefficients import AeroIncrements

LOADS = f"{RECONSTRUCT}, pf.read_loads(table, vehicle) or {READ} of a folder with [loads]"
FILM = "pf.read_film(pictures, times, vehicle)"
METHODS = ("camera", "misalignment", "trim", "fused")
_AS_RUN = ("misalignment", "trim", "camera", "fused")
NO_COMMON_ANSWER = ("inputs-far-off", "not-converged", "camera-time-bias", "not-observable")
# assumed plane, and the deflection that the paper read in it from the frame at 440 s (Table 2.1)
PAPER_TABLE_2_1_DEG = {153.0: 4.2, 183.0: 5.8, 200.0: 6.2}


@dataclass(frozen=True, repr=False)
class Deflections(Tabular):
    """Deflection histories by method, reasons of methods without one, and the posterior behind the fused one.

    ``answer["camera"]`` is the history of a method, and ``for method in answer`` goes through those that answered.

    Parameters
    ----------
    histories : dict of DeflectionHistory
        By method: ``"camera"``, ``"misalignment"``, ``"trim"``, ``"fused"``.
    refused : dict of Issue
        Why a method gave none.
    fused : Fused or None
        Posterior of the deflection and of all inputs, and whether the methods agree.
    camera : CameraAnswer or None
        What stands behind the camera's, of one camera or several.
    smooth_camera : DeflectionHistory or None
        The camera's answer at any time; None in an assumed plane, or of too few frames.
    bet : Reconstruction or None
        What they were made from, or the run that they were read back from, which has the same parts; None where the
        camera answered without a trajectory, or ``loads`` did.
    loads : FlightLoads or None
        What they were made from instead, of another team's trajectory (`read_loads`).
    increments : AeroIncrements or None
        Of the aerodynamic coefficients, where they were asked for (`with_increments`); ``no_increments`` says why not.
    no_increments : Issue or None
    """

    histories: dict[str, DeflectionHistory] = field(default_factory=dict)
    refused: dict[str, Issue] = field(default_factory=dict)
    fused: Fused | None = None
    camera: CameraAnswer | None = field(default=None, compare=False)
    smooth_camera: DeflectionHistory | None = field(default=None, compare=False)
    bet: Reconstruction | None = None
    loads: FlightLoads | None = field(default=None, compare=False)
    increments: AeroIncrements | None = field(default=None, compare=False)
    no_increments: Issue | None = None

    def __getitem__(self, method: str) -> DeflectionHistory:
        """History of a method; `KeyError` with the reason, or with the methods that answered."""
        if method in self.histories:
            return self.histories[method]
        answered = f"there are answers of: {', '.join(self.histories) or 'no method'}"
        known = self.refused.get(method, f"not asked for{nearest_name(method, METHODS)}")
        raise KeyError(f"{method}: {known}; {answered}")

    def __iter__(self) -> Iterator[str]:
        """Methods that answered."""
        return iter(self.histories)

    @property
    def history(self) -> DeflectionHistory:
        """The fused history; `GateError` with the reason where there is none."""
        if "fused" not in self.histories:
            reason = self.refused.get("fused", Issue("the fused deflection was not asked for", "input-missing"))
            raise GateError([reason])
        return self.histories["fused"]

    @property
    def continuous(self) -> dict[str, DeflectionHistory]:
        """Each method's answer at any time; for the camera, the smoothed history between its frames."""
        return self.histories | ({} if self.smooth_camera is None else {"camera": self.smooth_camera})

    @property
    def knows_peak(self) -> bool:
        """Whether a trajectory, of this program or another, gives the time of peak dynamic pressure."""
        return self.bet is not None or self.loads is not None

    @property
    def reference_s(self) -> float:
        """Time at which methods are compared, s: peak dynamic pressure, else the first history's largest deflection."""
        if self.bet is not None:
            return self.bet.peak_s
        if self.loads is not None:
            return find_peak(self.loads.time_s, self.loads.dynamic_pressure_pa)[0]
        return next((float(h.time_s[h.largest()]) for h in self.histories.values()), float("nan"))

    @property
    def pulse_s(self) -> tuple[float, float]:
        """Begin and end of the pressure pulse, searched for the largest deflection; all times without a trajectory.

        Where there is hardly a load the largest answer is that of the largest noise.
        """
        if self.loads is not None:
            inside = self.loads.time_s[pressure_pulse(self.loads.dynamic_pressure_pa)]
            return float(inside[0]), float(inside[-1])
        return (-np.inf, np.inf) if self.bet is None else self.bet.pulse_s

    @property
    def best(self) -> str | None:
        """The fused answer, else the method of the smallest sd at `reference_s`; None where none answers there."""
        at = {method: history.angle_at(self.reference_s)[1] for method, history in self.continuous.items()}
        if np.isfinite(at.get("fused", np.nan)):
            return "fused"
        return min((m for m, sd in at.items() if np.isfinite(sd)), key=lambda m: at[m], default=None)

    @property
    def cycle_s(self) -> tuple[float, float] | None:
        """The best answer's cycle, minimum to minimum, in which `reference_s` lies; None where none is clear."""
        return None if self.best is None else cycle_about(self.continuous[self.best], self.reference_s)

    @property
    def consistency_checks(self) -> tuple[Check, ...]:
        """Whether cameras agree, methods do, they have a common answer, and coefficients are as stated."""
        of_cameras = () if self.camera is None else self.camera.consistency_checks
        if self.fused is not None:
            of_table = () if self.increments is None else self.increments.consistency_checks
            of_cameras = tuple(borne_out(check, self.fused.agreement) for check in of_cameras)
            return (*of_cameras, *self.fused.consistency_checks, *of_table)
        reason = self.refused.get("fused")
        if reason is None or reason.code not in NO_COMMON_ANSWER:
            return of_cameras
        name, words = "deflection methods have a common answer", str(reason)
        return (*of_cameras, Check("deflection-methods", name, 0.0, 1.0, 1.0, False, words))

    @property
    def doubt(self) -> str:
        """Consequences of failed checks of trajectory, air and deflection for the answers; empty if all pass."""
        of_bet = () if self.bet is None else self.bet.consistency_checks
        checks = (*of_bet, *self.consistency_checks)
        return doubt([check.name for check in checks if not check.passed], len(checks))

    def to_frame(self) -> pd.DataFrame:
        """One row a method, at `reference_s`.

        Returns
        -------
        DataFrame
            ``method, t_s, theta_deg, theta_sd_deg, plane_lv_deg, largest_deg, largest_t_s, reason`` (the largest of the
            pressure pulse), the quantiles of `DeflectionHistory.to_frame`, and ``mean_deg, mean_sd_deg`` over the cycle
            about ``t_s`` (`cycle_s`).
        """
        rows: list[tuple[object, ...]] = []
        at_s, cycle = self.reference_s, self.cycle_s
        for method, history in self.histories.items():
            any_time = self.continuous[method]
            _, theta, sd, plane, _ = any_time.at(at_s)
            k = history.largest(self.pulse_s)
            largest = np.rad2deg(history.theta_rad[k]), history.time_s[k]
            reason = "" if np.isfinite(theta) else str(no_answer_at(any_time, at_s))
            mean = np.rad2deg(mean_over(any_time, cycle)) if cycle is not None else (np.nan, np.nan)
            rows.append(
                (method, at_s, theta, sd, plane, *largest, reason, *np.rad2deg(quantiles_at(any_time, at_s)), *mean)
            )
        nothing = [np.nan] * (len(QUANTILE_COLUMNS) + 2)
        rows += [(method, at_s, *[np.nan] * 5, str(reason), *nothing) for method, reason in self.refused.items()]
        names = ("method", "t_s", "theta_deg", "theta_sd_deg", "plane_lv_deg", "largest_deg", "largest_t_s", "reason")
        return pd.DataFrame(rows, columns=[*names, *QUANTILE_COLUMNS, "mean_deg", "mean_sd_deg"])

    def _about(self) -> str:
        shown = []
        for method, history in self.continuous.items():
            theta, sd = np.rad2deg(history.angle_at(self.reference_s))
            known = (
                f"{theta:.{decimals(sd)}f} +/- {sd:.{decimals(sd)}f} deg"
                if np.isfinite(theta)
                else no_answer_at(history, self.reference_s)
            )
            shown.append(f"{method} {known}")
        answers = f"at {self.reference_s:.2f} s: {', '.join(shown) or 'no answer'}"
        return f"{self.doubt}; {answers}" if self.doubt else answers


def said(row: Mapping[str, Any], at: str = "at peak q") -> dict[str, str]:
    """Say a method's answer, deg: at peak q, cycle mean (where there is a clear cycle) and largest, by these names.

    Every text, table and picture takes the numbers from here, each rounded to its standard deviation. ``row`` is one of
    the methods in ``summary.json`` that has an answer; ``at`` names its moment where that is not the peak.
    """
    out = {at: pair(row["deflection_deg"], row["sd_deg"])}
    if row.get("mean_deg") is not None:
        out["cycle mean"] = pair(row["mean_deg"], row["mean_sd_deg"])
    return out | {"largest": f"{row['largest_deg']:.{decimals(row['sd_deg'])}f}"}


def headline(row: Mapping[str, Any], unit: str = "°", at: str = "at peak q") -> str:
    """Deflection by one method in one line."""
    return f"Deflection {', '.join(f'{name} {value}{unit}' for name, value in said(row, at).items())}"


def borne_out(check: Check, agreement: Agreement) -> Check:
    """Check of a camera; missing features are not flagged if the inertial methods agree with the camera."""
    compared = [pair for pair in agreement.pairs if "camera" in pair.methods]
    if check.passed or check.code != "camera-features" or not compared or agreement.hypotheses:
        return check
    words = f"{check.remark} (the inertial methods agree with the camera)"
    return replace(check, high=check.value, passed=True, remark=words)


def no_answer_at(history: DeflectionHistory, at_s: float) -> Issue:
    """Reason why a history has no answer at a time: outside its span, or in a gap."""
    known = history.time_s[np.isfinite(history.theta_rad)]
    first, last = float(known[0]), float(known[-1])
    where = "a gap" if first < at_s < last else "the data begin" if at_s <= first else "the data end"
    words = f"no answer at {at_s:.2f} s: {where}; answers span {first:.2f} to {last:.2f} s"
    return Issue(words, "no-answer")


def quantiles_at(history: DeflectionHistory, at_s: float) -> FloatArray:
    """Quantiles (5,) of the angle at a time, rad, scaled between answers to the sd of `angle_at`; NaN without one."""
    quantiles, (theta, sd) = history.theta_quantiles_rad, history.angle_at(at_s)
    known = np.isfinite(quantiles).all(axis=1)
    if not np.isfinite(theta) or not known.any():
        return np.full(len(QUANTILE_COLUMNS), np.nan)
    t = history.time_s[known]
    between = np.array([np.interp(at_s, t, c) for c in quantiles[known].T])
    middle, own = between[len(between) // 2], float(np.interp(at_s, t, history.theta_sd_rad[known]))
    return np.asarray(np.maximum(middle + (between - middle) * (sd / own if own > 0.0 else 1.0), 0.0))


@on_one_thread
def estimate_camera(flown: Flight | Reconstruction, progress: Progress | None = None) -> DeflectionHistory:
    """Deflection from the onboard video.

    Parameters
    ----------
    flown : Flight or Reconstruction
        With a reconstruction the deflection in the benchmark frame is found from the moment in the joint; with a
        flight, or a film alone (`read_film`), the benchmark frame is taken as undeflected.
    progress : callable, optional

    Returns
    -------
    DeflectionHistory
        In the flight's assumed plane (``camera_plane_lv_rad``), or with the plane estimated in every frame.

    Raises
    ------
    GateError
        Where there is no video or it cannot be used.
    """
    from postflight.filming import camera_answer

    check_type("estimate_camera", flown, (Flight, Reconstruction), f"{READ}, {FILM} or {RECONSTRUCT}")
    if isinstance(flown, Flight):
        return camera_answer(flown, progress=progress).plain
    return camera_answer(flown, progress=progress).history


@on_one_thread
def estimate_misalignment(flown: Reconstruction | FlightLoads | Flight) -> DeflectionHistory:
    """Deflection that reconciles the accelerometers with the trajectory, seed paper eqs. [1] to [4].

    Parameters
    ----------
    flown : Reconstruction, FlightLoads or Flight
        From `reconstruct`, or from `read_loads` of another team's trajectory, or a flight with ``[loads]``.

    Raises
    ------
    GateError
        Where there are no inertial sensors or no vehicle.
    """
    from estimators import misalignment

    return misalignment.estimate_misalignment(_loads_of("estimate_misalignment", flown))


@on_one_thread
def estimate_trim(flown: Reconstruction | FlightLoads | Flight) -> DeflectionHistory:
    """Deflection whose c.g. offset trims the vehicle at the measured angle of attack, seed paper eqs. [5] and [6].

    Parameters
    ----------
    flown : Reconstruction, FlightLoads or Flight
        From `reconstruct`, or from `read_loads` of another team's trajectory, or a flight with ``[loads]``.

    Raises
    ------
    GateError
        Where there are no inertial sensors or no vehicle.
    """
    from estimators import trim

    return trim.estimate_trim(_loads_of("estimate_trim", flown))


@on_one_thread
def fuse(flown: Reconstruction | FlightLoads | Flight, progress: Progress | None = None) -> Deflections:
    """Deflection by every method that the flight has data for, and their common posterior.

    Parameters
    ----------
    flown : Reconstruction, FlightLoads or Flight
        From `reconstruct`, or from `read_loads` of another team's trajectory, or a flight with ``[loads]``.
    progress : callable, optional

    Returns
    -------
    Deflections
        ``.history`` is the fused one; a method without an answer is in ``.refused`` with its reason.
    """
    if not (isinstance(flown, Flight) and flown.loads is not None):
        check_type("fuse", flown, (Reconstruction, FlightLoads), LOADS)
    has_film = not isinstance(flown, FlightLoads) and flown.telemetry.frames is not None
    return estimate(flown, tuple(m for m in METHODS if m != "camera" or has_film), progress)


def _loads_of(name: str, flown: Reconstruction | FlightLoads | Flight | None) -> FlightLoads:
    """Loads from the argument of a public function: given directly, or those of its reconstruction or flight."""
    if isinstance(flown, FlightLoads):
        return flown
    if isinstance(flown, Flight) and flown.loads is not None:
        return flown.loads
    check_type(name, flown, (Reconstruction, FlightLoads), LOADS)
    assert isinstance(flown, Reconstruction)
    return flown.required_loads()


def estimate(
    flown: Flight | Reconstruction | FlightLoads,
    methods: tuple[str, ...],
    progress: Progress | None = None,
    camera: Result[CameraAnswer] | None = None,
    time_bias: Result[CameraTimeBias | None] | None = None,
) -> Deflections:
    """Run the methods asked for; one that cannot answer says why, and does not stop the others.

    A `Flight` without a trajectory has an answer of the camera alone, loads, its own too, have those of the other
    methods. The result of ``camera`` is the camera's answer, where it is worked out elsewhere meanwhile, and that of
    ``time_bias`` the test of the camera's time bias.
    """
    report = progress or (lambda _fraction, _what: None)
    bet = flown if isinstance(flown, Reconstruction) else None
    flight = flown if isinstance(flown, Flight) else None if bet is None else bet.flight
    histories: dict[str, DeflectionHistory] = {}
    refused: dict[str, Issue] = {}
    fused, filmed = None, None
    loads = flown if isinstance(flown, FlightLoads) else flown.loads if isinstance(flown, Flight) else None
    missing = Inputs.of(flown if isinstance(flown, FlightLoads) else flown.telemetry).missing()
    for k, method in enumerate(sorted(methods, key=_AS_RUN.index)):
        report(k / len(methods), f"deflection from {method}")
        try:
            if method in missing:
                raise GateError([missing[method]])
            if method == "camera":
                assert not isinstance(flown, FlightLoads)  # which are never filmed
                from postflight.filming import camera_answer, keep_oriented

                shown = part_of(report, k / len(methods), (k + 1) / len(methods))
                filmed = camera_answer(flown, progress=shown) if camera is None else camera.result()
                keep_oriented(flown.telemetry, filmed.oriented)
                history = filmed.history
            elif method == "fused":
                from estimators.fusing import fuse_flight

                # the fusion estimates the deflection at the benchmark itself
                used = filmed is not None and "camera" in histories
                own = filmed.plain if filmed is not None and used else None
                if own is None and flight is not None and "camera" not in refused:
                    own = camera_for_fusion(flight)
                bias_sd_s = 0.0 if flight is None else _time_bias_sd_s(flight)
                fused = fuse_flight(_loads_of("fuse", flown), own, bias_sd_s, time_bias if used else None)
                history = fused.history
            else:
                history = (estimate_misalignment if method == "misalignment" else estimate_trim)(flown)
        except GateError as fault:
            refused[method] = Issue(str(fault), fault.codes[0])
            continue
        if method == "camera" and filmed is not None and filmed.has_only_benchmarks:
            words = f"no frame but the benchmark frame can be used ({history.assumptions})"
            refused[method] = Issue(words, "too-few-data")
        elif np.isfinite(history.theta_rad).any():
            histories[method] = history
        else:
            refused[method] = Issue(f"no sample has an answer ({history.assumptions})", "no-answer")
    report(1.0, "estimated")
    histories = {m: histories[m] for m in methods if m in histories}
    refused = {m: refused[m] for m in methods if m in refused}
    return Deflections(histories, refused, fused, filmed, None if filmed is None else filmed.smooth, bet, loads)


def with_increments(answers: Deflections) -> Deflections:
    """Answers with the increments of the aerodynamic coefficients, or why there are none.

    Without a fused answer there are none, and nothing is said of them.
    """
    if answers.fused is None or answers.bet is None:
        return answers
    try:
        return replace(answers, increments=_increments(answers.fused, answers.bet))
    except GateError as fault:
        return replace(answers, no_increments=Issue(str(fault), fault.codes[0]))


@on_one_thread
def aero_increments(bet: Reconstruction, answers: Deflections | None = None) -> AeroIncrements:
    """Increments of C_A, C_N, C_m and C_mq along Mach number against the vehicle's preflight table.

    Parameters
    ----------
    bet : Reconstruction
    answers : Deflections, optional
        Of `fuse`; else it is made.

    Raises
    ------
    GateError
        Where the answers are of another trajectory, there is no fused deflection, or the increments do not settle.
    """
    check_type("aero_increments", bet, Reconstruction, RECONSTRUCT)
    found = fuse(bet) if answers is None else answers
    check_type("aero_increments: answers", found, Deflections, "pf.fuse(bet)")
    if found.bet is not bet:
        raise GateError("aero_increments: these answers are of another trajectory: pf.fuse(bet)", "argument-value")
    if found.fused is None:
        raise GateError([found.refused.get("fused", Issue("the fused deflection was not asked for", "input-missing"))])
    return _increments(found.fused, bet)


def _increments(fused: Fused, bet: Reconstruction) -> AeroIncrements:
    """Increments; if there are none and the film's clock is off, the error names the clock first."""
    from postflight.flown_coefficients import increments_of

    try:
        return increments_of(fused, bet.solution.settings.check_confidence, bet.telemetry.name)
    except GateError as fault:
        bias = fused.camera_time_bias
        if bias is None or not bias.is_off:
            raise
        raise GateError(f"{bias.cause}; {fault}", fault.codes[0]) from None


def _time_bias_sd_s(flight: Flight) -> float:
    return min((film.time_bias_sd_s for film in flight.telemetry.films.values()), default=0.0)


def fused_history(bet: Reconstruction, camera: DeflectionHistory | None) -> DeflectionHistory | None:
    """Fused deflection alone, without a test of the camera's time bias; None where there is none."""
    from estimators.fusing import fuse_flight

    untested: Future[CameraTimeBias | None] = Future()
    untested.set_result(None)
    try:
        found = fuse_flight(bet.required_loads(), camera, _time_bias_sd_s(bet.flight), untested).history
    except GateError:
        return None
    return found if np.isfinite(found.theta_rad).any() else None


def camera_for_fusion(flight: Flight) -> DeflectionHistory | None:
    """Camera's history for the fusion if the camera itself was not requested; None without usable video."""
    if not flight.telemetry.films:
        return None
    try:
        return estimate_camera(flight)
    except GateError:
        return None


def camera_sensitivity(flight: Flight, history: DeflectionHistory) -> pd.DataFrame:
    """Deflection read from the frame of the largest one under other assumptions: the seed paper's Table 2.1.

    Columns ``joint_station_m, plane_lv_deg, deflection_deg, paper_deg``. It need not equal the paper's column: one
    camera sees the component towards it, and the shell and lens are not IRVE-II's.
    """
    from estimators.camera import sensitivity_table
    from postflight.filming import with_largest

    telemetry, history = with_largest(flight.telemetry, history)
    frames, vehicle = telemetry.frames, telemetry.required_vehicle()
    assert frames is not None
    straight, deflected = (frames.picture(k) for k in (frames.benchmark, history.largest()))
    stations = np.array([0.0, vehicle.joint.station_m])
    planes = np.deg2rad(list(PAPER_TABLE_2_1_DEG))
    angles = sensitivity_table(straight, deflected, vehicle.geometry, frames.camera, planes, stations)
    rows = [
        (station, plane, np.rad2deg(angle), paper)
        for station, line in zip(stations, angles, strict=True)
        for (plane, paper), angle in zip(PAPER_TABLE_2_1_DEG.items(), line, strict=True)
    ]
    return pd.DataFrame(rows, columns=["joint_station_m", "plane_lv_deg", "deflection_deg", "paper_deg"])
