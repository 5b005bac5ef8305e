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
# # The deflection by video
#
# A camera on the centerbody looks at the back of the aeroshell. Between an undeflected frame and one at peak pressure
# its edge moves by some pixels. A *virtual camera* with the shell's drawing and the lens answers: for which deflection
# would the edge be seen there? The film is **synthetic**: rendered by another program than the one that reads it, with
# noise, blur and compression; its truth is in a folder that the estimator does not open.

# %%
# %matplotlib inline
import os
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from IPython.display import display

import postflight as pf

folder = Path(os.environ.get("POSTFLIGHT_FLIGHT", "../demo-flight"))
if not (folder / "flight.toml").exists():
    pf.simulate("irve2_reference", folder)
flight = pf.read_flight(folder)
frames = flight.telemetry.frames

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
# ## What the virtual camera gives
#
# No trajectory, no accelerometer: frames, the drawing of the shell, and the lens as calibrated before the flight.

# %%
history = pf.estimate_camera(flight)
display(pf.plots.figure_2_3(flight, history))
history

# %% [markdown]
# ## In an assumed plane
#
# The paper had to assume the plane. With the plane held 90 deg off the estimated one the same frames give another
# angle: the plane is part of the answer.

# %%
largest = int(np.nanargmax(history.theta_rad))
off_deg = float(np.rad2deg(history.plane_lv_rad[largest]) + 90.0)
assumed = pf.estimate_camera(flight.with_(camera_plane_lv_deg=off_deg))
sd_deg = np.rad2deg(history.theta_sd_rad[largest])
print(f"estimated: {np.rad2deg(history.theta_rad[largest]):.2f} +/- {sd_deg:.2f} deg; plane "
      f"90 deg off: {np.rad2deg(assumed.theta_rad[largest]):.2f} deg")  # fmt: skip

# %% [markdown]
# ## Only now, the truth

# %%
truth = pd.read_csv(folder / "truth" / "deflection.csv")
table = history.to_frame()
true_deg = np.interp(table["t_s"], truth["t_s"], truth["theta_deg"])
error_deg = table["theta_deg"] - true_deg
plt.figure(figsize=(9, 3))
plt.plot(truth["t_s"], truth["theta_deg"], "0.6", label="truth")
plt.errorbar(table["t_s"], table["theta_deg"], 2 * table["theta_sd_deg"], fmt="o", ms=3, label="video, 2 sd")
plt.xlim(frames.time_s[0] - 1, frames.time_s[-1] + 1)
plt.xlabel("time after launch, s")
plt.ylabel("deflection, deg")
plt.legend()
deflected = true_deg > 1.0
ratio = error_deg[deflected] / table["theta_sd_deg"][deflected]
rms_deg = np.sqrt(np.mean(error_deg[deflected] ** 2))
print(f"{deflected.sum()} frames with a deflection of more than 1 deg: rms error {rms_deg:.2f} deg")

# %% [markdown]
# ## The claim
#
# The estimate of every frame lies within three of its standard deviations of the truth, while the deflection moves over
# ten and more of them: film alone shows that the shell deflected, and how far. In a plane that is far off the answer is
# another.

# %%
assert deflected.sum() >= 8
assert np.abs(ratio).max() < 3.0
assert true_deg[deflected].max() - true_deg.min() > 10.0 * np.median(table["theta_sd_deg"][deflected])
assert abs(assumed.theta_rad[largest] - history.theta_rad[largest]) > 3.0 * history.theta_sd_rad[largest]
print("proved: seen, measured, and honest about how well")
