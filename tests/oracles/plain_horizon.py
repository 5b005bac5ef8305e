"""Search for the shell's edge and for dark features in plain numpy: the compiled one is compared with it.

An edge is a step blurred by the lens, on a level that may slope behind it; its place is where the profile's projection
on the best of many such shapes is largest, refined by a parabola. A mark is a dip under the line between a profile's
ends; its place is the centroid of what it takes away of the light.
"""

import numpy as np
from scipy.ndimage import map_coordinates


def grey(image, u, v):
    """Bilinear grey level at columns ``u`` and rows ``v``; the border's beyond the picture."""
    return map_coordinates(image.astype(float), [np.atleast_1d(v), np.atleast_1d(u)], order=1, mode="nearest")


def best_place(profile, places, bases):
    """Place of the shape that explains most of a profile (m,), by a parabola over the three about it.

    Its curvature per px^2, and what the shape leaves of the profile.
    """
    explained = np.sum((bases @ profile) ** 2, axis=1)
    k = int(np.clip(np.argmax(explained), 1, len(places) - 2))
    low, mid, high = explained[k - 1 : k + 2]
    step, curve = places[1] - places[0], 2.0 * mid - low - high
    left = profile - bases[k].T @ (bases[k] @ profile)
    return places[k] + step * 0.5 * (high - low) / curve, curve / step**2, left


def dip_centre(image, origin, across, reach, half_width):
    """Offset along ``across`` of a dark mark near ``origin``: two looks, the second about what the first found."""
    centre = 0.0
    beside = np.array([-across[1], across[0]])
    k = np.arange(-reach, reach + 1)
    for _ in range(2):
        at = np.asarray(origin) + centre * np.asarray(across)
        lines = [at + side * beside + k[:, None] * np.asarray(across) for side in (-1, 0, 1)]
        profile = np.mean([grey(image, p[:, 0], p[:, 1]) for p in lines], axis=0)
        left, right = profile[:2].mean(), profile[-2:].mean()
        light = left + (right - left) * (k + reach) / (2.0 * reach)
        dip = light - profile
        deepest = int(np.argmax(dip))
        above = dip - 0.15 * dip[deepest]
        share = np.where((above > 0.0) & (np.abs(k - k[deepest]) <= half_width), above / light, 0.0)
        centre += float((share * k).sum() / share.sum())
    return centre


def first_lasting_steps(grey, inside, limits):
    """Sample of each line (n, m) at which its first step from a plain beginning is steepest; NaN without one."""
    (plain, half, least, of_scatter), count = limits, grey.shape[1]
    rows, samples = np.arange(len(grey)), np.arange(count)
    first = np.argmax(inside, axis=1)
    level = np.minimum(first[:, None] + np.arange(plain), count - 1)
    scatter = np.maximum(np.take_along_axis(grey, level, axis=1).std(axis=1), 1.0)
    step = np.zeros_like(grey)
    step[:, half:-half] = np.abs(grey[:, 2 * half :] - grey[:, : -2 * half])
    step[~inside | (samples < first[:, None] + half)] = 0.0
    beyond = step > np.maximum(least, of_scatter * scatter)[:, None]
    hit = np.argmax(beyond, axis=1)
    near = (samples >= hit[:, None]) & (samples <= hit[:, None] + 2 * half)
    most = np.argmax(np.where(near, step, -1.0), axis=1)
    slope = np.abs(np.gradient(grey, axis=1))
    at = np.argmax(np.where(np.abs(samples - most[:, None]) <= half, slope, -1.0), axis=1).clip(1, count - 2)
    before, here, after = (slope[rows, at + k] for k in (-1, 0, 1))
    bend = np.minimum(before - 2.0 * here + after, -1e-9)
    return np.where(beyond.any(axis=1), at + np.clip(0.5 * (before - after) / bend, -1.0, 1.0), np.nan)
