"""What the air does to the aeroshell: coefficients over Mach number and total angle of attack.

Coefficients refer to ``q S`` and ``q S l`` and act at the nose (datum) of the shell, in the plane of the total angle
of attack: ``C_A`` along -x, ``C_N`` against the lateral velocity, ``C_m`` nose-up positive (so a stable shape has
C_m < 0), ``C_mq`` per ``omega l / (2 V)`` on the transverse rates. Between the table's knots they are linear, which is
the seed paper's blend from Mach 5.7 to 3.5 where the table has no knot in between. Where molecules seldom meet, they
pass to the free-molecular coefficients, if the table has them (`flightmodel.rarefied`).
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from flightmodel.checks import ConfigError, FloatArray, GateError, TableRangeError
from flightmodel.rarefied import bridge

MOST_FAULTS = 10
AXIAL_TOLERANCE = 1e-6
AXIAL_RULE = "0 is wanted there, as the shell is a body of revolution; put an asymmetry into the c.g."
COLUMNS = ("mach", "alpha_deg", "ca", "cn", "cm", "cmq")
# as others write them: all of a column's name, or its first word before words that only say about or in what
SPELLINGS = {
    "mach": {"mach", "ma", "machnumber", "machno", "machzahl"},
    "alpha_deg": {"alpha", "alphadeg", "aoa", "aoadeg", "anstellwinkel"},
    "ca": {"ca", "caxial"},
    "cn": {"cn", "cnormal"},
    "cd": {"cd", "cdrag"},
    "cl": {"cl", "clift"},
    "cm": {"cm", "cmy", "cpitch"},
    "cmq": {"cmq", "cmqcmadot"},
}
SAID_BESIDE = {"deg", "total", "t", "nose", "nase", "cg", "ref", "mrc", "mrp", "body", "wind", "number", "no"}
# above the cone's half-angle part of it lies in shadow; no entry vehicle of the class flies there, so look-ups stop
INVERSE_LIMIT_RAD = np.deg2rad(60.0)


@dataclass(frozen=True)
class AeroTable:
    """Coefficients on a grid of Mach number and total angle of attack.

    Parameters
    ----------
    mach : (m,) float
        Strictly increasing knots. Below the first and above the last the end values hold (Mach-number independence
        above; subsonic coefficients are flat below Mach 0.6).
    alpha_rad : (a,) float
        Uniform from 0 to pi.
    coefficients : (m, a, 4) float
        C_A, C_N, C_m at the nose, C_mq.
    free_molecular : (a, 4) float or None
        The same on the same angles in free-molecular flow; None keeps the continuum's at any Knudsen number.
    """

    mach: FloatArray
    alpha_rad: FloatArray
    coefficients: FloatArray
    free_molecular: FloatArray | None = None

    def at(
        self, mach: FloatArray | float, alpha_rad: FloatArray | float, knudsen: FloatArray | float | None = None
    ) -> FloatArray:
        """C_A, C_N, C_m, C_mq ``(..., 4)`` at Mach numbers and total angles of attack.

        Given Knudsen numbers too, they are bridged to the table's free-molecular coefficients (`rarefied.bridge`).

        Raises
        ------
        TableRangeError
            For angles outside 0 to pi, or where an argument is not a number.
        """
        m, a = np.broadcast_arrays(np.asarray(mach, dtype=float), np.asarray(alpha_rad, dtype=float))
        inside = (a >= 0.0) & (a <= self.alpha_rad[-1]) & (m >= 0.0)
        if not inside.all():
            bad = int(np.argmin(inside))
            raise TableRangeError(
                f"aerodynamic table: Mach {m.flat[bad]:.3f}, angle {np.rad2deg(a.flat[bad]):.2f} deg "
                f"lies outside Mach >= 0, 0 to {np.rad2deg(self.alpha_rad[-1]):.0f} deg"
            )
        from scipy.interpolate import RegularGridInterpolator  # half a second to import

        grid = RegularGridInterpolator((self.mach, self.alpha_rad), self.coefficients)
        points = np.stack([np.clip(m, self.mach[0], self.mach[-1]), a], axis=-1)
        continuum = grid(points).reshape(*m.shape, 4)
        if knudsen is None or self.free_molecular is None:
            return continuum
        free = RegularGridInterpolator((self.alpha_rad,), self.free_molecular)(a[..., None])
        return continuum + bridge(knudsen)[..., None] * (free.reshape(continuum.shape) - continuum)

    def ratio(self, mach: FloatArray | float, alpha_rad: FloatArray | float) -> FloatArray:
        """C_N/C_A (seed paper eq. [2])."""
        c = self.at(mach, alpha_rad)
        return c[..., 1] / c[..., 0]

    def alpha_from_ratio(self, mach: FloatArray, ratio: FloatArray) -> FloatArray:
        """Total angle of attack, rad, whose C_N/C_A is ``ratio`` (seed paper eq. [3]); NaN outside 0 to 60 deg."""
        mach, ratio = np.broadcast_arrays(np.asarray(mach, dtype=float), np.asarray(ratio, dtype=float))
        knots = self.alpha_rad[self.alpha_rad <= INVERSE_LIMIT_RAD + 1e-9]
        table = self.ratio(mach.ravel()[:, None], knots[None, :])
        flat = ratio.ravel()
        k = np.clip(np.sum(table <= flat[:, None], axis=1) - 1, 0, len(knots) - 2)
        row = np.arange(len(flat))
        fraction = (flat - table[row, k]) / (table[row, k + 1] - table[row, k])
        alpha = knots[k] + fraction * (knots[1] - knots[0])
        outside = (flat < 0.0) | (flat > table[:, -1])
        return np.where(outside, np.nan, alpha).reshape(ratio.shape)

    def scaled(self, ca: float = 1.0, cn: float = 1.0, cm: float = 1.0, cmq_shift: float = 0.0) -> AeroTable:
        """Dispersed copy: factors on C_A, C_N, C_m, and a shift of C_mq."""
        factor, shift = np.array([ca, cn, cm, 1.0]), np.array([0.0, 0.0, 0.0, cmq_shift])
        free = None if self.free_molecular is None else self.free_molecular * factor + shift
        return replace(self, coefficients=self.coefficients * factor + shift, free_molecular=free)

    def with_constant_cmq(self, cmq: float) -> AeroTable:
        """Copy with one pitch damping coefficient everywhere."""
        changed = self.coefficients.copy()
        changed[..., 3] = cmq
        return replace(self, coefficients=changed)


def check_axial_flow(path: Path, table: AeroTable) -> None:
    """Raise `GateError` where the air flows along the axis and yet pushes sideways or turns the shell."""
    faults = [
        f"{path}: Mach {mach:g}, angle 0: {name} = {value:g}; {AXIAL_RULE}"
        for mach, row in zip(table.mach, table.coefficients[:, 0], strict=True)
        for name, value in (("normal force (lift)", row[1]), ("pitching moment", row[2]))
        if abs(value) > AXIAL_TOLERANCE
    ]
    if faults:
        raise GateError(faults[:MOST_FAULTS])


def _row_faults(row: list[float], names: tuple[str, ...]) -> list[str]:
    """Say what no row of a coefficient table may hold; ``row`` is finite, in the order of ``names``."""
    mach, alpha = row[:2]
    faults = [] if mach >= 0.0 else [f"column '{names[0]}': {mach:g}; a Mach number is not negative"]
    if not 0.0 <= alpha <= 180.0:
        faults.append(f"column '{names[1]}': {alpha:g}; an angle from 0 to 180 deg is wanted")
    if alpha == 0.0:
        off = [k for k in (3, 4) if abs(row[k]) > AXIAL_TOLERANCE]
        faults += [f"column '{names[k]}': {row[k]:g} at angle 0; {AXIAL_RULE}" for k in off]
    return faults


def _number(text: str) -> float:
    try:
        # Python's own float takes 1_0 and digits of any script
        return float(text) if text.isascii() and "_" not in text else float("nan")
    except ValueError:
        return float("nan")


def named_columns(wanted: tuple[str, ...], header: list[str]) -> dict[str, str]:
    """Return which column of a header each of the ``wanted`` is, where one alone says it, however it is written."""
    words = {column: re.findall("[a-z]+", column.lower()) for column in header}
    found: dict[str, str] = {}
    for name in wanted:
        same = [c for c in header if c.lower() == name] or [c for c in header if "".join(words[c]) in SPELLINGS[name]]
        near = same or [
            c for c in header if words[c] and words[c][0] in SPELLINGS[name] and set(words[c][1:]) <= SAID_BESIDE
        ]
        if len(near) == 1 and near[0] not in found.values():
            found[name] = near[0]
    return found


def read_aero_table(path: Path, names: tuple[str, ...] = COLUMNS) -> AeroTable:
    """Read a coefficient table: columns mach, alpha_deg, ca, cn, cm, cmq, one row a grid point, ``#`` comments.

    What the columns refer to is in the sidecar, see `flightmodel.aeroinput`; ``names`` are the columns' in that order.

    Raises
    ------
    GateError
        With every fault: missing columns, numbers that are not finite, a grid with holes or uneven angles.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        raise ConfigError(f"{path}: no such aerodynamic table") from None
    except (OSError, UnicodeDecodeError) as fault:
        raise GateError(f"{path}: cannot be read as a table: {fault}") from None
    lines = [(k, line) for k, line in enumerate(text.splitlines(), 1) if line.split("#")[0].strip()]
    header = [cell.strip() for cell in lines[0][1].split("#")[0].split(",")] if lines else []
    header = [c.lower() if c.lower() in names else c for c in header]
    missing = [c for c in names if c not in header]
    if missing:
        near = named_columns(names, header)
        meant = [f"'{near[c]}' looks like {c}: name it so" for c in missing if c in near]
        words = f"columns {', '.join(missing)} are missing; wanted {', '.join(names)}; found {', '.join(header)}"
        raise GateError("; ".join([f"{path}: {words}", *meant]))
    twice = [c for c in names if header.count(c) > 1]
    if twice:
        raise GateError(f"{path}, line {lines[0][0]}: columns {', '.join(twice)} stand twice; keep one of each")
    rows, faults = [], []
    for k, line in lines[1:]:
        cells = [cell.strip() for cell in line.split("#")[0].split(",")]
        if len(cells) != len(header):
            faults.append(f"{path}, line {k}: {len(cells)} cells where {len(header)} are wanted; got '{line.strip()}'")
            continue
        row = [_number(cells[header.index(c)]) for c in names]
        rows.append(row)
        bad = [c for c, value in zip(names, row, strict=True) if not np.isfinite(value)]
        faults += [f"{path}, line {k}: column '{c}': '{cells[header.index(c)]}' is no finite number" for c in bad]
        faults += [] if bad else [f"{path}, line {k}: {words}" for words in _row_faults(row, names)]
    if faults:
        raise GateError(faults[:MOST_FAULTS] + [f"{path}: {len(faults)} faults in all"] * (len(faults) > MOST_FAULTS))
    values = np.array(rows, dtype=float).reshape(-1, len(names))
    values = values[np.lexsort((values[:, 1], values[:, 0]))]
    mach, alpha_deg = np.unique(values[:, 0]), np.unique(values[:, 1])
    if len(values) != len(mach) * len(alpha_deg) or len(np.unique(values[:, :2], axis=0)) != len(values):
        faults.append(
            f"{path}: {len(values)} rows where {len(mach)} Mach x {len(alpha_deg)} angles, each once, are wanted"
        )
    if len(alpha_deg) < 2 or len(mach) < 2 or np.ptp(np.diff(alpha_deg)) > 1e-9 or alpha_deg[0] != 0.0:
        faults.append(f"{path}: angles must be evenly spaced from 0, and at least two, as Mach numbers")
    elif abs(alpha_deg[-1] - 180.0) > 1e-9:
        faults.append(f"{path}: angles end at {alpha_deg[-1]:g} deg; give rows to 180: above the air all are met")
    if faults:
        raise GateError(faults)
    grid = values[:, 2:].reshape(len(mach), len(alpha_deg), 4)
    return AeroTable(mach, np.deg2rad(alpha_deg), np.ascontiguousarray(grid))
