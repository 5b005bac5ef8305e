"""Does a film bear out the plane in which its deflection is assumed to lie?

Each frame is fitted with the plane estimated too. Of the frames in which that answer ``r`` is at least half of the
film's largest, with the answer ``a`` in the assumed plane and both their sd ``s``,

    z = (|r| - |a|) / (s_r^2 + s_a^2)^1/2

is what the assumed plane leaves out over what the error bars allow: ``s_a`` holds the plane's stated sd. A film whose
frames with hardly an exception have an ``a`` well below zero shows the opposite plane: ``-a`` over the sd that the
frame alone gives it stands for ``z``, because no error of the plane by less than a right angle turns its sign.

Assumed: errors of ``r`` and ``a`` add up like independent ones, although they have the camera and the benchmark frame
in common, which makes ``z`` smaller than it might be; the frames err together, so that all have the limit of one.
"""

from __future__ import annotations

import numpy as np
from scipy.special import ndtri

from estimators.agreement import CONFIDENCE
from estimators.camera import FilmFit, polar
from flightmodel.checks import Check
from flightmodel.deflection import lv_clock

_LOADED = 0.5  # of the largest deflection: below, a wrong plane hides in the error bar
_MISREAD = 10  # one frame of so many may be
LIMIT_SD = float(ndtri(CONFIDENCE))


def plane_check(film: FilmFit) -> Check | None:
    """Check that a film bears out its assumed plane; None where none is assumed, or no frame has an answer."""
    fits = [fit.with_open_plane for fit in film.fits]
    rows = np.array([k for k, fit in enumerate(fits) if fit is not None and not film.fits[k].refused], dtype=int)
    if film.plane_lv_rad is None or not len(rows):
        return None
    history = film.history()
    read = [polar(fit.rotation_yz_rad, fit.covariance) for k in rows if (fit := fits[k]) is not None]
    size, clock, var = (np.array(x) for x in zip(*((r, p, c[0, 0]) for r, p, c in read), strict=True))
    loaded = size >= _LOADED * size.max()
    rows, size, clock, var = rows[loaded], size[loaded], clock[loaded], var[loaded]
    inside, sd = history.theta_rad[rows], history.theta_sd_rad[rows]
    own_sd = np.sqrt([film.fits[k].covariance[0, 0] for k in rows])
    apart = (size - np.abs(inside)) / np.sqrt(var + sd**2)
    left_out = len(rows) // _MISREAD
    over_sd = max(float(np.sort(apart)[::-1][left_out]), float(np.sort(-inside / own_sd)[left_out]), 0.0)
    mean = np.mean(size[:, None] * np.column_stack([-np.cos(clock), np.sin(clock)]), axis=0)
    theta, plane, within, assumed = np.rad2deg([size.mean(), lv_clock(mean), inside.mean(), film.plane_lv_rad])
    words = (
        f"camera: in the assumed plane ({assumed:.0f} deg LV) the shell is deflected by {within:.2f} deg, with the "
        f"plane left open by {theta:.2f} deg towards {plane:.0f} deg LV (means of the frames with most)"
    )
    passed, name = over_sd <= LIMIT_SD, "deflection that the assumed plane leaves out, over its sd"
    if not passed:
        words += f", {over_sd:.1f} sd apart: leave the plane open (no --plane, no camera_plane_lv_deg)"
    return Check("camera-plane", name, over_sd, 0.0, LIMIT_SD, passed, words, "camera")
