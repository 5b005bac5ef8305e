"""The pages of scenario and vehicle files name every key that these files may hold."""

from pathlib import Path

import pytest
from pydantic import BaseModel

from flightmodel import aeroinput, vehicle
from synthetic_flight import day_air, instrument_sections, scenarios

DOCS = Path(__file__).parents[1] / "docs"
INSTRUMENTS = [
    instrument_sections.Accelerometer,
    instrument_sections.Rates,
    instrument_sections.Magnetometer,
    instrument_sections.SunSensors,
    instrument_sections.Radar,
    instrument_sections.AirRefraction,
    instrument_sections.Dropouts,
    instrument_sections.Video,
    instrument_sections.Attitude,
]
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


def missing_keys(page: str, model: type[BaseModel]) -> list[str]:
    quoted = (DOCS / page).read_text().replace(".", "`").replace("[", "`").replace("]", "`")
    return [key for key in model.model_fields if f"`{key}`" not in quoted]


@pytest.mark.parametrize("model", MODELS, ids=lambda m: m.__name__)
def test_every_key_is_on_the_page(model: type[BaseModel]):
    assert not missing_keys("scenario-and-vehicle-files.md", model)


@pytest.mark.parametrize("model", INSTRUMENTS, ids=lambda m: m.__name__)
def test_every_key_of_an_instrument_is_on_its_page(model: type[BaseModel]):
    assert not missing_keys("instruments.md", model)
