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
# # The joint that explains the flight
#
# A vehicle flew with a larger angle of attack than predicted. Is there a joint between shell and centerbody that makes
# the simulation fly like it? The flight here is **synthetic**, and its joint is not the one of the analyst's vehicle
# file: 8 % stiffer, with the centre of gravity a millimetre elsewhere. What was really flown is looked at in the last
# section only.

# %%
# %matplotlib inline
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import matplotlib.pyplot as plt
import numpy as np

import postflight as pf

scenario = pf.read_scenario("irve2_reference")
scenario = replace(scenario, spec=scenario.spec.model_copy(update={"video": None}))
assumed = scenario.vehicle
joint = assumed.joint.model_copy(update={"bending_stiffness_nmprad": 1.08 * assumed.joint.bending_stiffness_nmprad})
x, y, z = assumed.centerbody.cg_from_datum_body_m
moved = assumed.centerbody.model_copy(update={"cg_from_datum_body_m": (x, y + 0.0006, z - 0.0010)})
flown = replace(assumed, joint=joint, centerbody=moved)
with TemporaryDirectory() as root:
    truth = pf.simulate(replace(scenario, vehicle=flown), Path(root) / "flight", seed=3)
    flight = pf.read_flight(Path(root) / "flight")
    flight = replace(flight, telemetry=replace(flight.telemetry, vehicle=assumed))
bet = pf.reconstruct(flight)

# %% [markdown]
# ## The joint
#
# Stiffness, damping, offset and static stability are fitted to body rates and accelerations: the flight is cut into
# spans of 0.4 s, each simulated from a start of its own, and the starts are asked to join. The deflection itself is
# not used.

# %%
joint_found = pf.reconcile(bet)
table = joint_found.to_frame()
table.round(4)

# %% [markdown]
# ## A second way to the stiffness
#
# The joint's own frequency, followed through the spectra of rates and accelerations while dynamic pressure rises and
# falls: no fit of the motion, another part of the data.

# %%
modal = joint_found.modal_stiffness()
print(f"by its frequency alone: {modal.stiffness_nmprad:.0f} +/- {modal.sd_nmprad:.0f} N m/rad")
pf.plots.figure_modes(joint_found, modal)

# %% [markdown]
# ## A rigid vehicle does not fly like that; one with this joint does
#
# Sixty entries of the vehicle with its joint locked, from the reconstructed state above the atmosphere, with mass,
# coefficients and atmosphere dispersed by their a priori uncertainty; then entries with the fitted joint, dispersed by
# its standard deviation. If the flight is one of them, it lies inside their band.

# %%
rigid, flexible = joint_found.bounds(60)
figure, axis = plt.subplots(figsize=(9, 3.5))
for bounds, colour, label in ((rigid, "grey", "joint locked"), (flexible, "tab:orange", "fitted joint")):
    low, high = bounds.alpha_total_deg[[0, 2]]
    axis.fill_between(bounds.time_s, low, high, alpha=0.3, color=colour, label=f"{label}, 2.3 to 97.7 %")
axis.plot(bet.air.time_s, np.rad2deg(bet.air.alpha_total_wind_rad), label="this flight")
axis.set(xlim=(425, 455), ylim=(0, 30), xlabel="time after launch, s", ylabel="total angle of attack, deg")
axis.legend()
inside = joint_found.shares_inside(rigid, flexible)
inside.round(3)

# %% [markdown]
# ## The claim
#
# The joint that was flown lies within three standard deviations of the fitted one, which the assumed one does not; the
# deflection that it makes is the true one; the rigid band misses a third of the pulse or more, the other holds 95 %
# of it.

# %%
row = table.set_index("quantity").loc["bending stiffness"]
print(f"stiffness: found {row['found']:.0f} +/- {row['sd']:.0f}, flown {joint.bending_stiffness_nmprad:.0f} N m/rad")
assert abs(row["found"] - joint.bending_stiffness_nmprad) < 3.0 * row["sd"]
assert abs(row["found"] - assumed.joint.bending_stiffness_nmprad) > 3.0 * row["sd"]
assert abs(modal.stiffness_nmprad - joint.bending_stiffness_nmprad) < 3.0 * modal.sd_nmprad
history, at = joint_found.deflection, bet.peak_s
true_deg = float(np.rad2deg(np.interp(at, truth.time_s, truth.deflection.theta_rad)))
found_deg = float(np.rad2deg(np.interp(at, history.time_s, history.theta_rad)))
print(f"deflection at peak pressure: {found_deg:.2f} deg with the fitted joint, {true_deg:.2f} truly")
assert abs(found_deg - true_deg) < 0.3
by_joint = inside.groupby("joint")["share_inside"].min()
assert by_joint["rigid"] < 0.67
assert by_joint["flexible"] >= 0.95
print("proved: a joint explains the flight, and nothing rigid does")
