"""Compiled search for the edges of shell and centerbody and for dark features; the models are in `estimators.edge`,
`estimators.body_edge` and `estimators.features`; readable twin: ``tests/oracles/plain_horizon.py``.
"""

from __future__ import annotations

import math

import numpy as np

from flightmodel._kernels import inlined, kernel


@inlined
def grey_inside(image, u, v):
    """Grey level between pixels, bilinear, of a place that lies in the picture."""
    j, i = int(u), int(v)
    a, b = u - j, v - i
    upper = (1.0 - a) * image[i, j] + a * image[i, j + 1]
    return (1.0 - b) * upper + b * ((1.0 - a) * image[i + 1, j] + a * image[i + 1, j + 1])


@inlined
def _grey_at(image, u, v):
    """Grey level between pixels, bilinear; the border's beyond the picture."""
    h, w = image.shape
    return grey_inside(image, min(max(u, 0.0), w - 1.000001), min(max(v, 0.0), h - 1.000001))


@inlined
def _select(values, count, rank):
    """Move the value of a rank to its place among the first values, smaller ones before it (C. A. R. Hoare)."""
    low, high = 0, count - 1
    while low < high:
        pivot, i, j = values[rank], low, high
        while i <= j:
            while values[i] < pivot:
                i += 1
            while values[j] > pivot:
                j -= 1
            if i <= j:
                values[i], values[j] = values[j], values[i]
                i += 1
                j -= 1
        if j < rank:
            low = i
        if rank < i:
            high = j


@inlined
def median(values, count):
    """Median of the first values, whose order changes."""
    half = count // 2
    _select(values, count, half)
    if count % 2:
        return values[half]
    below = values[0]
    for i in range(1, half):
        below = max(below, values[i])
    return 0.5 * (below + values[half])


@inlined
def _band_along(origin, inward, outer, inner, size):
    """As `band_of_lines`, along one axis."""
    low, high = np.inf, -np.inf
    for i in range(len(origin)):
        a, b = origin[i] - outer * inward[i], origin[i] + inner * inward[i]
        low, high = min(low, a, b), max(high, a, b)
    first = min(max(math.floor(low) - 4, 0), size - 4)
    return first, min(max(math.ceil(high) + 5, first + 4), size)


@kernel
def band_of_lines(origin, inward, outer, inner, size):
    """First and one beyond the last pixel, across and down, of what lines in a picture of a size want smoothed.

    They reach so far to both sides of their origins (n, 2); beside them are the pixels between which levels lie, and
    those at a border to which levels beyond it are brought.
    """
    left, right = _band_along(origin[:, 0], inward[:, 0], outer, inner, size[0])
    top, bottom = _band_along(origin[:, 1], inward[:, 1], outer, inner, size[1])
    return left, top, right, bottom


@kernel
def sample_lines(image, origin, inward, first, step, corner, size, grey, inside):
    """Grey levels ``(n, m)`` along lines, of a piece of the picture whose upper left pixel is ``corner``."""
    n, m = grey.shape
    for i in range(n):
        for k in range(m):
            along = first + k * step
            u, v = origin[i, 0] + along * inward[i, 0], origin[i, 1] + along * inward[i, 1]
            inside[i, k] = u >= 0.0 and v >= 0.0 and u <= size[0] - 1.0 and v <= size[1] - 1.0
            grey[i, k] = _grey_at(image, u - corner[0], v - corner[1])


@kernel
def sky_levels(grey, inside, span, level, scatter, first):
    """Level and one difference over ``span / 2`` samples of each line's outer end, and where that end begins."""
    n, m = grey.shape
    few = np.empty(span)
    for i in range(n):
        k = 0
        while k < m and not inside[i, k]:
            k += 1
        first[i] = 0 if k == m else k
        for j in range(span):
            few[j] = grey[i, min(first[i] + j, m - 1)]
        scatter[i] = abs(few[span // 2] - few[0])
        level[i] = median(few, span)


@kernel
def first_rises(grey, inside, level, first, noise, common, limits, step, places, bases, place, sd, good):
    """Place along each line, its sd, and whether there is a lasting rise; see `estimators.edge`.

    ``limits``: span of the sky, samples a rise must last, least contrast.
    """
    n, m = grey.shape
    span, lasting, contrast = limits
    half_bases = bases.shape[2] // 2
    few = np.empty(8)
    explained = np.empty(len(places))
    for i in range(n):
        good[i] = False
        threshold = level[i] + max(6.0 * noise, 0.75 * contrast)
        rise, run = -1, 0
        for k in range(m):
            if inside[i, k] and grey[i, k] > threshold:
                run += 1
                if run == lasting:
                    rise = k - lasting + 1
                    break
            else:
                run = 0
        if rise <= first[i] + span or rise >= m - int(8.0 / step) or level[i] >= common + contrast:
            continue
        # the shell's level is read just inside the edge: first of the rise, then of the crossing so found
        inner, crossing, shell, half = rise + int(1.5 / step), -1, 0.0, 0.0
        for _ in range(2):
            count = int(3.5 / step) - int(2.0 / step)
            for j in range(count):
                few[j] = grey[i, min(inner + int(2.0 / step) + j, m - 1)]
            shell = median(few, count)
            half = 0.5 * (level[i] + shell)
            crossing = -1
            for k in range(max(rise - int(3.0 / step), 0), min(rise + int(5.0 / step), m)):
                if grey[i, k] > half:
                    crossing = k
                    break
            inner = max(crossing, 0)
        if crossing <= max(rise - int(3.0 / step), 0) or shell - level[i] <= contrast:
            continue
        slope = max(grey[i, crossing] - grey[i, crossing - 1], 1e-3)
        for b in range(len(places)):
            step_share, ramp_share = 0.0, 0.0
            for k in range(bases.shape[2]):
                value = grey[i, min(max(crossing + k - half_bases, 0), m - 1)] - level[i]
                step_share += value * bases[b, 0, k]
                ramp_share += value * bases[b, 1, k]
            explained[b] = step_share * step_share + ramp_share * ramp_share
        best = min(max(int(np.argmax(explained)), 1), len(places) - 2)
        curve = max(2.0 * explained[best] - explained[best - 1] - explained[best + 1], 1e-9)
        shift = min(max(0.5 * (explained[best + 1] - explained[best - 1]) / curve, -1.0), 1.0)
        place[i] = crossing + (places[best] + (places[1] - places[0]) * shift) / step
        # fitting a ramp beside the step doubles the noise of a crossing: 2.4, found by repeating one scene
        sd[i] = 2.4 * noise * step / slope
        good[i] = True


@kernel
def steps_near(grey, inside, noise, contrast, places, bases, place, along, left, good):
    """Place of the step, up or down, on short lines across an expected edge; see `estimators.edge`.

    ``along``: its sd per unit sd of independent samples; ``left`` (n, m): grey levels less step and ramp.
    """
    n, m = grey.shape
    level_of = 6
    few, value, explained = np.empty(level_of), np.empty(m), np.empty(len(places))
    for i in range(n):
        good[i] = False
        whole = True
        for k in range(m):
            whole = whole and inside[i, k]
        if not whole:
            continue
        for k in range(level_of):
            few[k] = grey[i, k]
        level = median(few, level_of)
        total = 0.0
        for k in range(m):
            value[k] = grey[i, k] - level
            total += value[k] ** 2
        for b in range(len(places)):
            step_share, ramp_share = 0.0, 0.0
            for k in range(m):
                step_share += value[k] * bases[b, 0, k]
                ramp_share += value[k] * bases[b, 1, k]
            explained[b] = step_share * step_share + ramp_share * ramp_share
        best = int(np.argmax(explained))
        if best == 0 or best == len(places) - 1:
            continue
        curve = max(2.0 * explained[best] - explained[best - 1] - explained[best + 1], 1e-9)
        shift = min(max(0.5 * (explained[best + 1] - explained[best - 1]) / curve, -1.0), 1.0)
        # the first row of a basis is the step's: its share over the shell's length is the step
        behind, count = 0.0, 0
        for k in range(m):
            if bases[best, 0, k] > 0.5 * bases[best, 0, m - 1]:
                behind += value[k]
                count += 1
        height = abs(behind / max(count, 1))
        residual_rms = math.sqrt(max(total - explained[best], 0.0) / m)
        if height > contrast and residual_rms < 2.0 * noise + 0.15 * height:
            step_share, ramp_share = 0.0, 0.0
            for k in range(m):
                step_share += value[k] * bases[best, 0, k]
                ramp_share += value[k] * bases[best, 1, k]
            place[i] = places[best] + (places[1] - places[0]) * shift
            along[i] = (places[1] - places[0]) * math.sqrt(2.0 / curve)
            for k in range(m):
                left[i, k] = value[k] - step_share * bases[best, 0, k] - ramp_share * bases[best, 1, k]
            good[i] = True


@inlined
def square_of_model(left, good, noise, beside, square):
    """Mean square (n,) of what step and ramp leave (n, m), of the mean over a line and ``beside`` on either side.

    Beyond noise; lines that are not good count nothing.
    """
    n, m = left.shape
    total, count = np.zeros(m), 0
    for i in range(-beside, n):
        after, before = i + beside, i - beside - 1
        if after < n and good[after]:
            count += 1
            for k in range(m):
                total[k] += left[after, k]
        if before >= 0 and good[before]:
            count -= 1
            for k in range(m):
                total[k] -= left[before, k]
        if i >= 0:
            per, mean = 1.0 / max(count, 1), 0.0
            for k in range(m):
                mean += (total[k] * per) ** 2
            square[i] = max(mean / m - noise * noise * per, 0.0)


@kernel
def good_steps(lines, steps, noise, weights, beside, floor, found):
    """Move the points (n, 2) at good steps on lines, their directions, sd and indices to the front; their number.

    ``lines``: origins, directions, indices. ``steps``: as of `steps_near`. ``weights``: samples that err together, of
    noise and of what step and ramp leave; see `square_of_model`.
    """
    origin, inward, index = lines
    place, along, left, good = steps
    points, across, sd, line = found
    square, count = np.empty(len(left)), 0
    square_of_model(left, good, noise, beside, square)
    for i in range(len(left)):
        if good[i]:
            for c in range(2):
                points[count, c] = origin[i, c] + place[i] * inward[i, c]
                across[count, c] = inward[i, c]
            variance = along[i] * along[i] * (weights[0] * noise * noise + weights[1] * square[i])
            sd[count], line[count] = math.sqrt(variance + floor * floor), index[i]
            count += 1
    return count


@kernel
def coherent(line, residual, beside, within, found):
    """Mark residuals (n,) that more than ``beside`` of as many places on either side, and their own, lie ``within``.

    ``line`` (n,): places, increasing.
    """
    n = len(line)
    for i in range(n):
        alike = 0
        for j in range(max(i - beside, 0), min(i + beside + 1, n)):
            alike += abs(line[j] - line[i]) <= beside and abs(residual[j] - residual[i]) < within
        found[i] = alike > beside
