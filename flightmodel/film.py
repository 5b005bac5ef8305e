"""Onboard video: when each frame was taken, and its picture, from a folder of images or from a film.

A list ``frames.csv`` gives the time of every frame, and either an image's file name or the frame's number in the film,
counted from zero: the clock of a film is not trusted. Frames are decoded one at a time, a film from its beginning on,
so that memory does not grow with their number; what cannot be decoded is an empty picture, for whoever looks at it to
refuse by name.

How far and how wide an edge or a feature is looked for, and how far it may lie off, are pixels: limits that hold for
films of 140 to 410 px a radian, as measured. Pictures of a finer camera are reduced to such a size (`working_camera`):
with 830 px a radian the same films err by 0.02 deg as read at 310, and as they are lose the edge at large deflections.

Text burnt into a film (`burnt_in`), a time code or a title, and dead lines of a detector are not looked at. What is
written over a picture stays where it is and as bright as it is, whatever the vehicle and its light do. Taken
for paint, it would say that the shell did not move. Over frames spread along the film a pixel of it

- keeps its grey level: in four of five frames it lies within `_STEADY` of the median, and
- stands out: the median's slope is `_SHARP` at least.

Digits that change do neither: a group of steady pixels as tall as a line of text is widened along its row by
`_BESIDE_HEIGHTS` of its height to both sides. Other groups are what is fixed to the camera, and left out as they are.

Rows and columns that keep their levels where what is around them does not are left out in any case.

Assumed: the picture moves, or its light changes. Where most of what else stands out is steady, nothing is taken for
text.
"""

from __future__ import annotations

import os
import sys
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
import PIL.Image
from numpy.typing import NDArray

from flightmodel.camera_edits import NO_EDITS, CameraEdits
from flightmodel.checks import NO_FAULT, BoolArray, FloatArray, Issue
from flightmodel.files import PICTURE_BYTES, unfit
from flightmodel.vehicle import CameraMount

Image = NDArray[np.uint8]

# read at the first film: what cannot be decoded is reported by frame; decoders' own lines on standard error add nothing
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
PNG_START, PNG_END = b"\x89PNG\r\n\x1a\n", b"IEND\xaeB`\x82"
WEBM_START = b"\x1aE\xdf\xa3"
PICTURE_KINDS = ("PNG", "JPEG", "BMP", "TIFF", "WEBP")
FILM_SUFFIXES = (".webm", ".mp4", ".avi")
UNKNOWN_FILM = f"cannot be opened as a film (known are {', '.join(FILM_SUFFIXES)})"
_SPREAD = 9  # frames over a film
_FINEST, _REDUCED = 410.0, 310.0  # px a radian
NO_PICTURE: Image = np.zeros((0, 0), dtype=np.uint8)
_STEADY = 6  # grey levels: noise, and compression at a stroke's edge
# grey levels a pixel: of fourteen films without text at most 65 pixels stand out so and are steady, with text 1200
_SHARP = 20.0
_LEAST_PX = 100  # steady pixels of a group: a word of strokes
_JOINED_PX = 9  # between strokes and letters of a line
_TALLEST = 0.15  # of the picture's height: a line of text
_BESIDE_HEIGHTS = 4.0
_MOST_STEADY = 0.8  # of what stands out in a frame
# of a row's or column's pixels: steady ones, by chance a third, among those whose surroundings are not, which are at
# least so many; as far as a patch of texture reaches
_LINE, _LINE_SEEN, _AROUND_PX, _LINE_BESIDE_PX = 0.8, 0.1, 9, 8
_LEAST_FRAMES = 5


@dataclass(frozen=True, eq=False)  # one object is itself: what is found of it can be looked up by it
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
    held : tuple of (h, w) uint8
        Grey pictures in memory, which stand for files; empty where ``paths`` names these.
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
    held: tuple[Image, ...] = ()

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
                yield self._given(self.held[k] if self.held else read_image(self.paths[k]))
            return
        yield from map(self._given, film_frames(self.paths[0], [int(self.numbers[k]) for k in wanted]))

    def _given(self, picture: Image) -> Image:
        """Reduce a picture of the film's expected size; others are returned unchanged, for the caller to refuse."""
        if self.filed_px is None or picture.shape[::-1] != self.filed_px:
            return picture
        return np.asarray(cv2.resize(picture, self.camera.size_px, interpolation=cv2.INTER_AREA), dtype=np.uint8)

    @cached_property
    def burnt_in(self) -> BoolArray | None:
        """Where the picture (h, w) is the same in every frame, as a time code is; None: nowhere."""
        chosen = np.unique(np.linspace(0, len(self.time_s) - 1, _SPREAD).round().astype(int))
        filed_px = self.filed_px or self.camera.size_px
        if self.held:
            return burnt_in([self._given(self.held[k]) for k in chosen])
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
    """Camera to which a film's pictures are reduced: itself, or a smaller one if it has more pixels per radian."""
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


def frame_times_ms(path: Path) -> list[float]:
    """Time of every frame of a film that can be decoded, by its container, ms; the whole film is decoded."""
    film, times = cv2.VideoCapture(str(path)), []
    try:
        while film.grab():
            times.append(film.get(cv2.CAP_PROP_POS_MSEC))
    finally:
        film.release()
    return times


def _grey(picture: NDArray[np.uint8]) -> Image:
    if picture.ndim == 3:
        return np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY), dtype=np.uint8)
    return picture


def film_timing_fault(path: Path) -> Issue:
    """Say why frame numbers of a film may be off; empty where every frame that it counts can be decoded.

    A frame that cannot be decoded is stepped over without a word, and every later one then has a number less. What
    gives it away is the file's own count of frames (WebM's is its length times its rate), or a jump in its times. The
    whole film is decoded.
    """
    film, times = cv2.VideoCapture(str(path)), frame_times_ms(path)
    counts = round(film.get(cv2.CAP_PROP_FRAME_COUNT))
    film.release()
    with path.open("rb") as file:
        estimated = file.read(4) == WEBM_START
    remedy = "numbers in the list may name later pictures; extract the frames as images, or check the list"
    if counts > 0 and not (len(times) >= counts - 1 if estimated else len(times) == counts):
        words = f"{len(times)} frames can be decoded where the film's own count is {counts}"
        return Issue(f"{words}: is the file whole? If it is, {remedy}", "film-count")
    if len(times) < 3:
        return NO_FAULT
    step = np.diff(times)
    step = np.append(times[0] + np.median(step), step)  # the first frame's time is 0
    uneven = np.flatnonzero(np.abs(step - np.median(step)) > 0.5 * np.median(step))
    if len(uneven):
        where = f"{1e-3 * times[uneven[0]]:.3f} s into the film, before its frame {uneven[0]}"
        return Issue(
            f"time jumps {where} ({len(uneven)} such jumps): a frame lost or an uneven rate; {remedy}", "film-rate"
        )
    return NO_FAULT


def start_fault(path: Path) -> Issue:
    """Return why a file is not a film, judged by its first bytes; empty if it is one."""
    if fault := unfit(path, sys.maxsize):  # it is decoded frame by frame
        return fault
    if path.stat().st_size == 0:
        return Issue("is empty", "file-unreadable")
    with path.open("rb") as file:
        start = file.read(12)
    # by content: a list of other places to play from would be opened too
    if not (start[:4] == WEBM_START or start[4:8] == b"ftyp" or (start[:4] == b"RIFF" and start[8:12] == b"AVI ")):
        return Issue(UNKNOWN_FILM, "file-unreadable")
    return NO_FAULT


def film_fault(path: Path, size_px: tuple[int, int], last_number: int) -> str:
    """Return why a film cannot be used by a camera of a picture size; empty if it can."""
    if fault := start_fault(path):
        return fault
    film = cv2.VideoCapture(str(path))
    try:
        if not film.isOpened():
            return Issue(
                f"{UNKNOWN_FILM}; if it is one, it is cut off (an .mp4 has its index at its end)", "file-unreadable"
            )
        width, height = (round(film.get(key)) for key in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
        if (width, height) != size_px:
            return Issue(f"is {width} x {height} pixels, the camera {size_px[0]} x {size_px[1]}", "frame-size")
        count = round(film.get(cv2.CAP_PROP_FRAME_COUNT))
        if 0 < count <= last_number:
            return Issue(f"has {count} frames; the list asks for frame {last_number} (the first is 0)", "frame-missing")
        if not film.grab():
            return Issue("holds no frame that can be decoded", "file-unreadable")
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
        return Issue(f"has far more pixels than the camera's {size_px[0]} x {size_px[1]}", "frame-size")
    except (OSError, ValueError, SyntaxError):
        return Issue(f"cannot be decoded as an image (known are {', '.join(PICTURE_KINDS)})", "file-unreadable")
    if sorted(size) == sorted(size_px) and not _is_whole_png(path):  # a rotated JPEG has that in its metadata
        height, width = read_image(path).shape
        if height == 0:
            return Issue("cannot be decoded as an image", "file-unreadable")
        size = (width, height)
    if size != size_px:
        return Issue(f"is {size[0]} x {size[1]} pixels, the camera {size_px[0]} x {size_px[1]}", "frame-size")
    return ""


def _is_whole_png(path: Path) -> bool:
    data = path.read_bytes()
    return data[:8] == PNG_START and data.rstrip(b"\0")[-8:] == PNG_END


def burnt_in(pictures: Sequence[NDArray[np.uint8]]) -> BoolArray | None:
    """Mask (h, w) of burnt-in text and other pixels that are fixed in the picture; None if there are none.

    Parameters
    ----------
    pictures : sequence of (h, w) uint8
        Spread over the film; only those of the most common size count.
    """
    sizes = [p.shape for p in pictures if p.ndim == 2 and p.size]
    film = np.stack([p for p in pictures if p.shape == max(set(sizes), key=sizes.count)]) if sizes else np.zeros(0)
    if len(film) < _LEAST_FRAMES:
        return None
    middle = np.sort(film, axis=0)[len(film) // 2]
    swing = np.sort(np.abs(film.astype(np.int16) - middle), axis=0)[(4 * len(film)) // 5 - 1]
    out = _dead_lines(swing)
    steady = (_slope(middle) > _SHARP) & (swing <= _STEADY) & ~out
    if steady.sum() <= _MOST_STEADY * np.sum((_slope(film[len(film) // 2]) > _SHARP) & ~out):
        out |= _groups(steady)
    return out if out.any() else None


def _dead_lines(swing: NDArray[np.int16]) -> BoolArray:
    """Mask (h, w) of rows and columns that stay constant while their surroundings change, with their neighbours."""
    out = np.zeros(swing.shape, dtype=np.bool_)
    brush = np.ones(2 * _LINE_BESIDE_PX + 1)
    for along, across in ((0, 1), (1, 0)):
        side = np.ones((1, _AROUND_PX) if across else (_AROUND_PX, 1))
        # on both sides: sky beside a rim that moves is steady too
        before, after = (cv2.dilate(swing, side, anchor=(k, 0) if across else (0, k)) for k in (0, _AROUND_PX - 1))
        lively = np.minimum(before, after) > 3 * _STEADY
        count = lively.sum(axis=along)
        kept = np.sum(lively & (swing <= _STEADY), axis=along)
        dead = (count > _LINE_SEEN * swing.shape[along]) & (kept > _LINE * count)
        np.moveaxis(out, across, 0)[np.convolve(dead, brush, "same") > 0.0] = True
    return out


def _slope(picture: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Size of the slope (h, w), grey levels a pixel."""
    across, down = (cv2.Sobel(picture, cv2.CV_32F, *order, scale=0.125) for order in ((1, 0), (0, 1)))
    return np.asarray(np.hypot(across, down))


def _groups(steady: BoolArray) -> BoolArray:
    """Mask (h, w) of groups of nearby steady pixels with the gaps between them; lines of text are extended sideways."""
    brush = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * _JOINED_PX + 1,) * 2)
    near = cv2.dilate(steady.astype(np.uint8), brush)
    count, label, boxes, _ = cv2.connectedComponentsWithStats(near)
    out = np.zeros_like(steady)
    for number in range(1, count):
        group = label == number
        if np.sum(steady & group) < _LEAST_PX:
            continue
        left, top, wide, tall, _ = boxes[number]
        out |= group
        if tall - 2 * _JOINED_PX < _TALLEST * len(steady) and wide > tall:
            reach = int(_BESIDE_HEIGHTS * (tall - 2 * _JOINED_PX))
            out[top : top + tall, max(left - reach, 0) : left + wide + reach] = True
    return out
