"""What an analyst may choose about a reconstruction."""

from __future__ import annotations

from dataclasses import dataclass

from flightmodel.checks import GateError, nearest_name
from recon.ekf import ENGINES
from recon.smoother import SMOOTHERS


@dataclass(frozen=True)
class Settings:
    """What an analyst may choose.

    Parameters
    ----------
    output_rate_hz : float
        Of the trajectories.
    pulse_rate_hz : float
        Of the trajectories where the accelerometers feel more than half of the descent's largest force; 0 for no other
        rate there, so that equal spans have equal times.
    start_s, end_s : float or None
        Span; the data's own common span where None.
    passes : int
        Most forward passes over all data. The first filter runs on thinned data about its own estimate, iterated until
        attitudes settle; each pass over all data is linearised about the smoothed trajectory before it, and another
        follows only where one moved the result by more than a hundredth of its standard deviation. With 0, a single
        extended Kalman filter over all data about its own estimate.
    gate_probability : float
        A measurement is edited where its normalised innovation squared is beyond this chi-square quantile.
    verdict_confidence : float
        Two-sided confidence of each verdict.
    angle_noise : str
        ``"traverse"`` or ``"axis"``, see `recon.measurements`.
    consider : tuple of str
        Errors that are not estimated but whose effect stays in the covariance: ``"accelerometer mount"``, ...
    without : tuple of str
        Sources (radars, receivers, barometers; ``"magnetometer"``, ``"sun1"``, ... where attitude sensors are on) that
        are predicted but never used, not even for the start.
    withhold_every : int
        Every so many measurements of each tracker one is predicted but not used; 0 for none.
    withhold_s : tuple of (float, float)
        Spans in which no tracker is used, all are predicted.
    attitude_sensors : bool
        Whether magnetometer and Sun sensors are measurements too; otherwise they only start and check the attitude.
    engine, smoother : str
        ``"compiled"`` or ``"readable"``; ``"rauch-tung-striebel"`` or ``"bryson-frazier"``. Where errors are considered
        there is one smoother alone, see `recon.smoother`.
    """

    output_rate_hz: float = 20.0
    pulse_rate_hz: float = 0.0
    start_s: float | None = None
    end_s: float | None = None
    passes: int = 3
    gate_probability: float = 0.9999
    check_confidence: float = 0.999
    angle_noise: str = "traverse"
    consider: tuple[str, ...] = ()
    without: tuple[str, ...] = ()
    withhold_every: int = 0
    withhold_s: tuple[tuple[float, float], ...] = ()
    attitude_sensors: bool = False
    engine: str = "compiled"
    smoother: str = "rauch-tung-striebel"

    def __post_init__(self) -> None:
        """Check once."""
        faults = []
        if not 0.1 <= self.output_rate_hz <= 1000.0:
            faults.append(f"output_rate_hz {self.output_rate_hz} must lie in 0.1 to 1000")
        if self.pulse_rate_hz != 0.0 and not 0.1 <= self.pulse_rate_hz <= 1000.0:
            faults.append(f"pulse_rate_hz {self.pulse_rate_hz} must be 0 or lie in 0.1 to 1000")
        if not 0 <= self.passes <= 10:
            faults.append(f"passes {self.passes} must lie in 0 to 10")
        if self.withhold_every != 0 and not 2 <= self.withhold_every <= 1000:
            faults.append(f"withhold_every {self.withhold_every} must be 0 (none) or lie in 2 to 1000")
        faults += [f"withhold_s {a:g} to {b:g} s: a span ends after it begins" for a, b in self.withhold_s if not a < b]
        for name in ("gate_probability", "check_confidence"):
            if not 0.5 <= getattr(self, name) < 1.0:
                faults.append(f"{name} {getattr(self, name)} must lie in 0.5 to 1 (1 excluded)")
        for name, known in (("angle_noise", ("traverse", "axis")), ("engine", ENGINES), ("smoother", SMOOTHERS)):
            value = getattr(self, name)
            if value not in known:
                faults.append(f"{name} '{value}'{nearest_name(value, known)} must be one of {', '.join(known)}")
        if faults:
            raise GateError(faults)
