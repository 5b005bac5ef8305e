"""Which edits does an analyst make in a frame? Masked regions, points of the edge, places of features.

`EditedFrame` is a picture with the decisions about it (`flightmodel.camera_edits`); the fit looks for edge and features
through it alone:

- inside a mask, and where text is burnt into the film (`flightmodel.film`), nothing is found;
- points of the edge marked by hand take the place of the edge found in that frame;
- features marked by hand in the benchmark frame become points of the shell where their rays meet it
  (`marked_on_shell`), and where they are marked in another frame count two rows each, along the picture's rows and
  columns.

Assumed: a hand marks to about `MARK_SD_PX`, independently; the residuals' scatter inflates it as that of found points.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from estimators.edge import HorizonLine, KeptPicture, ScanLines, find_horizon, steps_near
from estimators.features import Features
from estimators.texture import surface_seen
from estimators.virtual_camera import VirtualCamera
from flightmodel.camera_edits import CameraEdits
from flightmodel.checks import BoolArray, FloatArray, GateError

Image = NDArray[np.uint8]

MARK_SD_PX = 1.0  # of a click on an enlarged picture, assumed; the scatter of the marks corrects it
LEAST_MARKS = 5  # deflection (2), flattening and light leave less than that undetermined


@dataclass(frozen=True)
class MarkedFeatures:
    """Features found by the camera, followed by those that an analyst marked, two rows each.

    Parameters
    ----------
    found : Features
    names : tuple of str
        Of the marked ones, k.
    marked_shell_m : (k, 3) float
        Where they are on the undeflected shell, from the datum.
    """

    found: Features
    names: tuple[str, ...]
    marked_shell_m: FloatArray = field(repr=False)

    @property
    def points_shell_m(self) -> FloatArray:
        """See `Features`."""
        return np.concatenate([self.found.points_shell_m, np.repeat(self.marked_shell_m, 2, axis=0)])

    @property
    def across_px(self) -> FloatArray:
        """See `Features`."""
        return np.concatenate([self.found.across_px, np.tile(np.eye(2), (len(self.names), 1))])

    def find(
        self, view: VirtualCamera, image: Image, deformation: FloatArray, reach_px: int
    ) -> tuple[FloatArray, FloatArray]:
        """See `Features.find`; the marked ones are not looked for."""
        place, sd = self.found.find(view, image, deformation, reach_px)
        rows = 2 * len(self.names)
        return np.concatenate([place, np.zeros(rows)]), np.concatenate([sd, np.full(rows, np.inf)])


@dataclass(frozen=True)
class EditedFrame:
    """A picture with an analyst's edits.

    Parameters
    ----------
    image : (h, w) uint8
    hidden : (h, w) bool or None
        Where nothing is looked for.
    rim_px : (m, 2) float
        Points of the shell's edge; none: it is searched.
    features_px : mapping of str to (2,) float
        Where features are, by name.
    """

    image: Image
    hidden: BoolArray | None = None
    rim_px: FloatArray = field(default_factory=lambda: np.zeros((0, 2)))
    features_px: Mapping[str, FloatArray] = field(default_factory=dict)

    @cached_property
    def kept(self) -> KeptPicture:
        """The picture with what was made of it."""
        return KeptPicture(self.image)

    @property
    def has_marked_edge(self) -> bool:
        """Whether the edge was marked by hand."""
        return len(self.rim_px) >= LEAST_MARKS

    def far_edge(self, lines: ScanLines, size_px: tuple[int, int]) -> HorizonLine:
        """Edge searched from far; see `find_horizon`."""
        return self._edge(find_horizon(self.kept, lines, size_px), lines)

    def near_edge(self, lines: ScanLines) -> HorizonLine:
        """Edge within a few pixels of where it is expected; see `steps_near`."""
        return self._edge(steps_near(self.kept, lines), lines)

    def _edge(self, found: HorizonLine, lines: ScanLines) -> HorizonLine:
        if self.has_marked_edge:
            return _marked_edge(self.rim_px, lines)
        return found if self.hidden is None else found.some(self.is_clear(found.points_px))

    def features(
        self, features: Features, view: VirtualCamera, deformation: FloatArray, reach_px: int
    ) -> tuple[FloatArray, FloatArray]:
        """Places of features and their sd; see `Features.find`."""
        place, sd = features.find(view, self.image, deformation, reach_px)
        if self.hidden is not None:
            at = view.sight(features.points_shell_m, deformation).pixels
            sd = np.where(self.is_clear(np.nan_to_num(at, nan=-1.0)), sd, np.inf)
        return place, sd

    def with_marked(
        self, features: Features, found: tuple[FloatArray, FloatArray] | None
    ) -> tuple[FloatArray, FloatArray] | None:
        """Add the features marked in this frame to those found; None where there is neither."""
        if not isinstance(features, MarkedFeatures) or not set(features.names) & set(self.features_px):
            return found
        n = len(features.across_px)
        place, sd = (np.zeros(n), np.full(n, np.inf)) if found is None else (found[0].copy(), found[1].copy())
        for k, name in enumerate(features.names):
            if name in self.features_px:
                rows = slice(n - 2 * len(features.names) + 2 * k, n - 2 * len(features.names) + 2 * k + 2)
                place[rows], sd[rows] = self.features_px[name], MARK_SD_PX
        return place, sd

    def is_clear(self, pixels: FloatArray) -> BoolArray:
        """Whether pixels (n, 2) lie outside the masks; those outside the picture do."""
        if self.hidden is None:
            return np.ones(len(pixels), dtype=np.bool_)
        h, w = self.hidden.shape
        u, v = np.rint(pixels).astype(int).T
        inside = (u >= 0) & (v >= 0) & (u < w) & (v < h)
        return np.asarray(~inside | ~self.hidden[np.clip(v, 0, h - 1), np.clip(u, 0, w - 1)])


def edited(image: Image, edits: CameraEdits, t_s: float, fixed: BoolArray | None = None) -> EditedFrame:
    """Picture of the frame at a time with the decisions about it, and what is fixed in every picture (h, w) hidden."""
    rim = np.array([(row.u_px, row.v_px) for row in edits.at("rim", t_s)]).reshape(-1, 2)
    return EditedFrame(image, _hidden(image, edits.masks_px(t_s), fixed), rim, edits.features_px(t_s))


def _hidden(image: Image, masks_px: list[FloatArray], fixed: BoolArray | None) -> BoolArray | None:
    has_fixed = fixed is not None and fixed.shape == image.shape
    if not (masks_px or has_fixed) or image.ndim != 2:
        return None
    hidden = fixed.astype(np.uint8) if fixed is not None and has_fixed else np.zeros(image.shape, dtype=np.uint8)
    for corners in masks_px:
        cv2.fillPoly(hidden, [np.rint(corners).astype(np.int32)], (1,))
    return np.asarray(hidden, dtype=np.bool_)


def _marked_edge(rim_px: FloatArray, lines: ScanLines) -> HorizonLine:
    """Points marked on the edge, each on the scan line that passes nearest."""
    off = rim_px[:, None] - lines.origin_px
    across = np.abs(off[..., 0] * lines.inward_px[:, 1] - off[..., 1] * lines.inward_px[:, 0])
    # a line's other side may pass near a point of the opposite rim
    nearest = np.argmin(across + 0.1 * np.linalg.norm(off, axis=2), axis=1)
    order = np.argsort(lines.index[nearest], kind="stable")
    nearest = nearest[order]
    sd = np.full(len(order), MARK_SD_PX)
    return HorizonLine(rim_px[order], lines.inward_px[nearest], sd, lines.index[nearest], is_by_hand=True)


def marked_on_shell(view: VirtualCamera, features_px: Mapping[str, FloatArray]) -> tuple[tuple[str, ...], FloatArray]:
    """Names and points (k, 3) of the undeflected shell that features marked in the benchmark frame show.

    Raises
    ------
    GateError
        Where one is not on the shell.
    """
    names = tuple(features_px)
    if not names:
        return names, np.zeros((0, 3))
    seen = surface_seen(view, np.array([features_px[name] for name in names]))
    off = [name for name, torus in zip(names, seen.torus, strict=True) if torus < 0]
    if off:
        raise GateError(
            f"camera edits: marked in the benchmark frame, {', '.join(off)} is not on the shell; mark it there, or "
            "remove it",
            code="edit-unusable",
        )
    return names, seen.points_shell_m


def unedited(image: Image | EditedFrame) -> EditedFrame:
    """A picture without edits, as a frame."""
    return image if isinstance(image, EditedFrame) else EditedFrame(image)
