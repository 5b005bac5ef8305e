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
# # Three methods, one answer
#
# Film, accelerometers and the balance of moments each say how far the shell bent. They lean on different things,
# but not only on different ones: accelerometers and trim share the trajectory's angle of attack. So their answers
# may not be averaged as if independent. This essay fuses them with what they share, asks whether they agree, then
# plants an error in one and asks again. **Synthetic** flight; the truth comes last.

# %%
# %matplotlib inline
import os
from dataclasses import replace
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd

from flightmodel.checks import DivergenceError
from postflight.flight import METHODS, estimate, reconstruct_flight
from postflight.fusing import agreement_table, fuse_flight, input_table

folder = Path(os.environ.get("POSTFLIGHT_FLIGHT", "../demo-flight"))
if not (folder / "flight.toml").exists():
    from synthetic_flight.folder import simulate_to_folder
    from synthetic_flight.scenarios import read_scenario

    simulate_to_folder(read_scenario("irve2_reference"), 0, folder)
flight = reconstruct_flight(folder)
answers = estimate(flight, flight.telemetry, METHODS)

# %% [markdown]
# ## Three answers, and the one of all

# %%
figure, axis = plt.subplots(figsize=(9, 4))
for method, history in answers.histories.items():
    theta, sd = np.rad2deg(history.theta_rad), np.rad2deg(history.theta_sd_rad)
    axis.plot(history.time_s, theta, label=method)
    axis.fill_between(history.time_s, theta - sd, theta + sd, alpha=0.2)
axis.set_xlim(425, 452)
axis.set_ylabel("deflection deg")
axis.legend()
at_peak = {m: np.rad2deg(h.at(flight.peak_s)) for m, h in answers.histories.items()}
pd.DataFrame(at_peak, index=["deflection deg", "sd deg"]).T.round(3)

# %% [markdown]
# ## Do they agree?
#
# The difference of two readings holds no bending, only what they lean on; its chi-square is the test of the pair.

# %%
print(answers.fused.agreement.remark)
agreement_table(answers.fused)

# %% [markdown]
# ## What was learnt of what they lean on
#
# The share of each input's prior standard deviation that is left. Near 1: the flight says nothing of it.

# %%
input_table(answers.fused)

# %% [markdown]
# ## Planted: a camera that looks elsewhere
#
# The same answers, but the film's are turned by 40 deg, as if the camera were clocked otherwise than its drawing
# says. Its angles alone still look right: a comparison of angles would pass. The test compares both components.

# %%
camera = answers.histories["camera"]
turned = replace(camera, plane_lv_rad=camera.plane_lv_rad + np.deg2rad(40.0))
try:
    misled = fuse_flight(flight.loads, turned).agreement.remark
except DivergenceError as fault:
    misled = str(fault)
print(misled)

# %% [markdown]
# ## The claim
#
# The three agree by their own tests, the common answer is narrower than each alone, and the truth, looked at only
# now, lies within three standard deviations of every one. With the camera turned the tests say that something is
# wrong.

# %%
truth = pd.read_csv(folder / "truth" / "deflection.csv")
true_deg = float(np.interp(flight.peak_s, truth["t_s"], truth["theta_deg"]))
for method, (theta, sd) in at_peak.items():
    print(f"{method}: {theta:.2f} +/- {sd:.2f} deg, truth {true_deg:.2f}, off by {(theta - true_deg) / sd:+.1f} sd")
    assert abs(theta - true_deg) < 3.0 * sd
assert all(pair.p_value > 0.01 for pair in answers.fused.agreement.pairs)
assert all(at_peak["fused"][1] < at_peak[m][1] for m in at_peak if m != "fused")
assert "the camera's orientation, benchmark or plane explains it best" in misled
print("proved: one answer, and a test that notices when it is none")
