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
# # One flight, and how far its aeroshell bent
#
# A flight folder goes in; a trajectory, three estimates of the deflection and a verdict come out. Every figure here is
# the library's own. The flight is **synthetic** unless you point `POSTFLIGHT_FLIGHT` at a folder of your own: nothing
# below, up to the last section, looks at its truth.

# %%
# %matplotlib inline
import os
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pandas as pd
from IPython.display import Image, display

from flightmodel.airdata import pressure_pulse
from postflight.flight import METHODS, estimate, reconstruct_flight
from postflight.plots import paper_figures, run_figures
from postflight.product import bet_table, event_table
from postflight.run_folder import method_summary
from postflight.studies.preflight import rigid_bounds

folder = Path(os.environ.get("POSTFLIGHT_FLIGHT", "../demo-flight"))
if not (folder / "flight.toml").exists():
    from synthetic_flight.folder import simulate_to_folder
    from synthetic_flight.scenarios import read_scenario

    simulate_to_folder(read_scenario("irve2_reference"), 0, folder)

# %% [markdown]
# ## What came down
#
# Two radars, accelerometers in their own clocked package, rate gyros, the day's sounding, and video. The gate checks
# all of it; what an analyst should know of the data is a finding, not a repair.

# %%
flight = reconstruct_flight(folder)
telemetry = flight.telemetry
rows = [(name, len(r.time_s), r.time_s[0], r.time_s[-1]) for name, r in telemetry.radars.items()]
for triad in (telemetry.accelerometer, telemetry.rates):
    rows.append((triad.spec.name, len(triad.time_s), triad.time_s[0], triad.time_s[-1]))
print(*telemetry.findings, *flight.solution.findings, sep="\n")
pd.DataFrame(rows, columns=["sensor", "samples", "from s", "to s"])

# %% [markdown]
# ## The best-estimated trajectory, and how we know
#
# Radar says where, accelerometers and gyros say how it moved between; the filter and smoother weigh them, and estimate
# the sensors' own errors on the way. If its assumptions hold, the residuals are as large as predicted and white.

# %%
event_table(flight, bet_table(flight)).round(2)

# %%
pd.DataFrame([(v.name, v.passed, round(v.value, 3), v.remark) for v in flight.consistency_checks],
             columns=["verdict", "passed", "value", "in words"])  # fmt: skip

# %%
paper_figures.figure_residuals(flight)

# %% [markdown]
# ## The anomaly
#
# A rigid vehicle, flown a hundred times from the reconstructed state with pre-flight uncertainties, gives the grey
# band. The flight leaves it: total angle of attack by several degrees, normal acceleration by several times.

# %%
bounds = rigid_bounds(flight, flights=60)
paper_figures.figure_1_3(flight, bounds)

# %% [markdown]
# ## The sharp contrast
#
# All aerodynamic force is on the aeroshell, so $a_N/(-a_x) = C_N/C_A$ of the *shell's* angle of attack. Read without
# correction, the accelerometers ask for an angle that the trajectory denies.

# %%
paper_figures.figure_2_5(flight)

# %% [markdown]
# ## Three ways to the deflection
#
# 1. **Video**: for which deflection does a virtual camera, oriented on the benchmark frame, see the shell's edge where
#    the onboard camera saw it?
# 2. **Misalignment**: which deflection reconciles the measured force with the trajectory's angle of attack?
# 3. **Trim**: which sideways shift of the c.g. balances the moments at the angle that was flown?

# %%
methods = tuple(m for m in METHODS if m != "camera" or telemetry.frames is not None)
answers = estimate(flight, telemetry, methods)
pd.DataFrame(method_summary(answers, flight.peak_s)).T[["deflection_deg", "sd_deg", "largest_deg", "largest_at_s"]]

# %%
paper_figures.figure_2_7(flight, answers.histories["misalignment"])

# %%
if "camera" in answers.histories:
    with TemporaryDirectory() as pictures:
        run_figures.draw_camera(telemetry, answers.histories["camera"], Path(pictures))
        display(Image((Path(pictures) / "figure_2_3.png").read_bytes()))

# %% [markdown]
# ## The claim
#
# The three share the trajectory's angle of attack, but err in different ways: lens and benchmark, accelerometer mount,
# coefficients and c.g. offset. Through the pressure pulse they agree within their error bars.

# %%
grid = flight.air.time_s[pressure_pulse(flight.air.dynamic_pressure_pa)]
grid = grid[(grid > flight.peak_s - 6.0) & (grid < flight.peak_s + 6.0)]
at = {m: np.array([h.at(t) for t in grid]) for m, h in answers.histories.items()}
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
    display(paper_figures.figure_summary(flight, answers, overlay))
