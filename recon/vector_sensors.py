"""What do magnetometer and Sun heads see of known directions, block by block, and how may they err?

Samples are averaged in blocks about evenly spaced *knots*; a block's mean stands at its samples' mean time, a *lag*
from its knot. Beside each mean stands what it is of, in inertial axes (in which a free vehicle's rate is steady): the
field of IGRF at the vehicle, or the direction of the Sun. Only the field needs the vehicle's place, and not exactly: it
changes by 25 nT/km at most, 0.03 deg in direction, so a raw radar track is plenty.

Errors are constants over the flight, with standard deviations from the data sheets, and what the sheets leave out
(`Unstated`): what IGRF does, a slowly wandering bias of the magnetometer (straight lines between nodes, Gauss-Markov at
the nodes), the light of the Earth in the Sun heads and the age of a Sun sample. How they act: `recon.vector_models`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from flightmodel import earth, rotations
from flightmodel.checks import BoolArray, FloatArray
from flightmodel.geomagnetism_and_sun import magnetic_field_ecef_t, sun_direction_ecef
from flightmodel.instruments import SunHeads, TriadSpec, direction_from_sun_angles, sun_angles_from_direction
from flightmodel.telemetry import SunRecord, TriadRecord

IntArray = NDArray[np.int64]
Position = Callable[[FloatArray], FloatArray]
MAGNETOMETER, HEADS = "magnetometer", "sun heads"
AXES = ("x", "y", "z")
SYMMETRIC = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))  # places of a symmetric matrix's six elements
LEAST = 1e-9  # stands for a prior of zero: a fraction, rad or s; and a ten-thousandth of it for tesla
DRIFT_SPACING_S = 60.0


@dataclass(frozen=True)
class Unstated:
    """Standard deviations of what no data sheet states.

    Parameters
    ----------
    field_sd_t : float
        What IGRF leaves out (crust, currents above), per axis, constant over the flight.
    drift_sd_t, drift_time_constant_s : float
        Gauss-Markov wander of the magnetometer's bias, where its data sheet states none.
    earthlight_sd : float
        Weight of the Earth against the Sun in a head, at the nadir; twice, once for all heads and once for those that
        have the nadir in their field.
    sun_time_sd_s : float
        Age of a Sun sample at its time tag, against the magnetometer's.
    """

    field_sd_t: float = 1e-7
    drift_sd_t: float = 5e-8
    drift_time_constant_s: float = 100.0
    earthlight_sd: float = 0.01
    sun_time_sd_s: float = 0.005


@dataclass(frozen=True)
class ErrorTerms:
    """Errors of magnetometer and Sun heads: name, instrument and unit of each, and their prior covariance (m, m)."""

    names: tuple[str, ...]
    instruments: tuple[str, ...]
    units: tuple[str, ...]
    covariance: FloatArray
    drift_nodes_s: FloatArray

    @property
    def size(self) -> int:
        """Number of errors."""
        return len(self.names)

    @property
    def prior_sd(self) -> FloatArray:
        """Prior standard deviation of every error, (m,)."""
        return np.sqrt(np.diagonal(self.covariance))

    def of(self, *instruments: str) -> IntArray:
        """Where the errors of some instruments stand, in the order asked for."""
        return np.array([i for wanted in instruments for i, owner in enumerate(self.instruments) if owner == wanted])


def head_name(index: int) -> str:
    """Name of a Sun head, counted from one as in the columns of its file."""
    return f"sun head {index + 1}"


def error_terms(magnetometer: TriadSpec, sun: SunHeads, unstated: Unstated, start_s: float, end_s: float) -> ErrorTerms:
    """Errors of two data sheets and of what they leave out, over a flight from ``start_s`` to ``end_s``."""
    rows: list[tuple[str, str, str, float]] = []

    def add(instrument: str, kind: str, parts: tuple[str, ...], unit: str, sd: float) -> None:
        least = 1e-4 * LEAST if unit == "T" else LEAST
        rows.extend((f"{instrument} {kind} {part}", instrument, unit, max(sd, least)) for part in parts)

    add(MAGNETOMETER, "bias", AXES, "T", magnetometer.bias_sd)
    add(MAGNETOMETER, "scale", AXES, "1", magnetometer.scale_sd)
    add(MAGNETOMETER, "mount", AXES, "rad", magnetometer.mount_sd_rad)
    add(MAGNETOMETER, "soft iron", tuple(AXES[i] + AXES[j] for i, j in SYMMETRIC), "1", magnetometer.soft_iron_sd)
    add(MAGNETOMETER, "field", AXES, "T", unstated.field_sd_t)
    first = len(rows)
    nodes = np.linspace(start_s, end_s, max(2, int(np.ceil((end_s - start_s) / DRIFT_SPACING_S)) + 1))
    drift, time_constant_s = unstated.drift_sd_t, unstated.drift_time_constant_s
    if magnetometer.bias_wander_sd > 0.0:
        drift, time_constant_s = magnetometer.bias_wander_sd, magnetometer.bias_time_constant_s
    for node in nodes:
        add(MAGNETOMETER, f"drift at {node:.0f} s", AXES, "T", drift)
    for head in range(len(sun.clock_lv_rad)):
        add(head_name(head), "bias", ("az", "el"), "rad", sun.bias_sd_rad)
        add(head_name(head), "mount", AXES, "rad", sun.mount_sd_rad)
    add(HEADS, "earthlight", ("everywhere", "with nadir in field"), "1", unstated.earthlight_sd)
    add(HEADS, "sample", ("age",), "s", unstated.sun_time_sd_s)
    names, instruments, units, sd = zip(*rows, strict=True)
    covariance = np.diag(np.array(sd) ** 2)
    wander = slice(first, first + 3 * len(nodes))
    # nodes that never part would be one, many times
    apart = np.maximum(np.abs(nodes[:, None] - nodes) / time_constant_s, 1e-3 * (1.0 - np.eye(len(nodes))))
    covariance[wander, wander] = sd[first] ** 2 * np.kron(np.exp(-apart), np.eye(3))
    return ErrorTerms(names, instruments, units, covariance, nodes)


@dataclass(frozen=True)
class Sightings:
    """Block means of one sensor, at most one a knot.

    Parameters
    ----------
    name : str
        ``"magnetometer"`` or that of a Sun head.
    dcm_body_sensor : (3, 3) float
        Nominal mounting.
    terms : (p,) int
        Which of the `ErrorTerms` it has, in the order in which its model takes them.
    edge : float
        Cosine of the angle from a head's axis to the edge of its field; of no meaning for the magnetometer.
    knot : (r,) int
    lag_s : (r,) float
        From the knot to the samples' mean time.
    measured : (r, 3) or (r, 2) float
        Field in sensor axes, T; or azimuth and elevation in the head's, rad.
    noise_sd : (r,) float
        Of a mean, T; or rad across the line of sight.
    reference_eci : (r, 3) float
        Field, T; or unit vector to the Sun.
    up_eci : (r, 3) float
        Away from the Earth's centre.
    drift : (r, k) float
        Share of each node of the magnetometer's wandering bias; no columns for Sun heads.
    constant_sd_rad : float
        Of a direction by all constant errors together, per axis.
    """

    name: str
    dcm_body_sensor: FloatArray
    terms: IntArray
    edge: float
    knot: IntArray
    lag_s: FloatArray
    measured: FloatArray
    noise_sd: FloatArray
    reference_eci: FloatArray
    up_eci: FloatArray
    drift: FloatArray
    constant_sd_rad: float

    @property
    def is_field(self) -> bool:
        """Whether the sensor is the magnetometer."""
        return self.measured.shape[1] == 3

    def directions_body(self) -> FloatArray:
        """Measured unit vectors ``(r, 3)`` in body axes, the sensor taken as mounted nominally and free of errors."""
        sensor = self.measured if self.is_field else direction_from_sun_angles(self.measured)
        return unit(sensor @ self.dcm_body_sensor.T)

    def take(self, rows: BoolArray, knot: IntArray | None = None) -> Sightings:
        """Some of the rows; ``knot`` holds their new knot numbers, where these change."""
        names = ("lag_s", "measured", "noise_sd", "reference_eci", "up_eci", "drift")
        number = self.knot[rows] if knot is None else knot
        return replace(self, knot=number, **{name: getattr(self, name)[rows] for name in names})


def unit(vectors: FloatArray) -> FloatArray:
    """Vectors ``(..., 3)`` made one long."""
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))


def block_means(
    time_s: FloatArray, values: FloatArray, knots_s: FloatArray, step_s: float
) -> tuple[IntArray, IntArray, FloatArray, FloatArray]:
    """Means of complete samples by nearest knot.

    Parameters
    ----------
    time_s : (n,) float
    values : (n, m) float
        Rows with NaN are left out.
    knots_s : (k,) float
        Evenly spaced by ``step_s``.

    Returns
    -------
    knot, count : (r,) int
        Knots that have samples, and how many.
    mean_time_s : (r,) float
    means : (r, m) float
    """
    number = np.round((time_s - knots_s[0]) / step_s).astype(int)
    good = np.isfinite(values).all(axis=1) & (number >= 0) & (number < len(knots_s))
    number, size = number[good], len(knots_s)
    count = np.bincount(number, minlength=size)
    knot = np.flatnonzero(count)
    # against the knot, so that a time keeps its digits
    columns = (time_s[good] - knots_s[number], *values[good].T)
    sums = [np.bincount(number, weights=column, minlength=size)[knot] for column in columns]
    means = np.column_stack(sums) / count[knot, None]
    return knot, count[knot], knots_s[knot] + means[:, 0], means[:, 1:]


def sight_magnetometer(
    record: TriadRecord, t0_utc: str, knots_s: FloatArray, step_s: float, position: Position, terms: ErrorTerms
) -> Sightings:
    """Block means of the magnetometer beside IGRF at their places."""
    spec = record.spec
    knot, count, at, field = block_means(record.time_s, record.measured_sensor, knots_s, step_s)
    sd = max(np.hypot(spec.noise_sd, spec.resolution / np.sqrt(12.0)), 1e-4 * LEAST)
    place, turn = position(at), rotations.conjugate(earth.q_ecef_eci(at))
    nodes, sd_of = terms.drift_nodes_s, terms.prior_sd
    # one axis of each kind stands for all; bias and drift turn a direction by their part of the field
    across = np.hypot(sd_of[0], sd_of[15]) / max(float(np.median(np.linalg.norm(field, axis=1))), LEAST)
    return Sightings(
        MAGNETOMETER,
        spec.dcm_body_sensor,
        terms.of(MAGNETOMETER),
        0.0,
        knot,
        at - knots_s[knot],
        field,
        sd / np.sqrt(count),
        rotations.rotate(turn, magnetic_field_ecef_t(place, t0_utc)),
        rotations.rotate(turn, unit(place)),
        np.column_stack([np.interp(at, nodes, share) for share in np.eye(len(nodes))]),
        float(np.linalg.norm([across, sd_of[3], sd_of[6], sd_of[9]])),
    )


def sight_sun(
    record: SunRecord, t0_utc: str, knots_s: FloatArray, step_s: float, position: Position, terms: ErrorTerms
) -> list[Sightings]:
    """Block means of every Sun head that ever sees the Sun."""
    out, spec = [], record.spec
    for head, dcm in enumerate(spec.dcm_body_head):
        seen = direction_from_sun_angles(record.az_el_head_rad[:, head])
        knot, count, at, mean = block_means(record.time_s, seen, knots_s, step_s)
        if len(knot) == 0:
            continue
        turn = rotations.conjugate(earth.q_ecef_eci(at))
        out.append(
            Sightings(
                head_name(head),
                dcm,
                terms.of(head_name(head), HEADS),
                float(np.cos(0.5 * spec.field_rad)),
                knot,
                at - knots_s[knot],
                sun_angles_from_direction(mean),
                max(spec.noise_sd_rad, LEAST) / np.sqrt(count),
                rotations.rotate(turn, sun_direction_ecef(t0_utc, at)),
                rotations.rotate(turn, unit(position(at))),
                np.empty((len(knot), 0)),
                float(np.linalg.norm([spec.bias_sd_rad, spec.mount_sd_rad, *terms.prior_sd[terms.of(HEADS)[:2]]])),
            )
        )
    return out
