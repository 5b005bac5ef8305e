"""What do sensors on flown spans read, and where do spans stand in the normal equations? Compiled loops."""

from __future__ import annotations

import numpy as np

from flightmodel import _kernels as la
from flightmodel._kernels import kernel


@kernel
def sense(states, aux, vehicle, arms, masses, simpson, window_s, windows, slope):
    """Means over windows of rates and specific force, and their rates of change, into (m, windows, 6) each.

    ``states`` (m, records, 20 or 22) and ``aux`` (m, records, 18) as `synthetic_flight.dynamics` has them, of the
    vehicles numbered ``vehicle`` (m,): accelerometer from the centerbody's c.g. (k, 3), and the centerbody's mass (k,).
    """
    intervals = len(simpson) - 1
    records = np.empty((states.shape[1], 6))
    for i in range(len(states)):
        x, y, z = arms[vehicle[i]]
        mass = masses[vehicle[i]]
        for k in range(len(records)):
            s, a = states[i, k], aux[i, k]
            force = la.back(la.rotation(s[6], s[7], s[8], s[9]), a[6], a[7], a[8])
            turn = la.cross(a[15], a[16], a[17], x, y, z)
            speed = la.cross(s[14], s[15], s[16], x, y, z)
            swing = la.cross(s[14], s[15], s[16], speed[0], speed[1], speed[2])
            for j in range(3):
                records[k, j] = s[14 + j]
                records[k, 3 + j] = force[j] / mass + turn[j] + swing[j]
        for w in range(windows.shape[1]):
            first = w * intervals
            for j in range(6):
                total = 0.0
                for k in range(intervals + 1):
                    total += simpson[k] * records[first + k, j]
                windows[i, w, j] = total
                slope[i, w, j] = (records[first + intervals, j] - records[first, j]) / window_s


@kernel
def add_part(corner, across, band, place, part):
    """Add a symmetric part (k, k) at rows and columns ``place`` (k,) of an arrow matrix in its three pieces."""
    shared = len(corner)
    for i in range(len(place)):
        row = place[i]
        for j in range(len(place)):
            column = place[j]
            if row < shared:
                if column < shared:
                    corner[row, column] += part[i, j]
            elif column < shared:
                across[row - shared, column] += part[i, j]
            elif row >= column:
                band[row - column, column - shared] += part[i, j]
