"""Can the camera be oriented on the benchmark frame, and does the frame show the features that the vehicle file states?

The frame is tried as a run would use it, which takes seconds where the camera's lens is not calibrated. Nothing is
estimated from any other frame.
"""

from __future__ import annotations

from flightmodel.checks import GateError
from flightmodel.flightfolder import Sources
from flightmodel.telemetry import Finding

SOURCE = "frames"


def benchmark_frame(found: Sources) -> list[Finding]:
    """Check that the benchmark frame orients the camera.

    Returns
    -------
    list of Finding
        Why it does not, with the code that a run would refuse the film with; or ``features-not-found`` (or the code of
        the failed orientation) where another way had to be taken than by the features that the vehicle file states.
    """
    frames, vehicle = found.frames, found.vehicle
    if frames is None or vehicle is None or not len(frames.time_s):
        return []
    from estimators.benchmark import orient_camera  # which a folder without video needs not wait for
    from estimators.frame_edits import edited

    at = float(frames.time_s[frames.benchmark])
    picture = edited(frames.picture(frames.benchmark), frames.edits, at)
    geometry, joint_m, pose = vehicle.geometry, vehicle.joint.station_m, frames.edits.pose
    try:
        oriented = orient_camera(picture, geometry, frames.camera, joint_m, pose=pose)
    except GateError as fault:
        return [Finding(SOURCE, str(fault), at, at, fault.codes[0])]
    if oriented.stated_refused:
        words = f"{oriented.stated_refused}; a run goes by the edge and the shell's texture"
        return [Finding(SOURCE, words, at, at, oriented.stated_refused.code)]
    return []
