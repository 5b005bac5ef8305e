"""Onboard video: when each frame was taken, and its picture, from a folder of images or from a film.

A list ``frames.csv`` gives the time of every frame, and either an image's file name or the frame's number in the film,
counted from zero: the clock of a film is not trusted. Frames are decoded one at a time, a film from its beginning on,
so that memory does not grow with their number; what cannot be decoded is an empty picture, for whoever looks at it to
refuse by name.

How far and how wide an edge or a feature is looked for, and how far it may lie off, are pixels: limits that hold for
films of 140 to 410 px a radian, as measured. Pictures of a finer camera are reduced to such a size (`working_camera`):
with 830 px a radian the same films err by 0.02 deg as read at 310, and as they are lose the edge at large deflections.
"""

from __future__ import annotations

import os
import sys
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
import PIL.Image
from numpy.typing import NDArray

from flightmodel.burnt_in import burnt_in
from flightmodel.camera_edits import NO_EDITS, CameraEdits
from flightmodel.checks import NO_FAULT, BoolArray, Fault, FloatArray
from flightmodel.files import PICTURE_BYTES, unfit
from flightmodel.vehicle import CameraMount

Image = NDArray[np.uint8]

# read at the first film: what cannot be decoded is reported by frame; decoders' own lines on standard error add nothing
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
PNG_START, PNG_END = b"\x89PNG\r\n\x1a\n", b"IEND\xaeB`\x82"
WEBM_START = b"\x1aE\xdf\xa3"
PICTURE_KINDS = ("PNG", "JPEG", "BMP", "TIFF", "WEBP")
UNKNOWN_FILM = "cannot be opened as a film (known are .webm, .mp4 and .avi)"
_SPREAD = 9  # frames over a film
_FINEST, _REDUCED = 410.0, 310.0  # px a radian
NO_PICTURE: Image = np.zeros((0, 0), dtype=np.uint8)


@dataclass(frozen=True)
class Frames:
    """Onboard video; decoded only when asked for.

    Parameters
    ----------
    camera : CameraMount
        As pictures are given; see `working_camera`.
    camera_name : str
    time_s : (n,) float
        Seconds after t0, increasing.
    paths : tuple of Path
        Of each frame's image, or the film alone.
    benchmark_s : float
        When the deflection is taken as zero.
    numbers : (n,) int or None
        Of each frame in the film; None for images.
    time_bias_sd_s : float
        How well the film's clock is known against the gyros', one standard deviation; zero: it is taken as right.
    edits : CameraEdits
        What an analyst decided by eye; places in pictures as they are given.
    filed_px : (2,) int or None
        Width and height of the pictures in their files, where they are reduced.
    """

    camera: CameraMount
    camera_name: str
    time_s: FloatArray
    paths: tuple[Path, ...]
    benchmark_s: float
    numbers: NDArray[np.int64] | None = None
    time_bias_sd_s: float = 0.0
    edits: CameraEdits = NO_EDITS
    filed_px: tuple[int, int] | None = None

    @property
    def benchmark(self) -> int:
        """Index of the frame nearest to the benchmark time."""
        return int(np.argmin(np.abs(self.time_s - self.benchmark_s)))

    def picture(self, index: int) -> Image:
        """Grey picture ``(h, w)`` of a frame; empty where it cannot be decoded."""
        return next(self.pictures([index]))

    def pictures(self, indices: list[int] | None = None) -> Iterator[Image]:
        """Grey pictures of frames, in the order of ``indices``, which must increase; of all frames without."""
        wanted = list(range(len(self.time_s))) if indices is None else indices
        if self.numbers is None:
            for k in wanted:
                yield self._given(read_image(self.paths[k]))
            return
        yield from map(self._given, film_frames(self.paths[0], [int(self.numbers[k]) for k in wanted]))

    def _given(self, picture: Image) -> Image:
        """Reduce a picture of the size that the film's should have; others stay for whoever looks to refuse."""
        if self.filed_px is None or picture.shape[::-1] != self.filed_px:
            return picture
        return np.asarray(cv2.resize(picture, self.camera.size_px, interpolation=cv2.INTER_AREA), dtype=np.uint8)

    @cached_property
    def burnt_in(self) -> BoolArray | None:
        """Where the picture (h, w) is the same in every frame, as a time code is; None: nowhere."""
        chosen = np.unique(np.linspace(0, len(self.time_s) - 1, _SPREAD).round().astype(int))
        filed_px = self.filed_px or self.camera.size_px
        if self.numbers is None:
            # a folder is checked before all of it was found fit
            fit = [self.paths[k] for k in chosen if not image_fault(self.paths[k], filed_px)]
            return burnt_in([self._given(read_image(path)) for path in fit])
        if film_fault(self.paths[0], filed_px, int(self.numbers[-1])):
            return None
        film, pictures = cv2.VideoCapture(str(self.paths[0])), []
        try:
            for number in self.numbers[chosen]:
                # where a film seeks to a frame beside, that one does as well
                film.set(cv2.CAP_PROP_POS_FRAMES, float(number))
                good, picture = film.read()
                pictures.append(self._given(_grey(picture)) if good else NO_PICTURE)
        finally:
            film.release()
        return burnt_in(pictures)


def working_camera(camera: CameraMount) -> CameraMount:
    """Camera as whose pictures a film is read: itself, or a smaller one where it has more pixels a radian."""
    most = max(camera.focal_px)
    if most <= _FINEST:
        return camera
    width, height = (round(size * _REDUCED / most) for size in camera.size_px)
    return camera.resized((width, height))


def read_image(path: Path) -> Image:
    """Grey picture ``(h, w)`` of an image file; empty where it cannot be decoded."""
    try:
        image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    except cv2.error:  # more pixels than OpenCV takes
        image = None
    return NO_PICTURE if image is None else np.asarray(image, dtype=np.uint8)


def film_frames(path: Path, numbers: list[int]) -> Iterator[Image]:
    """Grey pictures of a film's frames by number, which must not decrease; empty ones behind its end."""
    film = cv2.VideoCapture(str(path))
    try:
        at, last = -1, NO_PICTURE
        for number in numbers:
            while at < number:
                at += 1
                if not film.grab():
                    at, last = number, NO_PICTURE
                    break
                if at == number:
                    good, picture = film.retrieve()
                    last = _grey(picture) if good else NO_PICTURE
            yield last
    finally:
        film.release()


def _grey(picture: NDArray[np.uint8]) -> Image:
    if picture.ndim == 3:
        return np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY), dtype=np.uint8)
    return picture


def film_timing_fault(path: Path) -> Fault:
    """Say why frame numbers of a film may be off; empty where every frame that it counts can be decoded.

    A frame that cannot be decoded is stepped over without a word, and every later one then has a number less. What
    gives it away is the file's own count of frames (WebM's is its length times its rate), or a jump in its times. The
    whole film is decoded.
    """
    film = cv2.VideoCapture(str(path))
    try:
        counts = round(film.get(cv2.CAP_PROP_FRAME_COUNT))
        with path.open("rb") as file:
            estimated = file.read(4) == WEBM_START
        times = []
        while film.grab():
            times.append(film.get(cv2.CAP_PROP_POS_MSEC))
    finally:
        film.release()
    remedy = "numbers in the list may name later pictures; extract the frames as images, or check the list"
    if counts > 0 and not (len(times) >= counts - 1 if estimated else len(times) == counts):
        return Fault(
            f"{len(times)} frames can be decoded where the film's own count is {counts}: {remedy}", "film-count"
        )
    if len(times) < 3:
        return NO_FAULT
    step = np.diff(times)
    step = np.append(times[0] + np.median(step), step)  # the first frame's time is 0
    uneven = np.flatnonzero(np.abs(step - np.median(step)) > 0.5 * np.median(step))
    if len(uneven):
        where = f"{1e-3 * times[uneven[0]]:.3f} s into the film, before its frame {uneven[0]}"
        return Fault(
            f"time jumps {where} ({len(uneven)} such jumps): a frame lost or an uneven rate; {remedy}", "film-rate"
        )
    return NO_FAULT


def film_fault(path: Path, size_px: tuple[int, int], last_number: int) -> str:
    """Say why a film of a camera with pictures of a size cannot be used; empty when it can."""
    if fault := unfit(path, sys.maxsize):  # it is decoded frame by frame
        return fault
    if path.stat().st_size == 0:
        return Fault("is empty", "file-empty")
    with path.open("rb") as file:
        start = file.read(12)
    # by content: a list of other places to play from would be opened too
    if not (start[:4] == WEBM_START or start[4:8] == b"ftyp" or (start[:4] == b"RIFF" and start[8:12] == b"AVI ")):
        return Fault(UNKNOWN_FILM, "film-unreadable")
    film = cv2.VideoCapture(str(path))
    try:
        if not film.isOpened():
            return Fault(
                f"{UNKNOWN_FILM}; if it is one, it is cut off (an .mp4 has its index at its end)", "film-unreadable"
            )
        width, height = (round(film.get(key)) for key in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
        if (width, height) != size_px:
            return Fault(f"is {width} x {height} pixels, the camera {size_px[0]} x {size_px[1]}", "image-size")
        count = round(film.get(cv2.CAP_PROP_FRAME_COUNT))
        if 0 < count <= last_number:
            return Fault(f"has {count} frames; the list asks for frame {last_number} (the first is 0)", "frame-missing")
        if not film.grab():
            return Fault("holds no frame that can be decoded", "film-unreadable")
    finally:
        film.release()
    return ""


def image_fault(path: Path, size_px: tuple[int, int]) -> str:
    """Say why an image file cannot be used; empty when it can. A whole PNG is not decoded for it.

    Its size is read from its head first: an image of another size than the camera's is never unpacked.
    """
    if fault := unfit(path, PICTURE_BYTES):
        return fault
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", PIL.Image.DecompressionBombWarning)
            with PIL.Image.open(path, formats=PICTURE_KINDS) as head:
                size = head.size
    except (PIL.Image.DecompressionBombWarning, PIL.Image.DecompressionBombError):
        return Fault(f"has far more pixels than the camera's {size_px[0]} x {size_px[1]}", "image-size")
    except (OSError, ValueError, SyntaxError):
        return Fault(f"cannot be decoded as an image (known are {', '.join(PICTURE_KINDS)})", "image-unreadable")
    if sorted(size) == sorted(size_px) and not _is_whole_png(path):  # a rotated JPEG has that in its metadata
        height, width = read_image(path).shape
        if height == 0:
            return Fault("cannot be decoded as an image", "image-unreadable")
        size = (width, height)
    if size != size_px:
        return Fault(f"is {size[0]} x {size[1]} pixels, the camera {size_px[0]} x {size_px[1]}", "image-size")
    return ""


def _is_whole_png(path: Path) -> bool:
    data = path.read_bytes()
    return data[:8] == PNG_START and data.rstrip(b"\0")[-8:] == PNG_END
