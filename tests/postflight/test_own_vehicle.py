"""A vehicle of one's own, through the command alone: no Python, no table."""

import json
import shutil
from pathlib import Path

import pandas as pd

from tests.refusing import printed_codes

EXAMPLE = Path(__file__).parents[2] / "examples" / "own_vehicle"


def test_example_is_flown(command, tmp_path):
    done = command("simulate", EXAMPLE / "scenario.toml", tmp_path / "flight", "--seed", "4")
    assert done.returncode == 0, done.stderr
    for event in ("peak heating", "Mach 3.5", "peak q", "40 km"):
        assert event in done.stdout
    assert "deflection" not in done.stdout  # the truth that estimators look for stays in truth/
    events = pd.read_csv(tmp_path / "flight" / "truth" / "events.csv").set_index("event")
    assert list(events.index[:2]) == ["separation", "80 km"]
    assert "splashdown" not in events.index
    # q at peak of a vehicle of 55 kg on 3.14 m2 with C_A 1.65: exponential air gives 0.5 rho V^2 at most
    # beta sin(path) V^2 / (2 e H): 10.6 x 0.97 x 1600^2 / (2 x 2.718 x 7200) = 670 Pa, and gravity adds a third
    assert 650.0 < events.loc["peak dynamic pressure", "dynamic_pressure_pa"] < 1000.0
    sounding = pd.read_csv(tmp_path / "flight" / "telemetry" / "atmosphere.csv")
    assert sounding["alt_m"].iloc[-1] == 90e3
    assert json.loads((tmp_path / "flight" / "truth" / "run.json").read_text())["scenario"] == "own_vehicle"


def test_wrong_keys_are_named_all_at_once(command, tmp_path):
    for file in EXAMPLE.glob("*.toml"):
        shutil.copy(file, tmp_path / file.name)
    vehicle = tmp_path / "vehicle.toml"
    text = vehicle.read_text().replace("half_angle_deg = 70.0\nnose", "half_angel_deg = 70.0\nnose")
    vehicle.write_text(text.replace("mass_kg = 40.0", "mass_kg = -40.0").replace("cmq = -0.10", 'cmq = "low"'))
    done = command("simulate", tmp_path / "scenario.toml", tmp_path / "flight")
    assert done.returncode == 2
    assert set(printed_codes(done.stderr)) == {"key-unknown", "key-missing", "key-value"}
    for name in ("'half_angle_deg'", "centerbody.mass_kg", "sphere_cone.cmq", "vehicle.toml"):
        assert name in done.stderr
    assert not (tmp_path / "flight").exists()
    scenario = tmp_path / "scenario.toml"
    text = scenario.read_text().replace("depth = 0.10", "deepth = 0.10").replace("length_m = 600.0", "length_m = 60.0")
    scenario.write_text(text)
    done = command("simulate", scenario, tmp_path / "flight")
    assert done.returncode == 2
    assert {"key-unknown", "key-missing", "key-value"} <= set(printed_codes(done.stderr))
    for name in ("atmosphere.pockets.0.deepth", "'depth'", "atmosphere.gusts.0.length_m"):
        assert name in done.stderr
    scenario.write_text(scenario.read_text().replace('"vehicle.toml"', '"vehicel.toml"').replace("deepth", "depth"))
    scenario.write_text(scenario.read_text().replace("length_m = 60.0", "length_m = 600.0"))
    done = command("simulate", scenario, tmp_path / "flight")
    assert done.returncode == 2
    assert printed_codes(done.stderr) == ["file-missing"]
    assert "vehicel.toml" in done.stderr
