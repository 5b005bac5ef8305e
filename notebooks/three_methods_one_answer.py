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
# # Three methods, one answer
#
# Film, accelerometers and the balance of moments each give the deflection. They depend on different things, but not
# only on different ones: accelerometers and trim share the trajectory's angle of attack. So their answers may not be
# averaged as if independent. This notebook fuses them with what they share, asks whether they agree, then asks again
# under a wrong assumption. **Synthetic** flight; the truth comes last.

# %%
# %matplotlib inline
import os
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd

import postflight as pf

folder = Path(os.environ.get("POSTFLIGHT_FLIGHT", "../demo-flight"))
if not (folder / "flight.toml").exists():
    pf.simulate("irve2_reference", folder)
flight = pf.read_flight(folder)
bet = pf.reconstruct(flight)
answer = pf.fuse(bet)

# %% [markdown]
# ## Three answers, and the fused one

# %%
figure, axis = plt.subplots(figsize=(9, 4))
for method, history in answer.histories.items():
    table = history.to_frame()
    table = table[table["t_s"].between(425, 452)]
    axis.plot(table["t_s"], table["theta_deg"], label=method)
    low, high = (table["theta_deg"] + sign * table["theta_sd_deg"] for sign in (-1, 1))
    axis.fill_between(table["t_s"], low, high, alpha=0.2)
axis.set(xlabel="time after launch, s", ylabel="deflection, deg (band: 1 sd)")
axis.legend()
answer

# %% [markdown]
# ## Do they agree?
#
# The difference of two methods holds no deflection, only what they depend on; its chi-square is the test of the pair.

# %%
answer.fused.agreement_frame()

# %% [markdown]
# ## What was learnt of the inputs
#
# The share of each input's a priori standard deviation that is left. Near 1: the flight carries no information on it.

# %%
answer.fused.input_frame()

# %% [markdown]
# ## A wrong assumption: the centre of gravity 8 mm off
#
# The same flight under another assumption is another flight. With the c.g. 8 mm beside where it was, several times its
# stated standard deviation, trim no longer fits the rest, and the tests should say so and name the offset.

# %%
changed = pf.fuse(pf.reconstruct(flight.with_(cg_shift_body_m=(0.0, 0.008, 0.0))))
print(answer.fused.agreement.remark)
print(changed.refused.get("fused") or changed.fused.agreement.remark)
pf.compare(answer, changed)

# %% [markdown]
# ## The claim
#
# The three agree by their own tests, the fused answer is narrower than those of accelerometers and trim (the camera's
# may be narrower still: it takes the deflection as proportional to the moment in the joint), and the truth, looked at
# only now, lies within three standard deviations of every one. Under the wrong assumption the methods disagree, and the
# offset is among what is suspected.

# %%
truth = pd.read_csv(folder / "truth" / "deflection.csv")
true_deg = float(np.interp(bet.peak_s, truth["t_s"], truth["theta_deg"]))
at_peak = answer.to_frame().set_index("method")
for method, row in at_peak.iterrows():
    off = (row.theta_deg - true_deg) / row.theta_sd_deg
    print(f"{method}: {row.theta_deg:.2f} +/- {row.theta_sd_deg:.2f} deg, truth {true_deg:.2f}, off by {off:+.1f} sd")
    assert abs(off) < 3.0
sound = answer.fused.agreement_frame()
assert sound["passed"].all()
assert at_peak.loc["fused", "theta_sd_deg"] < at_peak.loc[["misalignment", "trim"], "theta_sd_deg"].min()
assert not answer.fused.agreement.hypotheses
assert changed.fused is None or "offset" in " ".join(changed.fused.agreement.likeliest)
print("proved: one answer, and a test that notices when an assumption is wrong")
