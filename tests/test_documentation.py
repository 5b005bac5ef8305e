"""The page of scenario and vehicle files names every key that these files may hold."""

from pathlib import Path

import pytest
from pydantic import BaseModel

from flightmodel import aeroinput, vehicle
from synthetic_flight import day_air, scenarios

PAGE = (Path(__file__).parents[1] / "docs" / "scenario-and-vehicle-files.md").read_text()
MODELS = [
    scenarios.TimeSpan,
    scenarios.Initial,
    day_air.DayAtmosphere,
    day_air.Pocket,
    day_air.Shear,
    day_air.Turbulence,
    day_air.DiscreteGust,
    day_air.RangeSounding,
    vehicle.Reference,
    vehicle.CompliantJoint,
    vehicle.MassProperties,
    vehicle.ShellGeometry,
    vehicle.Uncertainty,
    vehicle.SensorMount,
    vehicle.CameraMount,
    aeroinput.Aerodynamics,
    aeroinput.SphereCone,
    aeroinput.FreeMolecular,
    aeroinput.Sidecar,
    aeroinput.TableUncertainty,
]


@pytest.mark.parametrize("model", MODELS, ids=lambda m: m.__name__)
def test_every_key_is_on_the_page(model: type[BaseModel]):
    quoted = PAGE.replace(".", "`").replace("[", "`").replace("]", "`")
    missing = [key for key in model.model_fields if f"`{key}`" not in quoted]
    assert not missing
