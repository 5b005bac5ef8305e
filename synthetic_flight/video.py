"""What would the onboard camera have filmed? Frames of the bent aeroshell, through a lens nobody told the estimator.

The picture is ray-marched (`synthetic_flight.shell_renderer`), not the estimator's projection; then come interlace and
motion, vignetting, blur, sensor noise and compression. The real lens and pointing are drawn once a flight
(`real_camera`), and so is how far the shell is out of shape, built and under load: an estimator that starts from the
nominal mount must orient itself and live with a shell that is not quite the drawing's.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from flightmodel.camera import Camera, camera_from_mount
from flightmodel.checks import FloatArray, check_finite, check_shape
from flightmodel.vehicle import CameraMount, ShellGeometry
from synthetic_flight.shell_renderer import Background, Float32, ShellRenderer, Warp

Image = NDArray[np.uint8]


@dataclass(frozen=True)
class Imaging:
    """How the real camera differs from its drawing, and how it records; one standard deviation where drawn.

    Parameters
    ----------
    pointing_sd_rad : float
        About each camera axis.
    focal_sd : float
        Fraction.
    centre_sd_px : float
        Of the principal point along u and v.
    k1_sd, k2_sd : float
        Of the lens's first coefficients.
    position_sd_m : float
        Along each body axis.
    noise_sd : float
        Of a pixel, in grey levels of 255.
    blur_px : float
        Standard deviation of the point-spread function.
    vignetting : float
        How much darker the lens is at right angles to its axis, share of one.
    interlace_s : float
        Time from the first field to the second, rows taken in turns; each is open for as long. Zero: the whole frame
        at once.
    quality : int
        Of JPEG compression, 1 to 100; zero: none.
    painted : bool
        Whether the shell carries seams and dots that can be seen.
    built_sd_rad, loaded_sd_rad : float
        Flattening of the shell as built, and under the largest load; saddle and lobes half of that each.
    """

    pointing_sd_rad: float = float(np.deg2rad(0.5))
    focal_sd: float = 0.01
    centre_sd_px: float = 1.0
    k1_sd: float = 0.003
    k2_sd: float = 0.0
    position_sd_m: float = 0.002
    noise_sd: float = 2.5
    blur_px: float = 0.8
    vignetting: float = 0.38
    interlace_s: float = 0.0
    quality: int = 0
    painted: bool = True
    built_sd_rad: float = 0.0
    loaded_sd_rad: float = 0.0


@dataclass(frozen=True)
class Scene:
    """What there is to film, frame by frame.

    Parameters
    ----------
    theta_rad, plane_lv_rad : (n,) float
        Bending.
    sun_body : (n, 3) float
        Unit vectors towards the Sun, body axes; zero vectors for darkness.
    nadir_body : (n, 3) float, optional
        Unit vectors to the ground; without them there is no Earth in view.
    altitude_m : (n,) float, optional
    load : (n,) float, optional
        Share of the largest dynamic pressure, for the shell's shape; zero without.
    bending_rate_yz_radps : (n, 2) float, optional
        Rate of ``theta`` as a lateral vector, for what moves between two fields.
    """

    theta_rad: FloatArray
    plane_lv_rad: FloatArray
    sun_body: FloatArray
    nadir_body: FloatArray | None = None
    altitude_m: FloatArray | None = None
    load: FloatArray | None = None
    bending_rate_yz_radps: FloatArray | None = None

    def __post_init__(self) -> None:
        """Check lengths and values once."""
        n = len(self.theta_rad)
        shapes = {"theta_rad": (n,), "plane_lv_rad": (n,), "sun_body": (n, 3), "nadir_body": (n, 3),
                  "altitude_m": (n,), "load": (n,), "bending_rate_yz_radps": (n, 2)}  # fmt: skip
        for name, shape in shapes.items():
            value = getattr(self, name)
            if value is not None:
                check_finite(f"scene.{name}", check_shape(f"scene.{name}", np.asarray(value, dtype=float), shape))


def real_camera(camera_mount: CameraMount, rng: np.random.Generator, imaging: Imaging | None = None) -> Camera:
    """Draw the camera as it really was built in: pointing, lens and position are off."""
    imaging = imaging or Imaging()
    nominal = camera_from_mount(camera_mount)
    draw = rng.standard_normal(10)
    lens = nominal.distortion.copy()
    lens[0] += imaging.k1_sd * draw[6]
    if imaging.k2_sd:
        lens[1] += imaging.k2_sd * rng.standard_normal()
    off = replace(
        nominal,
        centre_px=nominal.centre_px + imaging.centre_sd_px * draw[4:6],
        distortion=lens,
        position_body_m=nominal.position_body_m + imaging.position_sd_m * draw[7:10],
    )
    return off.turned(imaging.pointing_sd_rad * draw[:3], 1.0 + imaging.focal_sd * draw[3])


def film(
    vehicle_geometry: ShellGeometry,
    camera_mount: CameraMount,
    joint_station_m: float,
    scene: Scene,
    rng: np.random.Generator,
    imaging: Imaging | None = None,
) -> Iterator[Image]:
    """Film a scene.

    Parameters
    ----------
    vehicle_geometry : ShellGeometry
    camera_mount : CameraMount
        Nominal; the real camera is drawn from ``rng`` first (`real_camera`).
    joint_station_m : float
        Joint aft of the nose, m.
    scene : Scene
    rng : numpy.random.Generator
        Of the camera's build, the shell's shape and the pixel noise.
    imaging : Imaging, optional

    Yields
    ------
    (height, width) uint8

    Raises
    ------
    GateError
        When lengths differ or a value is not finite.
    """
    imaging = imaging or Imaging()
    camera = real_camera(camera_mount, rng, imaging)
    renderer = ShellRenderer(vehicle_geometry, camera, joint_station_m, imaging.vignetting)
    renderer.stack.painted = imaging.painted
    built, loaded = _shapes(imaging, rng)

    def radiance(k: int, after_s: float) -> Float32:
        theta, plane = float(scene.theta_rad[k]), float(scene.plane_lv_rad[k])
        if after_s and scene.bending_rate_yz_radps is not None:
            lateral = theta * np.array([-np.cos(plane), np.sin(plane)]) + after_s * scene.bending_rate_yz_radps[k]
            theta, plane = float(np.hypot(*lateral)), float(np.arctan2(lateral[1], -lateral[0]))
        load = 0.0 if scene.load is None else float(scene.load[k])
        warp = None if built is None or loaded is None else built.plus(loaded.times(load))
        earth = None
        if scene.nadir_body is not None and scene.altitude_m is not None:
            earth = Background(scene.nadir_body[k], float(scene.altitude_m[k]))
        return renderer.radiance(theta, plane, scene.sun_body[k], warp, earth)

    def frames() -> Iterator[Image]:
        for k in range(len(scene.theta_rad)):
            if imaging.interlace_s:
                early, late = (radiance(k, side * 0.5 * imaging.interlace_s) for side in (-1.0, 1.0))
                # each field is open from its start to the other's: it moves while it is exposed
                picture = 0.75 * early + 0.25 * late
                picture[1::2] = 0.25 * early[1::2] + 0.75 * late[1::2]
            else:
                picture = radiance(k, 0.0)
            yield record(picture, renderer.vignetting, imaging, rng)

    return frames()


def render_video(
    vehicle_geometry: ShellGeometry,
    camera_mount: CameraMount,
    joint_station_m: float,
    theta_rad: FloatArray,
    plane_lv_rad: FloatArray,
    sun_direction_body: FloatArray,
    rng: np.random.Generator,
    imaging: Imaging | None = None,
) -> Iterator[Image]:
    """Film bendings in the light of the Sun alone; see `film` and `Scene`."""
    theta_rad = check_shape("theta_rad", theta_rad, (None,))
    scene = Scene(theta_rad, plane_lv_rad, sun_direction_body)
    return film(vehicle_geometry, camera_mount, joint_station_m, scene, rng, imaging)


def _shapes(imaging: Imaging, rng: np.random.Generator) -> tuple[Warp, Warp] | tuple[None, None]:
    """Draw how far the shell is out of shape, as built and under the largest load."""
    if not imaging.built_sd_rad and not imaging.loaded_sd_rad:
        return None, None
    share = np.array([1.0, 0.5, 0.5, 0.5])
    built, loaded = (
        Warp(*(sd * share * rng.standard_normal(4)).tolist()) for sd in (imaging.built_sd_rad, imaging.loaded_sd_rad)
    )
    return built, loaded


def record(radiance: Float32, vignetting: Float32, imaging: Imaging, rng: np.random.Generator) -> Image:
    """Turn scene radiance (one is full scale) into grey levels ``(h, w)``: vignetting, blur, noise, compression."""
    grey = cv2.GaussianBlur(radiance * (255.0 * vignetting), (0, 0), imaging.blur_px)
    grey += np.float32(imaging.noise_sd) * rng.standard_normal(grey.shape, dtype=np.float32)
    picture = np.asarray(cv2.convertScaleAbs(np.maximum(grey, 0.0, out=grey)), dtype=np.uint8)
    if imaging.quality:
        _, data = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, imaging.quality])
        picture = np.asarray(cv2.imdecode(data, cv2.IMREAD_GRAYSCALE), dtype=np.uint8)
    return picture
