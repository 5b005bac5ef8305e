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
# # Seeing the shell bend
#
# A camera on the centerbody looks at the back of the aeroshell. Between a frame in which the shell is not bent and
# one at peak pressure its edge moves by some pixels. A *virtual camera* that knows shell and lens asks: for which
# bending would I see the edge there? The film here is **synthetic**: rendered by another program than the one that
# reads it, with noise, blur and compression; its truth is in a folder that the estimator does not open.

# %%
# %matplotlib inline
import os
from pathlib import Path
from tempfile import TemporaryDirectory

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from IPython.display import Image, display

from flightmodel.flightfolder import read_flight
from postflight.flight import estimate_camera
from postflight.plots import run_figures

folder = Path(os.environ.get("POSTFLIGHT_FLIGHT", "../demo-flight"))
if not (folder / "flight.toml").exists():
    from synthetic_flight.folder import simulate_to_folder
    from synthetic_flight.scenarios import read_scenario

    simulate_to_folder(read_scenario("irve2_reference"), 0, folder)
telemetry = read_flight(folder)
frames = telemetry.frames

# %% [markdown]
# ## What the camera saw
#
# Left the benchmark frame, right one near the peak. The eye sees that something moved; how far, it cannot say.

# %%
late = int(np.argmin(np.abs(frames.time_s - 440.6)))
figure, axes = plt.subplots(1, 2, figsize=(10, 3.5))
for axis, k in zip(axes, (frames.benchmark, late), strict=True):
    axis.imshow(frames.picture(k), cmap="gray")
    axis.set_title(f"{frames.time_s[k]:.1f} s")
    axis.axis("off")

# %% [markdown]
# ## What the virtual camera says
#
# No trajectory, no accelerometer: frames, the drawing of the shell, and the lens as it was known before the flight.

# %%
history = estimate_camera(telemetry)
with TemporaryDirectory() as pictures:
    run_figures.draw_camera(telemetry, history, Path(pictures))
    display(Image((Path(pictures) / "figure_2_3.png").read_bytes()))

# %% [markdown]
# ## In an assumed plane
#
# The paper had to assume the plane. Read again with the plane held 60 deg off the one that was found, the same
# frames give another angle: the plane is part of the answer.

# %%
largest = int(np.nanargmax(history.theta_rad))
off = history.plane_lv_rad[largest] + np.deg2rad(60.0)
assumed = estimate_camera(telemetry, plane_lv_rad=float(off))
sd_deg = np.rad2deg(history.theta_sd_rad[largest])
print(f"found: {np.rad2deg(history.theta_rad[largest]):.2f} +/- {sd_deg:.2f} deg; plane "
      f"60 deg off: {np.rad2deg(assumed.theta_rad[largest]):.2f} deg")  # fmt: skip

# %% [markdown]
# ## Only now, the truth

# %%
truth = pd.read_csv(folder / "truth" / "deflection.csv")
true_deg = np.interp(history.time_s, truth["t_s"], truth["theta_deg"])
known = np.isfinite(history.theta_rad)
error_deg, sd_deg = np.rad2deg(history.theta_rad) - true_deg, np.rad2deg(history.theta_sd_rad)
plt.figure(figsize=(9, 3))
plt.plot(truth["t_s"], truth["theta_deg"], "0.6", label="truth")
read_deg = np.rad2deg(history.theta_rad)
plt.errorbar(history.time_s[known], read_deg[known], 2 * sd_deg[known], fmt="o", ms=3, label="2 sd")
plt.xlim(frames.time_s[0] - 1, frames.time_s[-1] + 1)
plt.ylabel("deflection deg")
plt.legend()
bent = known & (true_deg > 1.0)
ratio = error_deg[bent] / sd_deg[bent]
rms_deg = np.sqrt(np.mean(error_deg[bent] ** 2))
print(f"{bent.sum()} frames with the shell bent by more than 1 deg: rms error {rms_deg:.2f} deg")

# %% [markdown]
# ## The claim
#
# The bending of every frame lies within three of its standard deviations of the truth, while it moves over ten and
# more of them: film alone shows that, and how far, the shell bent. With a plane that is far off, the answer is
# another.

# %%
assert bent.sum() >= 8
assert np.abs(ratio).max() < 3.0
assert true_deg[bent].max() - true_deg[known].min() > 10.0 * np.median(sd_deg[bent])
assert abs(assumed.theta_rad[largest] - history.theta_rad[largest]) > 3.0 * history.theta_sd_rad[largest]
print("proved: seen, measured, and honest about how well")
