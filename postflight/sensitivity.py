"""How much does the result depend on each source and on each assumption? Reruns without it, and the changes.

Each tracker is left out in turn, attitude sensors that were not used are used (or left out), the initial attitude is
taken from them, winds are set to zero, the sounding's density and the mass are changed by their uncertainty. Beside the
reported standard deviation stands the expected one of the change: where a rerun has a subset of the base's data and the
rest is the same, the difference of two optimal estimates has covariance ``P_without - P_with`` (Hausman). A change of
three of these, not of three reported standard deviations, means that a source contradicts the others.

With inertial sensors the trajectory does not depend on atmosphere and mass: only derived quantities are computed anew.
In ballistic flight it does, and the filter runs again.

References
----------
J. Hausman, "Specification tests in econometrics", Econometrica 46 (1978) 1251.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pandas as pd

from flightmodel import earth
from flightmodel.airdata import air_data, pressure_pulse
from flightmodel.checks import FloatArray, GateError, Progress
from flightmodel.tables import column_about
from flightmodel.telemetry import Telemetry
from flightmodel.trajectory import Trajectory, difference, interpolate_rows, resample
from postflight.flight import Flight, calm, with_density, with_mass
from postflight.reconstruction import Reconstruction, bet_table, reconstruction_from
from recon.estimate import estimate, trackers
from recon.settings import Settings

MASS_PART = 0.01
PULSE_STEP_S = 0.1
COLUMNS = (
    "rerun", "quantity", "unit", "t_s", "base", "base_sd", "change", "change_over_sd", "expected_sd",
    "change_over_expected_sd", "largest_change", "largest_at_s", "reason",
)  # fmt: skip
# quantity: its unit, and its column in bet.csv; day_kgpm3 is the sounding's density times the ratio found
DERIVED = {
    "altitude": ("m", "alt_m"),
    "total angle of attack": ("deg", "alpha_total_wind_deg"),
    "Mach number": ("1", "mach"),
    "dynamic pressure": ("Pa", "dynamic_pressure_pa"),
    "density of the day": ("kg/m^3", "day_kgpm3"),
    "density ratio": ("1", "density_ratio"),
    "C_A": ("1", "c_a"),
    "C_N": ("1", "c_n"),
    "C_N/C_A": ("1", "cn_over_ca"),
}
# quantity: its unit, its index in the trajectory's errors in NED and body axes, and its scale
DIRECT = {
    "position north": ("m", 0, 1.0),
    "position east": ("m", 1, 1.0),
    "velocity north": ("m/s", 3, 1.0),
    "velocity east": ("m/s", 4, 1.0),
    "velocity down": ("m/s", 5, 1.0),
    "rotation about body x": ("deg", 6, 180.0 / np.pi),
    "rotation about body y": ("deg", 7, 180.0 / np.pi),
    "rotation about body z": ("deg", 8, 180.0 / np.pi),
}
UNITS = {name: about[0] for name, about in {**DIRECT, **DERIVED}.items()}
# groups of the printed table and the figure, by the quantity that changed most
GROUPS = {
    "position": ("position north", "position east", "altitude"),
    "velocity": ("velocity north", "velocity east", "velocity down"),
    "attitude": ("rotation about body x", "rotation about body y", "rotation about body z"),
} | {
    name: (name,) for name in ("total angle of attack", "Mach number", "dynamic pressure", "density of the day", "C_A")
}


@dataclass(frozen=True)
class Rerun:
    """One changed input.

    Parameters
    ----------
    name : str
    telemetry : Telemetry
    settings : Settings
    filtered : bool
        Whether the trajectory itself depends on the change.
    data : int
        -1 where data were left out, 1 where some were added, 0 otherwise.
    """

    name: str
    telemetry: Telemetry
    settings: Settings
    filtered: bool = True
    data: int = 0


def reruns(telemetry: Telemetry, settings: Settings) -> tuple[Rerun, ...]:
    """Return the reruns that a flight allows."""
    ballistic = telemetry.accelerometer is None or telemetry.motion.model == "ballistic"
    leave: dict[str, tuple[str, ...]] = {f"without {name}": (name,) for name in trackers(telemetry, settings)}
    heads = () if telemetry.sun is None else tuple(f"sun{k + 1}" for k in range(len(telemetry.sun.spec.clock_lv_rad)))
    directions = telemetry.magnetometer is not None and telemetry.sun is not None
    if settings.attitude_sensors:
        leave |= {"without magnetometer": ("magnetometer",)} if telemetry.magnetometer is not None else {}
        leave |= {"without Sun sensors": heads} if heads else {}
    out = [
        Rerun(name, telemetry, replace(settings, without=(*settings.without, *gone)), data=-1)
        for name, gone in leave.items()
    ]
    if not ballistic and not settings.attitude_sensors and (telemetry.magnetometer is not None or heads):
        out.append(Rerun("with attitude sensors", telemetry, replace(settings, attitude_sensors=True), data=1))
    if not ballistic and directions and telemetry.attitude_prior is not None:
        out.append(Rerun("without attitude prior", replace(telemetry, attitude_prior=None), settings))
    sounding = telemetry.sounding
    air = {"winds off": calm(sounding)}
    air |= {f"density {sign:+d} sd": with_density(sounding, np.exp(sign * sounding.density_sd)) for sign in (1, -1)}
    out += [Rerun(name, replace(telemetry, sounding=s), settings, ballistic) for name, s in air.items()]
    if telemetry.vehicle is not None or ballistic:
        for part in (MASS_PART, -MASS_PART):
            out.append(Rerun(f"mass {100 * part:+.0f} %", with_mass(telemetry, 1.0 + part), settings, ballistic))
    return tuple(out)


def sensitivity(flight: Reconstruction, progress: Progress | None = None) -> pd.DataFrame:
    """Rerun a reconstructed flight with each source left out and each assumption changed.

    Parameters
    ----------
    flight : Flight
    progress : callable, optional
        Called with the fraction done and the rerun.

    Returns
    -------
    DataFrame
        One row a rerun and quantity, at the base's largest dynamic pressure ``t_s``: base value (empty for position and
        rotation, which are given as changes alone) and its standard deviation, the rerun's change, that over the
        standard deviation, over ``expected_sd`` (empty where the rerun is no subset of the base's data, or hardly
        changes the variance), and the largest change over the pulse. A rerun that fails is one row with its ``reason``.
    """
    report = progress or (lambda _fraction, _what: None)
    telemetry, settings = flight.telemetry, flight.solution.settings
    planned = reruns(telemetry, settings)
    adaptation = flight.solution.adaptation  # other priors would add to the change
    report(0.0, "base")
    # where a tracker was left out the base's covariance was enlarged, and is not that of an optimal filter
    own = flight
    if flight.solution.left_out:
        own = reconstruction_from(Flight(telemetry), estimate(telemetry, settings, adaptation=adaptation))
    rows: list[dict[str, object]] = []
    for k, rerun in enumerate(planned):
        report(k / len(planned), rerun.name)
        try:
            bet = flight.solution
            if rerun.filtered:
                bet = estimate(rerun.telemetry, rerun.settings, adaptation=adaptation)
            rows += _rows(rerun, flight, own, reconstruction_from(Flight(rerun.telemetry), bet))
        except GateError as fault:
            rows.append({"rerun": rerun.name, "reason": str(fault)})
    report(1.0, "done")
    return pd.DataFrame(rows, columns=list(COLUMNS))


def _rows(rerun: Rerun, base: Reconstruction, own: Reconstruction, other: Reconstruction) -> list[dict[str, object]]:
    """Every quantity of one rerun; `GateError` where it does not cover the peak."""
    at, peak = _times(base, other.solution.smoothed)
    views = [View.of(flight, at) for flight in (base, own, other)]
    change = views[2].minus(views[0])
    out: list[dict[str, object]] = []
    for name, unit in UNITS.items():
        moved, (sd, own_sd, other_sd) = change[name], (view.sd[name][peak] for view in views)
        if not np.isfinite(sd):
            continue
        gained = rerun.data * (own_sd**2 - other_sd**2)
        # a change can be judged where the variance changes by so much
        expected = float(np.sqrt(gained)) if gained > 0.02 * sd**2 else np.nan
        largest = int(np.nanargmax(np.abs(moved))) if np.isfinite(moved).any() else peak
        value = views[0].value[name][peak] if name in views[0].value else np.nan
        here = moved[peak]
        row = (
            rerun.name, name, unit, at[peak], value, sd, here, here / sd, expected, here / expected, moved[largest],
            at[largest], "",
        )  # fmt: skip
        out.append(dict(zip(COLUMNS, row, strict=True)))
    return out


def _times(base: Reconstruction, other: Trajectory) -> tuple[FloatArray, int]:
    """Times (k,) of the pulse that both cover, about `PULSE_STEP_S` apart, and which of them is the peak."""
    t = base.air.time_s
    peak_s = float(t[np.argmin(np.abs(t - base.peak_s))])
    if not other.time_s[0] <= peak_s <= other.time_s[-1]:
        raise GateError(
            f"reaches from {other.time_s[0]:.3f} to {other.time_s[-1]:.3f} s only; the largest dynamic pressure is at "
            f"{peak_s:.3f} s",
            code="time-not-covered",
        )
    pulse = t[pressure_pulse(base.air.dynamic_pressure_pa)]
    pulse = pulse[(pulse >= other.time_s[0]) & (pulse <= other.time_s[-1])]
    _, first = np.unique(np.floor(pulse / PULSE_STEP_S + 1e-6), return_index=True)
    at = np.union1d(pulse[first], [peak_s])
    return at, int(np.searchsorted(at, peak_s))


@dataclass(frozen=True)
class View:
    """A flight at chosen times (k,): trajectory, values and standard deviations of the quantities."""

    trajectory: Trajectory
    value: dict[str, FloatArray]
    sd: dict[str, FloatArray]

    @classmethod
    def of(cls, flight: Reconstruction, at: FloatArray) -> View:
        """Flight at times ``at`` (k,)."""
        cut = at_times(flight, at)
        path, table = cut.solution.smoothed, bet_table(cut)
        for column, ratio in (("day_kgpm3", "density_ratio"), ("day_sd_kgpm3", "density_ratio_sd")):
            table[column] = table[ratio] * table["rho_kgpm3"]
        turn = _turn(path)
        assert path.covariance is not None
        spread = np.sqrt(np.diagonal(turn @ path.covariance @ np.swapaxes(turn, 1, 2), axis1=1, axis2=2))
        value = {name: table[column].to_numpy(dtype=float) for name, (_, column) in DERIVED.items()}
        sd = {name: table[column_about(column)].to_numpy(dtype=float) for name, (_, column) in DERIVED.items()}
        velocity = np.einsum("nij,nj->ni", turn[:, 3:6, 3:6], path.velocity_ecef_mps)
        for name, (_, k, scale) in DIRECT.items():
            known = flight.has_attitude or k < 6
            sd[name] = scale * spread[:, k] if known else np.full(len(at), np.nan)
            if 3 <= k < 6:
                value[name] = velocity[:, k - 3]
        return cls(path, value, sd)

    def minus(self, base: View) -> dict[str, FloatArray]:
        """Changes (k,) of every quantity against the base."""
        moved = np.einsum("nij,nj->ni", _turn(base.trajectory), difference(self.trajectory, base.trajectory))
        out = {name: scale * moved[:, k] for name, (_, k, scale) in DIRECT.items()}
        return out | {name: self.value[name] - base.value[name] for name in DERIVED}


def at_times(flight: Reconstruction, at: FloatArray) -> Reconstruction:
    """Flight whose trajectory and air are given at times ``at`` (k,) alone."""
    bet, telemetry = flight.solution, flight.telemetry
    t, path = bet.smoothed.time_s, resample(bet.smoothed, at)
    force, rate = (
        interpolate_rows(at, t, c.reshape(-1, 9)).reshape(-1, 3, 3) if len(c) else c
        for c in (bet.specific_force_cov, bet.rate_cov)
    )
    arm = np.zeros(3) if telemetry.vehicle is None else telemetry.vehicle.cg_m
    air = air_data(path, flight.profile, arm)
    return replace(
        flight, solution=replace(bet, smoothed=path, specific_force_cov=force, rate_cov=rate), air=air, loads=None
    )


def _turn(path: Trajectory) -> FloatArray:
    """Matrices (k, 9, 9) of errors from ECEF to north, east, down; rotations stay about body axes."""
    latitude, longitude, _ = earth.geodetic_from_ecef(path.position_ecef_m, path.planet)
    out = np.tile(np.eye(9), (len(path.time_s), 1, 1))
    out[:, 0:3, 0:3] = out[:, 3:6, 3:6] = earth.dcm_ned_ecef(latitude, longitude)
    return out


def largest_of_groups(table: pd.DataFrame) -> pd.DataFrame:
    """Rows of `sensitivity` with the largest change in standard deviations, one a rerun and ``group``.

    Failed reruns have no rows.
    """
    rows = []
    for _, part in table[table["quantity"].notna()].groupby("rerun", sort=False):
        for group, names in GROUPS.items():
            some = part[part["quantity"].isin(names) & part["change_over_sd"].notna()]
            if len(some):
                rows.append({"group": group, **some.loc[some["change_over_sd"].abs().idxmax()]})
    return pd.DataFrame(rows, columns=["group", *table.columns])
