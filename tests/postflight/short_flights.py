"""Short flights for tests: a dispersed one from 100 km for ten seconds, some milliseconds of computing each; and the
reference flight's pulse alone, with everything that a range delivers.
"""

import re

from flightmodel.vehicle import DATA
from postflight.montecarlo import execution
from postflight.montecarlo.bands import merge, write_merged
from postflight.montecarlo.execution import Wanted
from postflight.montecarlo.study import read_study

FLIGHTS = 24  # of the short study

SEEN = """
[window]
from_s = 402.0
to_s = 406.0
record_s = 0.02
history_s = 0.1

[outputs]
scalars = ["peak_deflection_deg", "peak_normal_g", "deflection_deg_at_peak_pressure"]
histories = ["alpha_total_deg", "deflection_deg"]
"""
DISPERSIONS = f"""
scenario = "short.toml"
flights = {FLIGHTS}
seed = 7
chunk = 4
{SEEN}
[initial]
altitude_m = {{ normal = 300.0 }}
nose_elevation_deg = {{ uniform = [-2.0, 2.0] }}

[mass]
offset_y_m = {{ normal = 0.001 }}

[aerodynamics]
cn = {{ normal = 0.07 }}

[joint]
stiffness = {{ lognormal = 0.1 }}

[atmosphere]
density = {{ normal = 0.02 }}
"""


SHORT = {
    "start_s": 400.0, "stop_s": 412.0, "inflated_s": 401.0, "telemetry_from_s": 402.0, "altitude_m": 80000.0,
    "speed_mps": 1600.0, "flight_path_deg": -76.5, "nose_elevation_deg": -78.0, "t_s": 402.0,
}  # fmt: skip
ENTRY = {"stop_s": 465.0, "telemetry_from_s": 380.0, "t_s": 380.0}  # the reference flight's own, for whole trials


def write_short(folder, text=DISPERSIONS, changes=SHORT):
    """Write scenario and dispersions file; return the latter's path."""
    spec = (DATA / "scenarios" / "irve2_reference.toml").read_text()
    for key, value in changes.items():
        spec = re.sub(rf"(?m)^{key} = \S+", f"{key} = {value}", spec, count=1)
    spec = re.sub(r"(?ms)^\[video\].*?(?=^\[)", "", spec)
    (folder / "short.toml").write_text(spec)
    path = folder / "dispersions.toml"
    path.write_text(text)
    return path


# less of everything than the reference flight: it is looked at, not measured
PULSE = (
    (r"(?m)^stop_s = 530\.0", "stop_s = 458.0"),
    (r"telemetry_from_s = 300\.0", "telemetry_from_s = 412.0"),
    (r"(?m)^t_s = 300\.0", "t_s = 412.0"),
    (r"rate_hz = 250\.0", "rate_hz = 100.0"),
    (r"rate_hz = 4\.0", "rate_hz = 1.0"),
)


def write_pulse(path):
    """Write the reference scenario from 412 to 458 s, 27 frames of film with it; return its path."""
    text = (DATA / "scenarios" / "irve2_reference.toml").read_text()
    for pattern, new in PULSE:
        text, count = re.subn(pattern, new, text)
        assert count, pattern
    path.write_text(text)
    return path


def quiet(_fraction, _words):
    pass


def fly(path, folder, flights=FLIGHTS, **wanted):
    """Fly a study into a folder and return it."""
    study = read_study(str(path))
    count = execution.run(study, folder, Wanted(flights, **wanted), quiet)
    write_merged(folder, merge(study, folder, count))
    return study


def content(folder):
    """Bytes of every file by name."""
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}
