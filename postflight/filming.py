"""The deflection by the onboard cameras: one film by itself, or several joined into one history.

A film that cannot be used does not stop the others: it is named, with its reason, in the answer's assumptions and by a
consistency check. Where a trajectory gives the dynamic pressure at the frames, the shell's shape under load is
estimated from all films, and every frame's answer uses it.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import pandas as pd

from estimators.agreement import CONFIDENCE
from estimators.assumed_plane import plane_check
from estimators.benchmark import BenchmarkDeflection, benchmark_deflection, joint_moment, orient_camera
from estimators.camera import FilmFit, JointSwing, read_film
from estimators.camera_fit import OrientedCamera
from estimators.cameras import CameraReadings, JoinedCameras, join_cameras
from estimators.frame_edits import edited
from estimators.fusing import CAMERA_PLANE_SD_RAD, CameraTimeBias, time_bias_if_free
from estimators.fusion import smoothed
from estimators.shell_shape import ShellShape, shell_shape, with_shape
from estimators.unloaded_frames import rest_check
from flightmodel.checks import Check, DivergenceError, GateError, Issue, Progress, part_of
from flightmodel.deflection import DeflectionHistory
from flightmodel.film import Frames
from flightmodel.telemetry import Telemetry
from flightmodel.trajectory import nearest_index
from flightmodel.vehicle import Vehicle
from postflight.flight import Flight
from postflight.methods import Inputs
from postflight.reconstruction import Reconstruction

_SAME_FRAME_S = 1e-3
# cameras that were oriented last, of which a run's pictures ask several times; as many as flights have
_ORIENTED: dict[tuple[Frames, Vehicle], OrientedCamera] = {}
_MOST_ORIENTED = 4


@dataclass(frozen=True)
class CameraAnswer:
    """Deflection by all cameras, and the data behind it.

    Parameters
    ----------
    history : DeflectionHistory
        At the frames, with the benchmark frames' deflection corrected where the moment in the joint determines it.
    plain : DeflectionHistory
        The same with the benchmark frames taken as undeflected, for the fusion.
    smooth : DeflectionHistory or None
        At any time; None in an assumed plane, or of too few frames.
    frames : DataFrame
        What became of every frame: ``camera`` and the columns of `FilmFit.frame_table`.
    joined : JoinedCameras or None
        None of one camera alone.
    benchmarks_s : tuple of float
        Times of the benchmark frames.
    shape : ShellShape or None
        How the shell's shape followed the load; None where nothing determines it (why stands in the assumptions).
    consistency_checks : tuple of Check
        Whether each camera's shell rests without load, shows stated features and lies in the assumed plane; whether
        several cameras agree.
    oriented : dict of OrientedCamera
        Each camera with an answer, oriented on its benchmark frame.
    """

    history: DeflectionHistory
    plain: DeflectionHistory
    smooth: DeflectionHistory | None
    frames: pd.DataFrame
    joined: JoinedCameras | None
    benchmarks_s: tuple[float, ...]
    shape: ShellShape | None = None
    consistency_checks: tuple[Check, ...] = ()
    oriented: dict[str, OrientedCamera] = field(default_factory=dict)

    @property
    def has_only_benchmarks(self) -> bool:
        """Whether no frame but a benchmark frame has an answer."""
        answered = self.history.time_s[np.isfinite(self.history.theta_rad)]
        return len(answered) > 0 and bool(np.isin(answered, self.benchmarks_s).all())


def camera_film(flight: Flight, frames: Frames | None = None, progress: Progress | None = None) -> FilmFit:
    """Frame-by-frame fit of a film, the first camera's without ``frames``; `GateError` if it is not usable."""
    frames = flight.telemetry.frames if frames is None else frames
    Inputs.of(flight.telemetry).require("camera")
    assert frames is not None
    vehicle = flight.telemetry.required_vehicle()
    return read_film(
        frames.time_s,
        frames.pictures(),
        vehicle.geometry,
        frames.camera,
        vehicle.joint.station_m,
        benchmark_time_s=frames.benchmark_s,
        plane_lv_rad=flight.camera_plane_lv_rad,
        benchmark=frames.picture(frames.benchmark),
        progress=progress,
        joint_swing=joint_swing(vehicle),
        edits=frames.edits,
        fixed=frames.burnt_in,
    )


def orient_on_film(frames: Frames, vehicle: Vehicle) -> OrientedCamera:
    """Camera oriented on the benchmark frame of a film, with the analyst's decisions applied.

    Raises
    ------
    GateError
        Where the frame cannot be used.
    """
    found = _ORIENTED.get((frames, vehicle))
    if found is None:
        at_s = float(frames.time_s[frames.benchmark])
        picture = edited(frames.picture(frames.benchmark), frames.edits, at_s, frames.burnt_in)
        station_m, pose = vehicle.joint.station_m, frames.edits.pose
        found = orient_camera(picture, vehicle.geometry, frames.camera, station_m, pose=pose)
        _keep(frames, vehicle, found)
    return found


def keep_oriented(telemetry: Telemetry, oriented: dict[str, OrientedCamera]) -> None:
    """Give `orient_on_film` the oriented cameras of an answer, which may come from another process."""
    for name, one in oriented.items():
        _keep(telemetry.films[name], telemetry.required_vehicle(), one)


def _keep(frames: Frames, vehicle: Vehicle, oriented: OrientedCamera) -> None:
    _ORIENTED[frames, vehicle] = oriented
    for old in list(_ORIENTED)[:-_MOST_ORIENTED]:
        _ORIENTED.pop(old, None)


def joint_swing(vehicle: Vehicle) -> JointSwing | None:
    """Natural frequency of the vehicle's joint and its damping; None without a spring that bends."""
    critical = vehicle.critical_damping_nmsprad()
    if not critical > 0.0:
        return None
    return JointSwing(vehicle.free_free_frequency_hz(), vehicle.joint.bending_damping_nmsprad / critical)


def camera_answer(
    flown: Flight | Reconstruction, film: FilmFit | None = None, progress: Progress | None = None
) -> CameraAnswer:
    """Deflection by the flight's cameras.

    Parameters
    ----------
    flown : Flight or Reconstruction
        Without a trajectory the benchmark frames are taken as undeflected.
    film : FilmFit, optional
        What the film of the flight's one camera shows, where it is read already.
    progress : callable, optional

    Raises
    ------
    GateError
        Where there is no video, or none that can be used.
    """
    flight, bet = (flown, None) if isinstance(flown, Flight) else (flown.flight, flown)
    telemetry = flight.telemetry
    several = len(telemetry.films) > 1
    if several and flight.camera_plane_lv_rad is not None:
        words = "several cameras estimate the plane; assume none, or leave one camera in flight.toml"
        raise GateError(words, "keys-conflict")
    refused: dict[str, Issue] = {}
    if several:
        films, refused = _usable_films(flight, progress)
    else:
        film = camera_film(flight, progress=progress) if film is None else film
        films = dict.fromkeys(telemetry.films, film)
    if bet is not None:
        for name, one in films.items():
            at_pa = np.interp(one.time_s, bet.air.time_s, bet.air.dynamic_pressure_pa, left=np.nan, right=np.nan)
            films[name] = replace(one, pressure_pa=at_pa)
    films, shape, words_of_shape = _with_shell_shape(films, flight, bet)
    benchmarks, histories, tables = {}, {}, []
    rests: list[Check] = []
    features: list[Check] = []
    for name, film in films.items():
        benchmarks[name], why = _benchmark(film, telemetry.films[name].time_bias_sd_s, flight, bet)
        history = film.history(benchmarks[name])
        histories[name] = replace(history, assumptions=f"{history.assumptions}{why}")
        source = name if several else "camera"
        rests += _rests(source, name, film, history, bet, benchmarks[name] is not None)
        features += _features(source, name, film, flight)
        tables.append(film.frame_table(history))
        tables[-1].insert(0, "camera", name)
    joined = None
    if several:
        joined, at_plain = _joined(flight, films, benchmarks)
        used = {one.name for one in joined.readings}
        refused |= {name: Issue("too few frames with an answer", "too-few-data") for name in films if name not in used}
        remarks = [f"{name}: {history.assumptions}" for name, history in histories.items()]
        remarks += [f"{name}: no answer ({reason})" for name, reason in refused.items()]
        words = "; ".join([joined.at_frames.assumptions, joined.remark, words_of_shape, *remarks])
        history, plain = replace(joined.at_frames, assumptions=words), at_plain.at_frames
        smooth: DeflectionHistory | None = replace(joined.smooth, assumptions=words)
        last = _of_all(joined, refused)
    else:
        ((name, film),) = films.items()
        history = replace(histories[name], assumptions=f"{histories[name].assumptions}; {words_of_shape}")
        plain, smooth = film.history(), _smooth(flight, history)
        last = [check for check in (plane_check(film),) if check is not None]
    return CameraAnswer(
        history, plain, smooth, pd.concat(tables, ignore_index=True), joined,
        tuple(film.benchmark_s for film in films.values()), shape, (*rests, *features, *last),
        {name: film.oriented for name, film in films.items()},
    )  # fmt: skip


def time_bias_of(bet: Reconstruction, camera: CameraAnswer) -> CameraTimeBias | None:
    """`time_bias_if_free` of a trajectory and a camera's answer."""
    return time_bias_if_free(bet.required_loads(), camera.plain)


def _usable_films(flight: Flight, progress: Progress | None) -> tuple[dict[str, FilmFit], dict[str, Issue]]:
    """Fits of the films of several cameras, and why others cannot be used; `GateError` where none can."""
    films: dict[str, FilmFit] = {}
    refused: dict[str, Issue] = {}
    of_flight = flight.telemetry.films
    count = len(of_flight)
    # one after the other: in threads they take as long, for each holds the interpreter most of the time
    for k, (name, frames) in enumerate(of_flight.items()):
        shown = None if progress is None else part_of(progress, k / count, (k + 1) / count)
        try:
            films[name] = camera_film(flight, frames, shown)
        except GateError as fault:
            refused[name] = Issue(str(fault), fault.codes[0])
    if not films:
        raise GateError([Issue(f"{name}: {reason}", reason.code) for name, reason in refused.items()])
    return films, refused


def _joined(
    flight: Flight, films: dict[str, FilmFit], benchmarks: dict[str, BenchmarkDeflection | None]
) -> tuple[JoinedCameras, JoinedCameras]:
    """One answer of several cameras: with the benchmark frames' deflection, and with these taken as undeflected."""
    plain = []
    for name, film in films.items():
        read = film.relative_to_benchmark(flight.telemetry.films[name].time_bias_sd_s)
        plain.append(CameraReadings(name, read, film.undeflected_benchmark, float(CAMERA_PLANE_SD_RAD)))
    corrected = [replace(one, benchmark=benchmarks[one.name] or one.benchmark) for one in plain]
    joined = join_cameras(corrected, _swing_hz(flight))
    return joined, join_cameras(plain, _swing_hz(flight)) if any(benchmarks.values()) else joined


def _of_all(joined: JoinedCameras, refused: dict[str, Issue]) -> list[Check]:
    """Checks that the cameras agree, and that each has an answer."""
    checks = []
    if joined.tests:
        least, name = min(test.p_value for test in joined.tests), "cameras agree: least chance of a test"
        passed, words = joined.agree, joined.remark
        checks.append(Check("cameras", name, least, 1.0 - CONFIDENCE, 1.0, passed, words, joined.suspect))
    words = "; ".join(f"{name}: {reason}" for name, reason in refused.items()) or "every camera has an answer"
    count, name, source = float(len(refused)), "cameras without an answer", ", ".join(refused)
    return [*checks, Check("camera-refused", name, count, 0.0, 0.0, not refused, words, source)]


def _with_shell_shape(
    films: dict[str, FilmFit], flight: Flight, bet: Reconstruction | None
) -> tuple[dict[str, FilmFit], ShellShape | None, str]:
    """Films corrected for the shell's shape under load, that shape, and a remark on it or why there is none."""
    try:
        if bet is None:
            raise GateError("no trajectory was made", "input-missing")
        if flight.camera_plane_lv_rad is not None:
            raise GateError("a plane is assumed", "keys-conflict")
        shape = shell_shape(list(films.values()))
    except GateError as fault:
        return films, None, f"shell's shape: frame by frame, within its a priori sd ({fault})"
    shaped = dict(zip(films, with_shape(list(films.values()), shape), strict=True))
    return shaped, shape, f"shell's shape: {shape.remark}"


def _benchmark(
    film: FilmFit, late_s: float, flight: Flight, bet: Reconstruction | None
) -> tuple[BenchmarkDeflection | None, str]:
    """Deflection of the benchmark frame by the moment in the joint; None, with the reason, where there is none."""
    try:
        if bet is None:
            Inputs.of(flight.telemetry).require("misalignment")
            raise GateError("no trajectory was made", "input-missing")
        frames = film.relative_to_benchmark(late_s)
        return benchmark_deflection(frames, bet.required_loads(), film.oriented.apriori.benchmark_rad), ""
    except GateError as fault:
        return None, f"; the benchmark's deflection is not corrected by the joint's moment ({fault})"


def _features(source: str, name: str, film: FilmFit, flight: Flight) -> list[Check]:
    """Check that a film's benchmark frame shows the features of the vehicle file; none if it states none."""
    if flight.telemetry.required_vehicle().geometry.features in ("none", "texture"):
        return []
    why = film.oriented.stated_refused
    words = f"{name}: the benchmark frame shows the features that the vehicle file states"
    if why:
        words = (
            f"{name}: {why}; the answers go by edge and texture, and more may be wrong: check outline, mount "
            'and lens of the vehicle file and that the frame is one at rest, or state features = "texture"'
        )
    label = f"{name}: stated features not found"
    return [Check("camera-features", label, float(bool(why)), 0.0, 0.0, not why, words, source)]


def _rests(
    source: str, name: str, film: FilmFit, history: DeflectionHistory, bet: Reconstruction | None, corrected: bool
) -> list[Check]:
    """Check that a camera's shell is at rest in frames without load; none if no frame can show it.

    The load is the moment in the joint, or without inertial sensors the dynamic pressure; unknown without a trajectory.
    """
    load = film.pressure_pa
    if bet is not None and bet.loads is not None:
        moment_nm = np.linalg.norm(joint_moment(bet.loads).value_nm, axis=1)
        load = np.interp(film.time_s, bet.loads.time_s, moment_nm, left=np.nan, right=np.nan)
    rest = rest_check(history, load, film.benchmark_s, film.oriented.apriori.benchmark_rad, corrected)
    if rest is None:
        return []
    return [replace(rest, name=f"{name}: {rest.name}", remark=f"{name}: {rest.remark}", source=source)]


def _smooth(flight: Flight, history: DeflectionHistory) -> DeflectionHistory | None:
    """One camera's history as a second-order process; None in an assumed plane, or where too few frames answered."""
    if flight.camera_plane_lv_rad is not None:
        return None
    try:
        return smoothed(history, swing_hz=_swing_hz(flight))
    except DivergenceError:
        return None


def _swing_hz(flight: Flight) -> float | None:
    """Natural frequency of the vehicle's joint; None without a spring that bends."""
    swing = joint_swing(flight.telemetry.required_vehicle())
    return None if swing is None else swing.frequency_hz


def is_oriented(telemetry: Telemetry, frames: Frames) -> bool:
    """Whether the benchmark frame orients the camera."""
    try:
        orient_on_film(frames, telemetry.required_vehicle())
    except GateError:
        return False
    return True


def by_camera(telemetry: Telemetry, history: DeflectionHistory) -> dict[str, tuple[Telemetry, DeflectionHistory]]:
    """Telemetry with one camera, and the history at its frames (NaN where it has no answer), of each camera with some.

    Of one camera alone with an answer or NaN at every frame, both as they are; else those cameras that their benchmark
    frame orients. A history that was read back has no rows where there is no answer.
    """
    if len(telemetry.films) == 1 and all(np.array_equal(history.time_s, f.time_s) for f in telemetry.films.values()):
        return dict.fromkeys(telemetry.films, (telemetry, history))
    out = {}
    for name, frames in telemetry.films.items():
        nearest = nearest_index(history.time_s, frames.time_s)
        there = np.abs(history.time_s[nearest] - frames.time_s) < _SAME_FRAME_S
        theta = np.where(there, history.theta_rad[nearest], np.nan)
        cov = None if history.covariance is None else history.covariance[nearest]
        plane = history.plane_lv_rad[nearest]
        own = DeflectionHistory(frames.time_s, theta, plane, cov, history.method, history.assumptions)
        if np.isfinite(theta).any() and is_oriented(telemetry, frames):
            out[name] = (replace(telemetry, films={name: frames}), own)
    return out


def with_largest(telemetry: Telemetry, history: DeflectionHistory) -> tuple[Telemetry, DeflectionHistory]:
    """The camera, as in `by_camera`, whose frames show the largest deflection."""
    return max(by_camera(telemetry, history).values(), key=lambda one: np.nanmax(np.abs(one[1].theta_rad)))
