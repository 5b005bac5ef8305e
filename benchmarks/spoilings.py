"""Ways in which footage is not what the vehicle file says of it, each with a random strength from hardly to wholly.

A spoiling takes a `Footage` and gives another; the deflection at the frames' times, the truth, stays. `SHAPED` are
those that the camera's checks were made with; `HELD_BACK` were not.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]
Picture = Callable[[Image], Image]


@dataclass(frozen=True)
class Footage:
    """A film and what is stated of it.

    Parameters
    ----------
    time_s : (n,) float
    frames : list of (h, w) uint8
    theta_yz_rad : (n, 2) float
        True deflection, body y and z.
    geometry, camera : mapping
        Changes of the tables of the vehicle file.
    benchmark_s : float
    """

    time_s: NDArray[np.float64]
    frames: list[Image]
    theta_yz_rad: NDArray[np.float64]
    geometry: Mapping[str, Any] = field(default_factory=dict)
    camera: Mapping[str, Any] = field(default_factory=dict)
    benchmark_s: float = 421.0

    def with_pictures(self, change: Picture, which: NDArray[np.intp] | None = None) -> Footage:
        """Change some frames, all without ``which``."""
        chosen = set(range(len(self.frames)) if which is None else which.tolist())
        return replace(self, frames=[change(f) if k in chosen else f for k, f in enumerate(self.frames)])


Spoiling = Callable[[Footage, Footage, np.random.Generator], Footage]
"""From a film, another film to take frames from, and a generator."""


def between(rng: np.random.Generator, low: float, high: float) -> float:
    """A strength, uniform in its logarithm."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def warped(matrix: NDArray[np.float64]) -> Picture:
    """Picture moved by an affine map (2, 3), black where there was none."""
    return lambda f: np.asarray(cv2.warpAffine(f, matrix, f.shape[::-1], flags=cv2.INTER_CUBIC), dtype=np.uint8)


def _about_middle(footage: Footage, turn_deg: float, scale: float, shift: NDArray[np.float64]) -> NDArray[np.float64]:
    h, w = footage.frames[0].shape
    matrix = cv2.getRotationMatrix2D((0.5 * w, 0.5 * h), turn_deg, scale)
    matrix[:, 2] += shift
    return np.asarray(matrix)


def _stretch(footage: Footage, rng: np.random.Generator) -> NDArray[np.intp]:
    """Some frames in a row, not the first."""
    n = len(footage.frames)
    first = int(rng.integers(1, n - 1))
    return np.arange(first, min(n, first + int(rng.integers(2, n))))


def _later(footage: Footage, rng: np.random.Generator) -> NDArray[np.intp]:
    return np.arange(int(rng.integers(1, len(footage.frames) - 3)), len(footage.frames))


def _towards(rng: np.random.Generator, low: float, high: float) -> NDArray[np.float64]:
    angle, size = rng.uniform(0.0, 2.0 * np.pi), between(rng, low, high)
    return size * np.array([np.cos(angle), np.sin(angle)])


def _levels(change: Callable[[NDArray[np.float64]], NDArray[np.float64]]) -> Picture:
    return lambda f: np.clip(np.rint(change(f.astype(np.float64))), 0, 255).astype(np.uint8)


# ------------------------------------------------------------------------------------------------ the whole film alike


def cropped(footage: Footage, _: Footage, rng: np.random.Generator) -> Footage:
    """A part of every picture, brought to full size."""
    h, w = footage.frames[0].shape
    scale = 1.0 + between(rng, 0.02, 1.0)
    room = np.array([w, h]) * (1.0 - 1.0 / scale)
    corner = room * rng.uniform(0.0, 1.0, 2)
    matrix = np.column_stack([scale * np.eye(2), -scale * corner])
    return footage.with_pictures(warped(matrix))


def shifted(footage: Footage, _: Footage, rng: np.random.Generator) -> Footage:
    """All pictures moved alike."""
    return footage.with_pictures(warped(_about_middle(footage, 0.0, 1.0, _towards(rng, 2.0, 200.0))))


def turned(footage: Footage, _: Footage, rng: np.random.Generator) -> Footage:
    """All pictures rotated alike."""
    angle = between(rng, 1.0, 180.0) * rng.choice([-1.0, 1.0])
    return footage.with_pictures(warped(_about_middle(footage, angle, 1.0, np.zeros(2))))


def mirrored(footage: Footage, _: Footage, rng: np.random.Generator) -> Footage:
    """Mirrored, upside down, or both."""
    code = int(rng.integers(-1, 2))
    return footage.with_pictures(lambda f: np.asarray(cv2.flip(f, code), dtype=np.uint8))


def blurred(footage: Footage, _: Footage, rng: np.random.Generator) -> Footage:
    """Out of focus."""
    size = between(rng, 0.7, 15.0)
    return footage.with_pictures(lambda f: np.asarray(cv2.GaussianBlur(f, (0, 0), size), dtype=np.uint8))


def noisy(footage: Footage, _: Footage, rng: np.random.Generator) -> Footage:
    """White noise."""
    size = between(rng, 4.0, 120.0)
    return footage.with_pictures(_levels(lambda f: f + size * rng.standard_normal(f.shape)))


def overexposed(footage: Footage, _: Footage, rng: np.random.Generator) -> Footage:
    """Too bright."""
    gain = between(rng, 1.5, 20.0)
    return footage.with_pictures(_levels(lambda f: gain * f))


def dark(footage: Footage, _: Footage, rng: np.random.Generator) -> Footage:
    """Too dark."""
    gain = between(rng, 0.01, 0.6)
    return footage.with_pictures(_levels(lambda f: gain * f))


def inverted(footage: Footage, _: Footage, __: np.random.Generator) -> Footage:
    """A negative."""
    return footage.with_pictures(lambda f: np.asarray(255 - f, dtype=np.uint8))


def compressed(footage: Footage, _: Footage, rng: np.random.Generator) -> Footage:
    """JPEG of little quality."""
    quality = int(rng.integers(1, 30))

    def recoded(f: Image) -> Image:
        data = cv2.imencode(".jpg", f, [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
        return np.asarray(cv2.imdecode(data, cv2.IMREAD_GRAYSCALE), dtype=np.uint8)

    return footage.with_pictures(recoded)


def time_code(footage: Footage, _: Footage, rng: np.random.Generator) -> Footage:
    """Figures that change with every frame, on the picture."""
    h, w = footage.frames[0].shape
    at = (int(rng.uniform(0.0, 0.5) * w), int(rng.uniform(0.1, 1.0) * h))
    size, thick = between(rng, 0.8, 5.0), int(rng.integers(1, 8))
    box = bool(rng.integers(2))
    out = []
    for k, frame in enumerate(footage.frames):
        text, f = f"229:12:59:{footage.time_s[k] % 60.0:06.3f}", frame.copy()
        (wide, tall), low = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, size, thick)
        if box:
            cv2.rectangle(f, (at[0], at[1] - tall), (at[0] + wide, at[1] + low), 0, -1)
        cv2.putText(f, text, at, cv2.FONT_HERSHEY_SIMPLEX, size, 255, thick)
        out.append(f)
    return replace(footage, frames=out)


def hidden_rim(footage: Footage, _: Footage, rng: np.random.Generator) -> Footage:
    """A flap or a finger before the lens."""
    h, w = footage.frames[0].shape
    centre = (int(rng.uniform(0.0, 1.0) * w), int(rng.uniform(0.0, 0.8) * h))
    size = (int(between(rng, 20.0, 400.0)), int(between(rng, 20.0, 250.0)))
    turn, grey = rng.uniform(0.0, 180.0), int(rng.integers(0, 256))

    def over(f: Image) -> Image:
        f = f.copy()
        cv2.ellipse(f, centre, size, turn, 0.0, 360.0, grey, -1)
        return f

    return footage.with_pictures(over)


def wrong_lens(footage: Footage, _: Footage, rng: np.random.Generator) -> Footage:
    """Another lens stated than it was filmed through."""
    factor = np.exp(rng.choice([-1.0, 1.0]) * between(rng, 0.03, 0.6))
    focal = 310.0 * factor
    lens = [-0.012 + 0.1 * rng.standard_normal(), 0.004 + 0.03 * rng.standard_normal(), -0.0015, 0.0002]
    kind = str(rng.choice(["fisheye", "fisheye", "pinhole"]))
    return replace(footage, camera={"focal_px": [focal, focal], "distortion": lens, "lens": kind})


def wrong_place(footage: Footage, _: Footage, rng: np.random.Generator) -> Footage:
    """Another mount stated than the camera had."""
    return replace(footage, camera={
        "station_m": 1.40 + between(rng, 0.01, 0.5) * rng.choice([-1.0, 1.0]),
        "clock_lv_deg": 153.0 + between(rng, 1.0, 180.0) * rng.choice([-1.0, 1.0]),
        "axis_from_forward_deg": 42.0 + 10.0 * rng.standard_normal(),
    })  # fmt: skip


def other_outline(footage: Footage, _: Footage, rng: np.random.Generator) -> Footage:
    """Another shell stated than was flown."""
    count = int(rng.choice([5, 6, 8]))
    ways: list[dict[str, Any]] = [
        {"half_angle_deg": 60.0 + float(rng.choice([-1.0, 1.0])) * between(rng, 1.0, 15.0)},
        {"torus_count": count, "base_radius_m": 1.5 + (count - 7) * 0.19},
        {"innermost_torus_radius_m": 0.247 + between(rng, 0.01, 0.2), "base_radius_m": 1.7},
        {"torus_minor_radius_m": 0.11 * between(rng, 0.7, 0.95)},
    ]
    return replace(footage, geometry={**footage.geometry, **ways[int(rng.integers(len(ways)))]})


def other_benchmark(footage: Footage, _: Footage, rng: np.random.Generator) -> Footage:
    """A frame under load taken as undeflected."""
    return replace(footage, benchmark_s=float(footage.time_s[int(rng.integers(1, len(footage.frames)))]))


# ------------------------------------------------------------------------------------------------- a part of the film


def bumped(footage: Footage, _: Footage, rng: np.random.Generator) -> Footage:
    """A camera that moves in its mount at some time."""
    matrix = _about_middle(footage, float(rng.normal(0.0, 2.0)), 1.0, _towards(rng, 1.0, 60.0))
    return footage.with_pictures(warped(matrix), _later(footage, rng))


def black(footage: Footage, _: Footage, rng: np.random.Generator) -> Footage:
    """No signal for a while."""
    grey = int(rng.choice([0, 0, 16, 128, 255]))
    return footage.with_pictures(lambda f: np.full_like(f, grey), _stretch(footage, rng))


def frozen(footage: Footage, _: Footage, rng: np.random.Generator) -> Footage:
    """One picture for a while."""
    which = _stretch(footage, rng)
    return footage.with_pictures(lambda _: footage.frames[which[0] - 1], which)


def interlaced(footage: Footage, _: Footage, rng: np.random.Generator) -> Footage:
    """Every other row of the frame before."""
    first = int(rng.integers(2))
    out = [f.copy() for f in footage.frames]
    for k in range(1, len(out)):
        out[k][first::2] = footage.frames[k - 1][first::2]
    return replace(footage, frames=out)


def foreign(footage: Footage, other: Footage, rng: np.random.Generator) -> Footage:
    """Pictures of another film for a while."""
    which = _stretch(footage, rng).tolist()
    n = len(other.frames)
    frames = [other.frames[(k + 3) % n] if k in which else f for k, f in enumerate(footage.frames)]
    return replace(footage, frames=frames)


def reordered(footage: Footage, _: Footage, rng: np.random.Generator) -> Footage:
    """Frames of a stretch in another order."""
    which = _stretch(footage, rng)
    order = np.arange(len(footage.frames))
    order[which] = rng.permutation(which) if rng.integers(2) else which[::-1]
    return replace(footage, frames=[footage.frames[k] for k in order])


# ------------------------------------------------------------------------------------------------------ held back


def zoomed(footage: Footage, _: Footage, rng: np.random.Generator) -> Footage:
    """A lens that changes its focal length at some time."""
    scale = 1.0 + rng.choice([-1.0, 1.0]) * between(rng, 0.003, 0.2)
    return footage.with_pictures(warped(_about_middle(footage, 0.0, scale, np.zeros(2))), _later(footage, rng))


def wobbling(footage: Footage, _: Footage, rng: np.random.Generator) -> Footage:
    """A mount that shakes: every frame moved otherwise."""
    size = between(rng, 0.5, 20.0)

    def shaken(f: Image) -> Image:
        return warped(_about_middle(footage, float(rng.normal(0.0, 0.05 * size)), 1.0, size * rng.standard_normal(2)))(
            f
        )

    return footage.with_pictures(shaken, np.arange(1, len(footage.frames)))


def torn(footage: Footage, _: Footage, rng: np.random.Generator) -> Footage:
    """Rows that slip sideways, as with a lost synchronisation."""
    size = between(rng, 1.0, 60.0)

    def slipped(f: Image) -> Image:
        step = np.cumsum(rng.standard_normal(len(f))) * size / np.sqrt(len(f))
        return np.stack([np.roll(row, round(s)) for row, s in zip(f, step, strict=True)])

    return footage.with_pictures(slipped, _stretch(footage, rng))


def rolled(footage: Footage, _: Footage, rng: np.random.Generator) -> Footage:
    """A picture that rolls vertically."""
    return footage.with_pictures(
        lambda f: np.roll(f, int(rng.integers(1, len(f))), axis=0), _stretch(footage, rng)
    )  # fmt: skip


def flapping(footage: Footage, _: Footage, rng: np.random.Generator) -> Footage:
    """A strap before the lens that moves from frame to frame."""
    h, w = footage.frames[0].shape
    wide, grey = int(between(rng, 4.0, 150.0)), int(rng.integers(0, 256))

    def strapped(f: Image) -> Image:
        ends = [(int(rng.uniform(0, w)), int(rng.uniform(0, h))) for _ in range(2)]
        return np.asarray(cv2.line(f.copy(), ends[0], ends[1], grey, wide), dtype=np.uint8)

    return footage.with_pictures(strapped)


def glare(footage: Footage, _: Footage, rng: np.random.Generator) -> Footage:
    """The Sun in the lens: a disc at full scale, and a veil."""
    h, w = footage.frames[0].shape
    size, veil = between(rng, 20.0, 300.0), rng.uniform(0.0, 150.0)
    v, u = np.mgrid[:h, :w]

    def lit(f: NDArray[np.float64]) -> NDArray[np.float64]:
        away = np.hypot(u - rng.uniform(0, w), v - rng.uniform(0, h))
        return np.asarray(f + 400.0 * np.exp(-((away / size) ** 2)) + veil)

    return footage.with_pictures(_levels(lit), _stretch(footage, rng))


def ghost(footage: Footage, _: Footage, rng: np.random.Generator) -> Footage:
    """Two frames in one."""
    share, back = rng.uniform(0.1, 0.9), int(rng.integers(1, 8))
    out = [cv2.addWeighted(f, 1.0 - share, footage.frames[max(k - back, 0)], share, 0.0)
           for k, f in enumerate(footage.frames)]  # fmt: skip
    return replace(footage, frames=[np.asarray(f, dtype=np.uint8) for f in out])


def lost_blocks(footage: Footage, _: Footage, rng: np.random.Generator) -> Footage:
    """Blocks of the picture that stay as they were before, or lie elsewhere."""
    share, size = between(rng, 0.02, 0.95), int(rng.choice([16, 32, 64]))
    out = [f.copy() for f in footage.frames]
    for k in range(1, len(out)):
        h, w = out[k].shape
        source = out[k - 1] if rng.integers(2) else np.roll(out[k], size, axis=1)
        for top in range(0, h, size):
            for left in range(0, w, size):
                if rng.random() < share:
                    block = np.s_[top : top + size, left : left + size]
                    out[k][block] = source[block]
    return replace(footage, frames=out)


def few_levels(footage: Footage, _: Footage, rng: np.random.Generator) -> Footage:
    """Two to six grey levels."""
    step = 255.0 / int(rng.integers(1, 6))
    return footage.with_pictures(_levels(lambda f: step * np.rint(f / step)))


def drops(footage: Footage, _: Footage, rng: np.random.Generator) -> Footage:
    """A drop on the lens that bends the light."""
    h, w = footage.frames[0].shape
    v, u = np.mgrid[:h, :w].astype(np.float32)
    moved = [u.copy(), v.copy()]
    for _k in range(int(rng.integers(1, 5))):
        cu, cv = rng.uniform(0, w), rng.uniform(0, 0.7 * h)
        size, depth = between(rng, 30.0, 200.0), between(rng, 2.0, 40.0)
        bell = np.exp(-(((u - cu) / size) ** 2) - ((v - cv) / size) ** 2)
        for part, side in zip(moved, rng.standard_normal(2), strict=True):
            part += (depth * side * bell).astype(np.float32)
    return footage.with_pictures(
        lambda f: np.asarray(cv2.remap(f, moved[0], moved[1], cv2.INTER_LINEAR), dtype=np.uint8), _later(footage, rng)
    )


def skewed(footage: Footage, _: Footage, rng: np.random.Generator) -> Footage:
    """Another shape of the picture's pixels."""
    matrix = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    matrix[:, :2] += between(rng, 0.005, 0.2) * rng.standard_normal((2, 2))
    h, w = footage.frames[0].shape
    middle = 0.5 * np.array([w, h])
    matrix[:, 2] = middle - matrix[:, :2] @ middle
    return footage.with_pictures(warped(matrix))


def flickering(footage: Footage, _: Footage, rng: np.random.Generator) -> Footage:
    """Exposure that hunts."""
    size = between(rng, 0.1, 1.5)
    return footage.with_pictures(_levels(lambda f: f * np.exp(size * rng.standard_normal())))


SHAPED: dict[str, Spoiling] = {
    f.__name__: f
    for f in (
        cropped, shifted, turned, mirrored, blurred, noisy, overexposed, dark, inverted, compressed, time_code,
        hidden_rim, wrong_lens, wrong_place, other_outline, other_benchmark, bumped, black, frozen, interlaced, foreign,
        reordered,
    )
}  # fmt: skip
HELD_BACK: dict[str, Spoiling] = {
    f.__name__: f
    for f in (
        zoomed, wobbling, torn, rolled, flapping, glare, ghost, lost_blocks, few_levels, drops, skewed, flickering,
    )
}  # fmt: skip
# what a film shows at another time than its list says, or from another benchmark, is in no picture
NOT_IN_PICTURES = ("reordered", "other_benchmark")
