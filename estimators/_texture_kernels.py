"""Compiled search for patches of the benchmark frame in another one; the model is in `estimators.texture`.

Readable twin: ``tests/estimators/test_plain_twins.py``.
"""

from __future__ import annotations

import math

import numpy as np

from flightmodel._kernels import inlined, kernel


@inlined
def correlations(picture, template, middle, affine, reach, score):
    """Correlation (2 reach + 1, 2 reach + 1), rows by v, of a template shifted in its own picture; False outside.

    ``affine`` (2, 2) maps offsets in the template's picture to this one, about ``middle`` (2,). The template (m, m) has
    mean zero and norm one.
    """
    size = len(template)
    half = size // 2 + reach
    wide = 2 * half + 1
    h, w = picture.shape
    window = np.empty((wide, wide))
    for i in range(wide):
        for j in range(wide):
            u = middle[0] + affine[0, 0] * (j - half) + affine[0, 1] * (i - half)
            v = middle[1] + affine[1, 0] * (j - half) + affine[1, 1] * (i - half)
            if not (u >= 0.0 and v >= 0.0 and u < w - 1.0 and v < h - 1.0):
                return False
            x, y = int(u), int(v)
            a, b = u - x, v - y
            upper = (1.0 - a) * picture[y, x] + a * picture[y, x + 1]
            window[i, j] = (1.0 - b) * upper + b * ((1.0 - a) * picture[y + 1, x] + a * picture[y + 1, x + 1])
    # sums over the patch: along rows, then of rows
    steps = 2 * reach + 1
    along = np.zeros((wide, steps, 2))
    for i in range(wide):
        for q in range(steps):
            for j in range(size):
                along[i, q, 0] += window[i, q + j]
                along[i, q, 1] += window[i, q + j] * window[i, q + j]
    for p in range(steps):
        for q in range(steps):
            spread, product = 0.0, 0.0
            for i in range(size):
                spread += along[p + i, q, 1] - along[p + i, q, 0] * along[p + i, q, 0] / size
                for j in range(size):
                    product += window[p + i, q + j] * template[i, j]
            score[p, q] = product / math.sqrt(spread) if spread > 1e-9 else 0.0
    return True


@kernel
def find_patches(picture, templates, middle, affine, across, limits, place, sd):
    """Place (n, 2) of each patch along its two directions and its sd, infinite where it was not found.

    ``across`` (n, 2, 2): unit vectors, one a row. ``limits``: reach, least correlation, independent samples of a patch.
    """
    reach, least, samples = limits
    wide = 2 * reach + 1
    score = np.empty((wide, wide))
    for k in range(len(templates)):
        place[k, 0] = place[k, 1] = 0.0
        sd[k, 0] = sd[k, 1] = np.inf
        if not correlations(picture, templates[k], middle[k], affine[k], reach, score):
            continue
        best = int(np.argmax(score))
        p, q = best // wide, best % wide
        if p < 1 or q < 1 or p > wide - 2 or q > wide - 2 or score[p, q] < least:
            continue
        # parabola through the nine highest: slope and curvature
        su, sv = 0.5 * (score[p, q + 1] - score[p, q - 1]), 0.5 * (score[p + 1, q] - score[p - 1, q])
        cuu = 2.0 * score[p, q] - score[p, q + 1] - score[p, q - 1]
        cvv = 2.0 * score[p, q] - score[p + 1, q] - score[p - 1, q]
        cuv = -0.25 * (score[p + 1, q + 1] - score[p + 1, q - 1] - score[p - 1, q + 1] + score[p - 1, q - 1])
        det = cuu * cvv - cuv * cuv
        if cuu <= 0.0 or det <= 1e-6:
            continue
        du, dv = (cvv * su - cuv * sv) / det, (cuu * sv - cuv * su) / det
        du, dv = min(max(du, -1.0), 1.0) + q - reach, min(max(dv, -1.0), 1.0) + p - reach
        rho = min(score[p, q], 0.999)
        noise = (1.0 - rho * rho) / (rho * samples * det)
        for r in range(2):
            # the direction in the template's picture
            mu = across[k, r, 0] * affine[k, 0, 0] + across[k, r, 1] * affine[k, 1, 0]
            mv = across[k, r, 0] * affine[k, 0, 1] + across[k, r, 1] * affine[k, 1, 1]
            place[k, r] = across[k, r, 0] * middle[k, 0] + across[k, r, 1] * middle[k, 1] + mu * du + mv * dv
            sd[k, r] = math.sqrt(noise * (cvv * mu * mu - 2.0 * cuv * mu * mv + cuu * mv * mv))
