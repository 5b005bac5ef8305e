# ---
# jupyter:
#   jupytext:
#     formats: ipynb,py:percent
#     text_representation:
#       extension: .py
#       format_name: percent
#       format_version: '1.3'
#       jupytext_version: 1.19.6
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # Recorded flights: does the trajectory predict held-out measurements?
#
# A simulator may share its errors with the filter that is tested on it. A recorded flight shares nothing: its receiver
# lags, its barometer fails at the speed of sound, its radar repeats itself. But there is no truth to compare with. What
# there is: tracking that the filter was not given. If the trajectory and its standard deviations are honest, they
# predict it, with residuals as large as stated.
#
# **Prometheus** (2022, Spaceport America; data of RocketPy-Team/RocketPy, MIT licence) flew to 5.5 km. Its inertial
# unit was dead; a receiver and a barometer are all there is. Other flights are used where `POSTFLIGHT_REALDATA` names
# the folder of their data.

# %%
# %matplotlib inline
import os
import re
import shutil
from pathlib import Path
from tempfile import mkdtemp

import erfa
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd

import postflight as pf

TREE = Path("../tests/data/real_flights")
REAL = os.environ.get("POSTFLIGHT_REALDATA")
BLUE, ORANGE, GREY = "#0072B2", "#D55E00", "0.55"


def flight(name, *edits):
    """Read a recorded flight, its flight.toml edited by (pattern, text)."""
    folder = Path(mkdtemp())
    tables = TREE / name if any((TREE / name).glob("*.csv")) else Path(REAL) / name
    for path in tables.glob("*.csv"):
        shutil.copy(path, folder)
    text = (TREE / name / "flight.toml").read_text()
    for pattern, new in edits:
        text = re.sub(pattern, new, text)
    (folder / "flight.toml").write_text(text)
    return pf.read_flight(folder)


def height(position):
    return erfa.gc2gd(1, position)[2]


# %% [markdown]
# ## What was measured, and what the analyst stated
#
# `flight.toml` states noise that was read off the data (differences of successive fixes, scatter about smooth curves),
# and which rows are wrong. Every second fix and nine barometer readings of ten are left out: neighbours repeat each
# other's errors, and a filter that counts an error ten times states too small a standard deviation.

# %%
prometheus = flight("rocketpy_prometheus")
print(*(finding.line for finding in prometheus.findings), sep="\n")
bet = pf.reconstruct(prometheus)
pd.DataFrame([vars(v) for v in bet.consistency_checks])[["name", "value", "low", "high", "passed"]]

# %%
path = bet.trajectory
t, h = path.time_s, height(path.position_ecef_m)
fixes, baro = prometheus.telemetry.gnss["gps"], prometheus.telemetry.barometers["baro"]
figure, (whole, low) = plt.subplots(2, 1, figsize=(8, 7), layout="constrained", height_ratios=(2, 1), sharex=True)
whole.plot(baro.time_s, baro.height_m / 1e3, ".", ms=1.5, color=ORANGE, label="barometer in the standard's air")
whole.plot(fixes.time_s, height(fixes.position_ecef_m) / 1e3, ".", ms=4, color=GREY, label="receiver")
whole.plot(t, h / 1e3, color=BLUE, lw=1.2, label="reconstructed")
whole.set_ylabel("height above the ellipsoid (km)")
whole.legend(frameon=False)
speed = np.linalg.norm(path.velocity_ecef_mps, axis=1)
sd = np.linalg.norm(path.sd()[:, 3:6], axis=1)
low.fill_between(t, np.maximum(speed - sd, 0), speed + sd, color=BLUE, alpha=0.25, lw=0)
low.plot(t, speed, color=BLUE, lw=1.2)
low.set(ylabel="speed (m/s), 1 sd", xlabel="time after launch (s)", ylim=(0, 350))
figure.suptitle("Prometheus: thrust, coast, drogue at 29 s, main parachute at 158 s")
plt.show()

# %% [markdown]
# The barometer is several hundred metres low at apogee: the day was hot, and the standard's air is 6 % thinner from top
# to bottom. The filter estimates that from the receiver.

# %%
bet.solution.sensor_errors.set_index("name").loc[["baro bias", "baro scale", "vehicle drag"]]

# %% [markdown]
# ## Predicting the held-out fixes
#
# Each held-out measurement has a residual against the smoothed trajectory, and a predicted standard deviation that
# holds the trajectory's covariance, the receiver's slow errors and its noise. Their ratio should scatter by about one.

# %%
scarce = pf.reconstruct(prometheus.with_(hold_out_every=2)).solution  # every fourth fix is used, three are predicted
held_out = scarce.held_out.assign(z=scarce.held_out["residual"] / scarce.held_out["predicted_sd"])
table = held_out.groupby(["source", "component"])["z"].agg(
    count="size", rms_normalised=lambda z: np.sqrt(np.mean(z**2)), inside_3_sd=lambda z: np.mean(np.abs(z) < 3.0)
)
table.round(3)


# %%
def normalised(axes, source):
    rows = held_out[held_out.source == source]
    for ax, (component, part) in zip(axes, rows.groupby("component", sort=False), strict=True):
        z = part.z
        ax.axhspan(-2, 2, color="0.92", lw=0)
        ax.plot(part.time_s, z, ".", ms=3, color=BLUE)
        ax.set(ylim=(-5, 5), ylabel=f"{component}\nrms {np.sqrt(np.mean(z**2)):.2f}")
    axes[-1].set_xlabel("time after launch (s)")


figure, axes = plt.subplots(3, 1, figsize=(8, 5.5), sharex=True, layout="constrained")
normalised(axes, "gps")
figure.suptitle("Held-out fixes against the trajectory, in predicted standard deviations (grey: two of them)")
plt.show()

# %% [markdown]
# ## With nothing stated
#
# Now the analyst's statements are removed: no spans of thrust and parachutes, all fixes with however few satellites,
# all heights through the speed of sound. Ballistic motion then cannot follow the track: the filter has to detect where,
# allow an unmodelled acceleration there and report it; the barometer's transonic error has to be edited.

# %%
stated = ((r"(?m)^powered_s = .*\n", ""), (r"(?m)^use_s = .*\n", ""), (r"(?m)^min_satellites.*\n", ""))
raw_flight = flight("rocketpy_prometheus", *stated)
raw = pf.reconstruct(raw_flight).solution
found = [f for f in raw.findings if f.source == "motion"]
print(*found, sep="\n")

figure, ax = plt.subplots(figsize=(8, 4), layout="constrained")
for f in found:
    ax.axvspan(f.start_s, f.end_s, color="#E69F00", alpha=0.35, lw=0)
raw_baro = raw_flight.telemetry.barometers["baro"]
raw_h = height(raw.smoothed.position_ecef_m)
ax.plot(raw_baro.time_s, raw_baro.height_m - np.interp(raw_baro.time_s, raw.smoothed.time_s, raw_h), ".", ms=1.5,
        color=ORANGE, label="barometer less trajectory")  # fmt: skip
edited = raw.residuals[(raw.residuals.source == "baro") & raw.residuals.used & ~raw.residuals.accepted]
offset = np.interp(edited.time_s, raw_baro.time_s, raw_baro.height_m) - np.interp(
    edited.time_s, raw.smoothed.time_s, raw_h
)
ax.plot(edited.time_s, offset, "x", color="black", ms=6, label="edited")
ax.set(xlim=(-2, 60), xlabel="time after launch (s)", ylabel="m")
ax.set_title("Unmodelled accelerations (shaded), and a barometer at the speed of sound")
ax.legend(frameon=False)
plt.show()
apart = np.interp(t, raw.smoothed.time_s, raw_h) - h
under_drogue = (t > 45) & (t < 150)
print(f"under the drogue the two heights differ by at most {np.abs(apart[under_drogue]).max():.1f} m")

# %% [markdown]
# ## Others
#
# *NASA 36.353*: one radar, no point for a minute after lift-off, apogee 294 km, re-entry, a track lost in the end.
# *PSAS Launch 12*: an inertial unit that shakes for eight seconds, then half a minute without a fix. Both only where
# their data are.

# %%
others = {}
if REAL:
    others["Black Brant"] = brant = pf.reconstruct(flight("radar_36353", (r"(?m)^use_s = .*\n", ""))).solution
    others["PSAS"] = psas = pf.reconstruct(flight("psas_l12")).solution
    figure, (left, right) = plt.subplots(1, 2, figsize=(11, 4), layout="constrained")
    for ax, one, title in (
        (left, brant, "Black Brant: no track in the first minute"),
        (right, psas, "PSAS: 31 s without a fix"),
    ):
        ax.semilogy(one.smoothed.time_s, np.linalg.norm(one.filtered.sd()[:, :3], axis=1), color=GREY, label="filter")
        ax.semilogy(one.smoothed.time_s, np.linalg.norm(one.smoothed.sd()[:, :3], axis=1), color=BLUE, label="smoother")
        ax.set(xlabel="time after launch (s)", ylabel="sd of position (m)", title=title)
        ax.legend(frameon=False)
    plt.show()
    first = psas.residuals[psas.residuals.used & (psas.residuals.time_s > 30)].head(3)
    print(first[["time_s", "component", "residual", "predicted_sd"]].to_string(index=False))
    assert (np.abs(first.residual) < 3.3 * first.predicted_sd).all()

# %% [markdown]
# ## The claim
#
# A trajectory from every fourth fix predicts the other three of Prometheus's fixes within its stated uncertainty:
# normalised residuals of each axis between 0.7 and 1.4 rms. All its consistency checks pass, apogee is the receiver's
# own to 12 m, and without statements on thrust and parachutes the result under the drogue is the same to 10 m.

# %%
gps = table.loc["gps"]
assert gps.rms_normalised.between(0.7, 1.4).all()
assert all(v.passed for v in bet.consistency_checks)
assert abs(h.max() - 5500.0) < 12.0
assert np.abs(apart[under_drogue]).max() < 10.0
print("proved:", gps.rms_normalised.round(2).to_dict())
