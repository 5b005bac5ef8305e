"""Draw docs/images/axdahl_zones.png: ``python docs/images/axdahl_zones.py`` (half a minute)."""

from pathlib import Path

import numpy as np

from flightmodel.vehicle import vehicle_from_toml, vehicle_path
from postflight.plots.stability import figure_axdahl_zones
from synthetic_flight.linear import Slopes
from synthetic_flight.stability_map import flown_map, linear_map

# the reference vehicle at Mach 3.2 with 0.7 of Newtonian static stability and a constant, propelling pitch damping
SLOPES = Slopes(ca=1.54, cn_alpha=0.3065, cm_alpha=-0.2333, cmq=0.2)
PRESSURE_PA, SPEED_MPS = 1150.0, 1040.0

if __name__ == "__main__":
    vehicle = vehicle_from_toml(vehicle_path("irve2_reference"))
    setting = (vehicle, SLOPES, PRESSURE_PA, SPEED_MPS)
    fine = linear_map(*setting, np.geomspace(2.0e3, 5.0e4, 160), np.geomspace(1e-3, 0.4, 120))
    flights = flown_map(*setting, np.geomspace(2.1e3, 4.7e4, 26), np.geomspace(1.2e-3, 0.34, 15))
    figure_axdahl_zones(fine, flights).savefig(Path(__file__).with_suffix(".png"), dpi=130)
