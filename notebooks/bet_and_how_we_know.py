# ---
# jupyter:
#   jupytext:
#     formats: ipynb,py:percent
#     text_representation:
#       extension: .py
#       format_name: percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # The best-estimated trajectory, and how we know
#
# Two radars measure where the vehicle was, accelerometers and gyros how it moved between. Filter and smoother weigh
# them and give a trajectory with a covariance. The covariance is the claim; this notebook tests it in ways that need no
# truth, plants a fault that they must find, and only then looks at the truth. The flight is **synthetic** and short:
# the 46 s about its pressure pulse.

# %%
# %matplotlib inline
import re
from dataclasses import replace
from pathlib import Path
from tempfile import mkdtemp

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from scipy.stats import chi2

import postflight as pf

folder = Path(mkdtemp()) / "flight"
text = Path(pf.read_scenario("irve2_reference").source).read_text()
for pattern, new in (
    (r"(?m)^stop_s = 530\.0", "stop_s = 458.0"),
    (r"telemetry_from_s = 300\.0", "telemetry_from_s = 412.0"),
    (r"(?m)^t_s = 300\.0", "t_s = 412.0"),
    (r"rate_hz = 250\.0", "rate_hz = 100.0"),
    (r"rate_hz = 4\.0", "rate_hz = 0.1"),
):
    text = re.sub(pattern, new, text)
(folder.parent / "short.toml").write_text(text)
pf.simulate(folder.parent / "short.toml", folder, seed=3)
flight = pf.read_flight(folder)
bet = pf.reconstruct(flight)
bet

# %% [markdown]
# ## Residuals: as large as predicted, and white?
#
# Every measurement is predicted before it is used. Divided by its predicted standard deviation, the residual must be a
# draw from a unit normal, independent of the one before.

# %%
residuals = bet.solution.residuals
normal = residuals["residual"] / residuals["predicted_sd"]
figure, axis = plt.subplots(figsize=(9, 3))
for source, rows in residuals.groupby("source"):
    axis.plot(rows["time_s"], normal[rows.index], ".", ms=2, label=source)
axis.set(ylabel="residual / predicted sd", xlabel="time after launch, s")
axis.legend()
pd.DataFrame([(c.name, c.passed, round(c.value, 3), c.remark) for c in bet.consistency_checks],
             columns=["consistency check", "passed", "value", "remark"])  # fmt: skip

# %% [markdown]
# ## Does a planted fault turn a consistency check red?
#
# A test that cannot fail proves nothing. One radar is moved by 60 m in range halfway through, which no data sheet
# allows for, and everything is done again.

# %%
telemetry = flight.telemetry
name = next(iter(telemetry.radars))
radar = telemetry.radars[name]
moved = radar.range_az_el.copy()
moved[radar.time_s > 440.0, 0] += 60.0
faulty = replace(telemetry, radars={**telemetry.radars, name: replace(radar, range_az_el=moved)})
red = [c.name for c in pf.reconstruct(replace(flight, telemetry=faulty)).consistency_checks if not c.passed]
print("red with the fault:", *red, sep="\n  ")

# %% [markdown]
# ## Only now the truth
#
# The error, in units of the stated standard deviation, of position, velocity and attitude through the flight.

# %%
table = pd.read_csv(folder / "truth" / "truth.csv")
estimate = bet.trajectory
inside = (table["t_s"] >= estimate.time_s[0]) & (table["t_s"] <= estimate.time_s[-1])
rows = table[inside].iloc[::5]
columns = (("r{}_ecef_m", "xyz"), ("v{}_ecef_mps", "xyz"), ("q{}_ecef_body", "wxyz"), ("{}_body_degps", "pqr"))
at = [rows[[name.format(letter) for letter in letters]].to_numpy() for name, letters in columns]
q = at[2] / np.linalg.norm(at[2], axis=1)[:, None]
true = pf.Trajectory(telemetry.t0_utc, rows["t_s"].to_numpy(), estimate.point, at[0], at[1], q, np.deg2rad(at[3]))
mine = estimate.at(true.time_s)
error = mine.minus(true)
normalised = error / mine.sd()
figure, axes = plt.subplots(3, 1, sharex=True, figsize=(9, 5))
for k, what in enumerate(("position", "velocity", "attitude")):
    axes[k].plot(true.time_s, normalised[:, 3 * k : 3 * k + 3])
    axes[k].axhspan(-3, 3, color="0.9", zorder=0)
    axes[k].set_ylabel(f"{what} error / sd")
axes[0].legend(["x", "y", "z"], ncols=3)
axes[2].set_xlabel("time after launch, s")
share = np.mean(np.abs(normalised) < 3.0, axis=0)
squared = np.einsum("ni,nij,nj->n", error, np.linalg.inv(mine.covariance), error)
print(f"inside 3 sd: {share.min():.2f} of the time at least; mean squared error over covariance {squared.mean():.1f} "
      "where 9 is expected")  # fmt: skip

# %% [markdown]
# ## The claim
#
# All consistency checks of the sound flight pass; the planted fault turns at least one red, and one of these names the
# radar; and the errors, which nothing above has seen, lie inside three of the stated standard deviations.

# %%
assert all(c.passed for c in bet.consistency_checks)
radar_name = next(iter(telemetry.radars))
assert any(radar_name in check for check in red)
assert share.min() > 0.95
low, high = chi2.ppf([0.005, 0.995], 9)  # errors last as long as the flight: they are one draw of nine
assert low < squared.mean() < high
print("proved: the covariance is honest here, and a fault is detected")
