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
# # One flight, and how far its aeroshell deflected
#
# A flight folder goes in; a trajectory, three estimates of the deflection and their consistency come out. The flight
# is **synthetic** unless `POSTFLIGHT_FLIGHT` names a folder of your own: nothing below, up to the last section, looks
# at its truth.

# %%
# %matplotlib inline
import os
from pathlib import Path

import numpy as np
import pandas as pd
from IPython.display import display

import postflight as pf

folder = Path(os.environ.get("POSTFLIGHT_FLIGHT", "../demo-flight"))
if not (folder / "flight.toml").exists():
    pf.simulate("irve2_reference", folder)

# %% [markdown]
# ## What was measured
#
# Two radars, accelerometers in their own clocked package, rate gyros, the day's sounding, and video. The gate checks
# all of it; what an analyst should know of the data is a finding, not a repair.

# %%
flight = pf.read_flight(folder)
print(*(finding.line for finding in flight.findings), sep="\n")
flight

# %% [markdown]
# ## The best-estimated trajectory, and how we know
#
# Radars measure the position, accelerometers and gyros the motion between; filter and smoother weigh them, and estimate
# the sensors' own errors. If the assumptions hold, the residuals are as large as predicted and white.

# %%
bet = pf.reconstruct(flight)
bet

# %%
pd.DataFrame([(c.name, c.passed, round(c.value, 3), c.remark) for c in bet.consistency_checks],
             columns=["consistency check", "passed", "value", "remark"])  # fmt: skip

# %%
pf.plots.figure_residuals(bet)

# %% [markdown]
# ## The anomaly
#
# A rigid vehicle, flown sixty times from the reconstructed state with pre-flight uncertainties, gives the grey band.
# The flight leaves it: total angle of attack by several degrees, normal acceleration by several times.

# %%
pf.plots.figure_1_3(bet, flights=60)

# %% [markdown]
# ## The contrast
#
# All aerodynamic force is on the aeroshell, so $a_N/(-a_x) = C_N/C_A$ of the *shell's* angle of attack. Without a
# deflection the accelerometers ask for an angle that the trajectory excludes.

# %%
pf.plots.figure_2_5(bet)

# %% [markdown]
# ## Three ways to the deflection
#
# 1. **Video**: for which deflection does a virtual camera, oriented on the benchmark frame, see the shell's edge where
#    the onboard camera saw it?
# 2. **Misalignment**: which deflection reconciles the measured force with the trajectory's angle of attack?
# 3. **Trim**: which sideways shift of the c.g. balances the moments at the angle that was flown?

# %%
answer = pf.fuse(bet)
answer

# %%
pf.plots.figure_2_7(answer)

# %%
if "camera" in answer:
    display(pf.plots.figure_2_3(answer))

# %% [markdown]
# ## The claim
#
# The three share the trajectory's angle of attack, but err in different ways: lens and benchmark, accelerometer mount,
# coefficients and c.g. offset. Through the pressure pulse they agree within their error bars.

# %%
grid = np.arange(bet.peak_s - 6.0, bet.peak_s + 6.0, 0.1)
at = {m: np.array([answer[m].at(t)[["theta_deg", "theta_sd_deg"]] for t in grid]) for m in answer}
names = list(at)
for k, one in enumerate(names):
    for other in names[k + 1 :]:
        gap = at[one][:, 0] - at[other][:, 0]
        sd = np.hypot(at[one][:, 1], at[other][:, 1])
        share = float(np.mean(np.abs(gap) < 2.0 * sd))
        print(f"{one} and {other}: within two combined standard deviations at {100 * share:.0f} % of the pulse")
        assert share > 0.8

# %% [markdown]
# ## Only now, the truth
#
# For a synthetic flight the truth lies apart in `truth/`. It was not used above; here it is laid over the answers.

# %%
if (folder / "truth" / "deflection.csv").exists():
    truth = pd.read_csv(folder / "truth" / "deflection.csv")
    overlay = (truth["t_s"].to_numpy(), truth["theta_deg"].to_numpy())
    display(pf.plots.figure_summary(answer, truth=overlay))
