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
# # The flight, and what it may not change
#
# A simulated flight is worth an estimate only if it obeys what no force model can excuse. Above the atmosphere the
# mechanical energy is constant, and so is the angular momentum about the c.g., however the two bodies oscillate. In
# the atmosphere the flight loses what the aerodynamic force takes. This notebook flies the reference vehicle
# (**synthetic**, of IRVE-II's class) and checks both.

# %%
# %matplotlib inline
import matplotlib.pyplot as plt
import numpy as np

import postflight as pf

truth = pf.simulate("irve2_reference", seed=0)
flown = truth.to_frame()
truth

# %% [markdown]
# ## The flight
#
# Separation at 110 km, apogee, and the entry: within half a minute all that matters happens.

# %%
figure, axes = plt.subplots(3, 1, sharex=True, figsize=(9, 6))
entry = flown[flown["t_s"].between(400, 470)]
for axis, column, unit, label in zip(
    axes,
    ("altitude_m", "dynamic_pressure_pa", "theta_deg"),
    (1e3, 1.0, 1.0),
    ("altitude, km", "dynamic pressure, Pa", "deflection, deg"),
    strict=True,
):
    axis.plot(entry["t_s"], entry[column] / unit)
    axis.set_ylabel(label)
axes[2].set(xlabel="time after launch, s")
peak = flown.loc[flown["dynamic_pressure_pa"].idxmax()]
print(
    f"{peak.dynamic_pressure_pa:.0f} Pa at {peak.t_s:.2f} s, Mach {peak.mach:.2f}; deflection {peak.theta_deg:.2f} deg"
)

# %% [markdown]
# ## Above the atmosphere
#
# With the joint free and dynamic pressure below a thousandth of a pascal, gravity and the joint are all that acts.
# Energy and angular momentum are not constant by construction: the integrator knows neither. The joint's damping may
# take a little energy; nothing may take angular momentum, but gravity's gradient and what air there is.

# %%
high = flown[(flown["altitude_m"] > 150e3) & (flown["t_s"] > 305.0)]
energy = np.abs(high["energy_j"] / high["energy_j"].iloc[0] - 1.0).max()
momentum = np.abs(high["angular_momentum_nms"] / high["angular_momentum_nms"].iloc[0] - 1.0).max()
print(f"{high['t_s'].iloc[0]:.0f} to {high['t_s'].iloc[-1]:.0f} s: energy constant to {energy:.1e}, "
      f"angular momentum to {momentum:.1e}")  # fmt: skip

# %% [markdown]
# ## In the atmosphere
#
# The power of the non-gravitational force is force times velocity. Integrated along the entry it is the energy that
# was lost; damping of the joint and rotation about the c.g. are small beside it.

# %%
entry = flown[(flown["t_s"] > 405.0) & (flown["t_s"] < 455.0)]
t, power = entry["t_s"].to_numpy(), entry["sensed_power_w"].to_numpy()
work = np.concatenate([[0.0], np.cumsum(0.5 * (power[1:] + power[:-1]) * np.diff(t))])
lost = (entry["energy_j"] - entry["energy_j"].iloc[0]).to_numpy()
apart = np.abs(lost - work).max() / np.abs(work).max()
plt.figure(figsize=(9, 3))
plt.plot(t, 1e-6 * lost, label="change of the mechanical energy")
plt.plot(t, 1e-6 * work, "--", label="work of the sensed force")
plt.xlabel("time after launch, s")
plt.ylabel("MJ")
plt.legend()
print(f"largest difference {apart:.1e} of {np.abs(work).max() / 1e6:.0f} MJ")

# %% [markdown]
# ## The claim
#
# Above the atmosphere energy and angular momentum are constant; in it the sensed force accounts for the energy lost.
# (Free flight with several steps, friction switched off, is in the tests: the error falls with the fourth power.)

# %%
assert energy < 1e-7
assert momentum < 1e-4
assert apart < 1e-4
print("proved: energy and momentum are conserved, and drag accounts for what was lost")
