"""Where does a point of the vehicle appear in the picture, and what does a pixel look at?

The lens is Kannala and Brandt's fisheye in OpenCV's form. A point ``(X, Y, Z)`` in camera axes lies at the angle
``a = atan2(hypot(X, Y), Z)`` from the optical axis and at the distance

    a_d = a (1 + k1 a^2 + k2 a^4 + k3 a^6 + k4 a^8)

from the principal point, in units of the focal length: ``u = fx a_d X/hypot(X, Y) + cx`` and likewise ``v``. Camera
axes are x right, y down, z forward; pixel centres lie at integers. Only points in front of the camera and inside the
field where ``a_d`` grows with ``a`` have a pixel: OpenCV itself returns a mirrored pixel for a point behind the camera.

A ``pinhole`` lens is OpenCV's other form, ``x = X/Z``, ``y = Y/Z`` with radial k1, k2, k3 and tangential p1, p2
(coefficients in the order k1, k2, p1, p2, k3).

References
----------
J. Kannala, S. Brandt, "A generic camera model and calibration method for conventional, wide-angle, and fish-eye
lenses", IEEE PAMI 28(8), 2006. OpenCV, module ``cv2.fisheye``.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from flightmodel import rotations
from flightmodel.checks import FloatArray, GateError, check_finite, check_shape
from flightmodel.deflection import lv_direction

if TYPE_CHECKING:
    from flightmodel.vehicle import CameraMount


BoolArray = NDArray[np.bool_]
Lens = Literal["fisheye", "pinhole"]
LensTerms = tuple[int, FloatArray, FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]
LENSES: tuple[Lens, ...] = ("fisheye", "pinhole")
FISHEYE = LENSES.index("fisheye")

WIDEST_HALF_ANGLE_RAD = float(np.deg2rad(89.0))
"""OpenCV projects through X/Z, so a point must lie in front of the camera."""
_ANGLES_RAD = np.linspace(0.0, WIDEST_HALF_ANGLE_RAD, 2000)
_SKEWNESS = 1e-9 + 1e-5 * np.eye(3)  # of a rotation matrix times its transpose, at most


@dataclass(frozen=True)
class Camera:
    """A camera fixed to the centerbody.

    Parameters
    ----------
    width_px, height_px : int
        Size of the picture.
    focal_px, centre_px : (2,) float
        Focal lengths and principal point along u (right) and v (down), px.
    distortion : (4,) or (5,) float
        Kannala-Brandt k1 to k4 of a fisheye; k1, k2, p1, p2 and, if there is one, k3 of a pinhole.
    position_body_m : (3,) float
        Entrance pupil from the datum, body axes, m.
    dcm_cam_body : (3, 3) float
        ``v_cam = dcm_cam_body @ v_body``.
    lens : str
        ``"fisheye"`` or ``"pinhole"``.
    """

    width_px: int
    height_px: int
    focal_px: FloatArray
    centre_px: FloatArray
    distortion: FloatArray
    position_body_m: FloatArray
    dcm_cam_body: FloatArray
    lens: Lens = "fisheye"
    half_field_rad: float = field(init=False)

    def __post_init__(self) -> None:
        """Check shapes and orthonormality once; find the field in which the lens is one-to-one."""
        shapes: dict[str, tuple[int | None, ...]] = {
            "focal_px": (2,),
            "centre_px": (2,),
            "distortion": (4 if self.lens == "fisheye" or len(self.distortion) == 4 else 5,),
            "position_body_m": (3,),
            "dcm_cam_body": (3, 3),
        }
        for name, shape in shapes.items():
            value = check_shape(f"camera.{name}", np.asarray(getattr(self, name), dtype=float), shape)
            check_finite(f"camera.{name}", value)
            object.__setattr__(self, name, value)
        dcm = self.dcm_cam_body
        if (np.abs(dcm @ dcm.T - np.eye(3)) > _SKEWNESS).any() or np.linalg.det(dcm) < 0.0:
            raise GateError("camera.dcm_cam_body: not a rotation matrix", code="argument-value")
        object.__setattr__(self, "half_field_rad", float(one_to_one_half_angle_rad(self.distortion, self.lens)))

    @cached_property
    def lens_terms(self) -> tuple[int, float, FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
        """What compiled projections want: model, half field, focal, centre, coefficients (5), position and axes."""
        axes, model = np.ascontiguousarray(self.dcm_cam_body), LENSES.index(self.lens)
        coefficients = _five(self.distortion)
        return model, self.half_field_rad, self.focal_px, self.centre_px, coefficients, self.position_body_m, axes

    @cached_property
    def picture_half_angle_rad(self) -> float:
        """Largest angle from the optical axis that the picture shows, rad; the lens's field where that ends in it."""
        w, h = self.width_px, self.height_px
        across, down = np.linspace(-0.5, w - 0.5, 33), np.linspace(-0.5, h - 0.5, 33)
        border = [(u, v) for u in across for v in (down[0], down[-1])]
        border += [(u, v) for u in (across[0], across[-1]) for v in down]
        rays = self.rays_body(np.array(border))
        if not np.isfinite(rays).all():
            return self.half_field_rad
        return min(self.half_field_rad, float(np.arccos(np.clip(rays @ self.dcm_cam_body[2], -1.0, 1.0)).max()))

    @property
    def size_px(self) -> tuple[int, int]:
        """Width and height, px."""
        return self.width_px, self.height_px

    def is_inside(self, pixels: FloatArray, margin_px: float = 0.0) -> BoolArray:
        """Whether pixels ``(..., 2)`` lie in the picture, at least ``margin_px`` from its border; False for NaN."""
        u, v = pixels[..., 0], pixels[..., 1]
        low, right, bottom = margin_px - 0.5, self.width_px - 0.5 - margin_px, self.height_px - 0.5 - margin_px
        inside: BoolArray = (u >= low) & (u <= right) & (v >= low) & (v <= bottom)
        return inside

    def cam_from_body(self, points_body_m: FloatArray) -> FloatArray:
        """Points ``(n, 3)`` from the datum in body axes, as seen from the camera in its own axes, m."""
        out: FloatArray = (np.asarray(points_body_m, dtype=float) - self.position_body_m) @ self.dcm_cam_body.T
        return out

    def is_in_field(self, points_body_m: FloatArray) -> BoolArray:
        """Whether points ``(n, 3)`` lie in front of the camera, inside the one-to-one field of the lens."""
        x, y, z = self.cam_from_body(points_body_m).T
        seen: BoolArray = np.arctan2(np.hypot(x, y), z) < self.half_field_rad
        return seen

    def project(self, points_body_m: FloatArray) -> FloatArray:
        """Pixels ``(n, 2)`` of points ``(n, 3)`` in body axes; NaN outside the field of the lens."""
        return self.project_with_jacobian(points_body_m)[0]

    def project_with_jacobian(self, points_body_m: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Pixels and their derivatives.

        Parameters
        ----------
        points_body_m : (n, 3) float
            From the datum, body axes, m.

        Returns
        -------
        pixels : (n, 2) float
            NaN outside the field.
        per_cam_m : (n, 2, 3) float
            Derivative by the point's coordinates in camera axes, px/m (``@ dcm_cam_body`` for body axes).
        per_lens : (n, 2, 4 + k) float
            Derivative by focal lengths (2), principal point (2) and the coefficients, the last in px.
        """
        points_body_m = check_shape("points_body_m", points_body_m, (None, 3))
        seen = self.is_in_field(points_body_m)
        n = len(points_body_m)
        count = len(self.distortion)
        pixels, per_cam_m = np.full((n, 2), np.nan), np.full((n, 2, 3), np.nan)
        per_lens = np.full((n, 2, 4 + count), np.nan)
        if seen.any():
            cam = self.cam_from_body(points_body_m[seen])
            (fx, fy), (cx, cy) = self.focal_px, self.centre_px
            matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
            scene, still = np.ascontiguousarray(cam[:, None, :]), np.zeros(3)
            if self.lens == "fisheye":
                out, jacobian = cv2.fisheye.projectPoints(scene, still, still, matrix, self.distortion)
                jacobian = jacobian.reshape(-1, 2, 15)
                per_lens[seen], per_cam_m[seen] = jacobian[:, :, :8], jacobian[:, :, 11:14]
            else:
                out, jacobian = cv2.projectPoints(scene, still, still, matrix, self.distortion)
                jacobian = jacobian.reshape(-1, 2, 10 + count)
                per_lens[seen], per_cam_m[seen] = jacobian[:, :, 6:], jacobian[:, :, 3:6]
            pixels[seen] = out.reshape(-1, 2)
        return pixels, per_cam_m, per_lens

    def rays_body(self, pixels: FloatArray) -> FloatArray:
        """Unit directions ``(n, 3)`` in body axes that pixels ``(n, 2)`` look along; NaN outside the field.

        Inverts the lens polynomial by Newton steps, which converge everywhere inside the one-to-one field.
        """
        pixels = check_shape("pixels", pixels, (None, 2))
        if self.lens == "pinhole":
            return self._pinhole_rays(pixels)
        slope = (pixels - self.centre_px) / self.focal_px
        distance = np.hypot(slope[:, 0], slope[:, 1])
        angle = angle_from_lens_distance(distance, self.distortion, self.half_field_rad)
        away = np.where(distance > 1e-12, np.sin(angle) / np.where(distance > 1e-12, distance, 1.0), 1.0)
        cam = np.column_stack([slope * away[:, None], np.cos(angle)])
        out: FloatArray = cam @ self.dcm_cam_body
        return out

    def _pinhole_rays(self, pixels: FloatArray) -> FloatArray:
        matrix = np.diag([*self.focal_px, 1.0])
        matrix[:2, 2] = self.centre_px
        stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 200, 1e-12)
        flat = cv2.undistortPoints(pixels[:, None, :], matrix, self.distortion, criteria=stop).reshape(-1, 2)
        cam = np.column_stack([flat, np.ones(len(flat))])
        cam[np.hypot(flat[:, 0], flat[:, 1]) >= np.tan(self.half_field_rad)] = np.nan
        out: FloatArray = cam / np.linalg.norm(cam, axis=1, keepdims=True) @ self.dcm_cam_body
        return out

    def turned(self, rotation_cam_rad: FloatArray, focal_scale: float = 1.0, **other: Any) -> Camera:
        """Return this camera with the scene turned by a small rotation vector in camera axes and a scaled focal length.

        ``v_cam_new = exp(rotation) v_cam``: a positive rotation about camera y (down) moves the scene to the right.
        Other fields are replaced by those that are given.
        """
        axes = self._turned_axes(rotation_cam_rad)
        return replace(self, dcm_cam_body=axes, focal_px=self.focal_px * focal_scale, **other)

    def terms_of_turned(
        self, rotation_cam_rad: FloatArray, focal_scale: FloatArray, *, centre_px: FloatArray, distortion: FloatArray,
        position_body_m: FloatArray,
    ) -> LensTerms:  # fmt: skip
        """`lens_terms` of many cameras, as `turned` makes one of each row of its arguments, without their checks.

        Parameters
        ----------
        rotation_cam_rad : (m, 3) float
        focal_scale : (m,) float
        centre_px : (m, 2) float
        distortion : (m, k) float
        position_body_m : (m, 3) float
        """
        half, focal = one_to_one_half_angle_rad(distortion, self.lens), self.focal_px * focal_scale[:, None]
        axes, model = self._turned_axes(rotation_cam_rad), LENSES.index(self.lens)
        return model, half, focal, centre_px, _five(distortion), position_body_m, axes

    def _turned_axes(self, rotation_cam_rad: FloatArray) -> FloatArray:
        turn = rotations.dcm_from_q(rotations.exp(np.asarray(rotation_cam_rad, dtype=float)))
        return np.asarray(turn @ self.dcm_cam_body)

    def sampled(self, samples: int) -> Camera:
        """Return this camera with each pixel divided into ``samples`` by ``samples``, centred on the pixel's middle."""
        return replace(
            self, width_px=samples * self.width_px, height_px=samples * self.height_px,
            focal_px=samples * self.focal_px, centre_px=samples * self.centre_px + 0.5 * (samples - 1),
        )  # fmt: skip


def camera_from_mount(mount: CameraMount) -> Camera:
    """Build the nominal camera of a mount.

    The optical axis leans ``axis_from_forward_deg`` from body +x outwards in the camera's clocking plane. The picture
    stands upright like a view to a horizon: **up is outboard and aft**, so the sky is above the shell's rim, the aft
    face of the shell below it and the centerbody at the lower border. Looking forward so, **left is increasing
    clocking angle**, and a rim that moves aft, towards the camera, moves up in the picture (towards smaller rows).
    ``roll_deg`` turns the camera about its axis, clockwise as it looks: at 180 deg it is mounted upside down.
    """
    lean = np.deg2rad(mount.axis_from_forward_deg)
    outboard = lv_direction(np.deg2rad(mount.clock_lv_deg))
    forward = np.array([1.0, 0.0, 0.0])
    z_cam = np.cos(lean) * forward + np.sin(lean) * outboard
    down = np.sin(lean) * forward - np.cos(lean) * outboard
    roll, right = np.deg2rad(mount.roll_deg), np.cross(down, z_cam)
    y_cam = np.cos(roll) * down - np.sin(roll) * right
    return Camera(
        width_px=mount.width_px,
        height_px=mount.height_px,
        focal_px=np.array(mount.focal_px),
        centre_px=np.array(mount.centre_px),
        distortion=np.array(mount.distortion),
        position_body_m=mount.position_m,
        dcm_cam_body=np.stack([np.cross(y_cam, z_cam), y_cam, z_cam]),
        lens=mount.lens,
    )


def lens_distance(angle_rad: FloatArray, distortion: FloatArray) -> FloatArray:
    """Distance from the principal point, in focal lengths, of rays at an angle from the optical axis."""
    a2 = np.square(angle_rad)
    k1, k2, k3, k4 = distortion
    out: FloatArray = angle_rad * (1.0 + a2 * (k1 + a2 * (k2 + a2 * (k3 + a2 * k4))))
    return out


def _lens_slope(angle_rad: FloatArray | float, distortion: FloatArray) -> FloatArray:
    a2 = np.square(angle_rad)
    k1, k2, k3, k4 = distortion
    out: FloatArray = 1.0 + a2 * (3 * k1 + a2 * (5 * k2 + a2 * (7 * k3 + a2 * 9 * k4)))
    return out


def _five(distortion: FloatArray) -> FloatArray:
    """Coefficients (..., 5) of a lens that may have fewer."""
    out = np.zeros((*distortion.shape[:-1], 5))
    out[..., : distortion.shape[-1]] = distortion
    return out


def _slopes(distance: FloatArray, radial: list[int]) -> FloatArray:
    """Derivative of a lens's slope by each coefficient (5,); ``radial``: indices of the coefficients of even powers."""
    out = np.zeros((5, len(distance)))
    for half_power, row in enumerate(radial, start=1):
        out[row] = (2 * half_power + 1) * distance ** (2 * half_power)
    return out


_SLOPES = {"fisheye": _slopes(_ANGLES_RAD, [0, 1, 2, 3]), "pinhole": _slopes(np.tan(_ANGLES_RAD), [0, 1, 4])}


def one_to_one_half_angle_rad(distortion: FloatArray, lens: Lens = "fisheye") -> FloatArray:
    """Largest angles (...) from the optical axis up to which lenses spread what they see, at most 89 deg, rad.

    ``distortion``: (..., k).
    """
    falling = 1.0 + _five(distortion) @ _SLOPES[lens] <= 1e-3
    before = _ANGLES_RAD[np.maximum(falling.argmax(axis=-1) - 1, 0)]
    return np.where(falling.any(axis=-1), before, WIDEST_HALF_ANGLE_RAD)


def angle_from_lens_distance(distance: FloatArray, distortion: FloatArray, half_field_rad: float) -> FloatArray:
    """Invert `lens_distance` by Newton's method, rad; NaN beyond ``half_field_rad``."""
    reachable = distance < lens_distance(np.array(half_field_rad), distortion)
    angle = np.clip(distance, 0.0, half_field_rad)
    for _ in range(12):
        step = (lens_distance(angle, distortion) - distance) / _lens_slope(angle, distortion)
        angle = np.clip(angle - step, 0.0, half_field_rad)
        if np.abs(step[reachable]).max(initial=0.0) < 1e-14:
            break
    return np.where(reachable, angle, np.nan)
