"""Compiled search for the edges of shell and centerbody and for dark features; the models are in `estimators.edge`,
`estimators.body_edge` and `estimators.features`; readable twin: ``tests/oracles/plain_horizon.py``.
"""

from __future__ import annotations

import math

import numpy as np

from estimators._sight_kernels import pixel_of
from flightmodel._kernels import inlined, kernel


@inlined
def _grey_inside(image, u, v):
    """Grey level between pixels, bilinear, of a place that lies in the picture."""
    j, i = int(u), int(v)
    a, b = u - j, v - i
    upper = (1.0 - a) * image[i, j] + a * image[i, j + 1]
    return (1.0 - b) * upper + b * ((1.0 - a) * image[i + 1, j] + a * image[i + 1, j + 1])


@inlined
def _grey_at(image, u, v):
    """Grey level between pixels, bilinear; the border's beyond the picture."""
    h, w = image.shape
    return _grey_inside(image, min(max(u, 0.0), w - 1.000001), min(max(v, 0.0), h - 1.000001))


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


@inlined
def dark_centres(image, origin, across, reach, half_widths, signs, noise, offset, sd):
    """Offset along unit vectors ``across`` (n, 2) from ``origin`` (n, 2), px, of the dark line or spot there.

    ``signs`` (n,): 1 for a dark one, -1 for one paler than what is beside it. A profile is the mean of three lines a
    pixel apart; the dip under the line between its ends, as a share of that line, has its centroid where the feature
    is. ``sd`` is infinite where no dip stands out of the noise, or where it is cut off by the window.
    """
    m = 2 * reach + 1
    dip, grey = np.empty(m), np.empty(3 * m)
    h, w = image.shape
    for i in range(len(origin)):
        sd[i] = np.inf
        du, dv = across[i]
        centre = 0.0
        for _ in range(2):
            u0, v0 = origin[i, 0] + centre * du, origin[i, 1] + centre * dv
            if not (reach + 2 <= u0 <= w - reach - 3 and reach + 2 <= v0 <= h - reach - 3):
                sd[i] = np.inf
                break
            for c in range(3):
                for k in range(m):
                    u, v = u0 + (k - reach) * du - (c - 1) * dv, v0 + (k - reach) * dv - (1 - c) * du
                    grey[c * m + k] = _grey_inside(image, u, v)
            for k in range(m):
                dip[k] = (grey[m + k] + (grey[k] + grey[2 * m + k])) / 3.0
            left, right = 0.5 * (dip[0] + dip[1]), 0.5 * (dip[m - 1] + dip[m - 2])
            deepest = 0
            for k in range(m):
                dip[k] = signs[i] * (left + (right - left) * k / (m - 1.0) - dip[k])
                if dip[k] > dip[deepest]:
                    deepest = k
            depth = dip[deepest]
            if depth < max(5.0 * noise, 6.0) or deepest < 2 or deepest > m - 3:
                sd[i] = np.inf
                break
            # paint takes away a share of the light, whatever the light's slope across the feature
            slope = (right - left) / (m - 1.0)
            total, moment, reach_in = 0.0, 0.0, half_widths[i]
            for k in range(m):
                above = dip[k] - 0.15 * depth
                if above > 0.0 and abs(k - deepest) <= reach_in:
                    share = above / (left + slope * k)
                    total += share
                    moment += share * (k - reach)
            centre += moment / total
            # of the mean of three lines, over the squares of 1, 2, ... on either side
            squares = reach_in * (reach_in + 1.0) * (2.0 * reach_in + 1.0) / 3.0
            sd[i] = noise / (left + slope * deepest) * math.sqrt(squares / 3.0) / total
        offset[i] = centre


@kernel
def find_dark(image, points, terms, lens, across, search, floor, place, sd):
    """Place (n,) of dark features, at points (n, 3) of the shell, along unit vectors (n, 2); its sd, over a ``floor``.

    ``terms``, ``lens``: as of `estimators._sight_kernels.project_points`. ``search``: reach, half widths, signs and
    noise, as of `dark_centres`.
    """
    n = len(points)
    expected = np.empty((n, 2))
    for i in range(n):
        u, v = pixel_of(points[i], terms, lens)
        # what the lens does not see lies far from the picture
        expected[i, 0], expected[i, 1] = (u, v) if math.isfinite(u) else (-1e6, -1e6)
        place[i] = 0.0
    reach, half_widths, signs, noise = search
    dark_centres(image, expected, across, reach, half_widths, signs, noise, place, sd)
    for i in range(n):
        place[i] += expected[i, 0] * across[i, 0] + expected[i, 1] * across[i, 1]
        sd[i] = math.sqrt(sd[i] * sd[i] + floor * floor)


@inlined
def _scatter(grey, begin, plain, last):
    """Standard deviation of ``plain`` samples from the first; the last one counts for those behind it."""
    mean, square = 0.0, 0.0
    for j in range(plain):
        mean += grey[min(begin + j, last - 1)]
    mean /= plain
    for j in range(plain):
        square += (grey[min(begin + j, last - 1)] - mean) ** 2
    return math.sqrt(square / plain)


@inlined
def _steepest(grey, inside, hit, half, slope):
    """Place of the steepest slope of the largest step near the first one, by a parabola through three slopes."""
    count, most, largest = len(grey), hit, 0.0
    for j in range(hit, min(hit + 2 * half, count - half - 1) + 1):
        size = abs(grey[j + half] - grey[j - half])
        if inside[j] and size > largest:
            most, largest = j, size
    for j in range(max(most - half - 1, 0), min(most + half + 2, count)):
        low, high = max(j - 1, 0), min(j + 1, count - 1)
        slope[j] = abs(grey[high] - grey[low]) / (high - low)
    at = max(most - half, 0)
    for j in range(at, min(most + half + 1, count)):
        if slope[j] > slope[at]:
            at = j
    at = min(max(at, 1), count - 2)
    before, here, after = slope[at - 1], slope[at], slope[at + 1]
    bend = min(before - 2.0 * here + after, -1e-9)
    return at + min(max(0.5 * (before - after) / bend, -1.0), 1.0)


@kernel
def first_lasting_steps(grey, inside, limits, place):
    """Sample (n,) at which the first step from a plain beginning is steepest, on lines (n, m) as sampled; else NaN.

    ``limits``: samples of the plain beginning, on either side of a step; least step, and least over the beginning's
    scatter.
    """
    plain, half, least, of_scatter = limits
    n, m = grey.shape
    slope = np.empty(m)
    for i in range(n):
        place[i] = np.nan
        begin = 0
        while begin < m and not inside[i, begin]:
            begin += 1
        held = min(begin + plain, m)
        enough = max(least, of_scatter * max(_scatter(grey[i], begin, plain, held), 1.0))
        for j in range(begin + half, m - half):
            if inside[i, j] and abs(grey[i, j + half] - grey[i, j - half]) > enough:
                place[i] = _steepest(grey[i], inside[i], j, half, slope)
                break


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
