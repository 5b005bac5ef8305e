"""Figures of the trajectory show what they should, with an attitude and without one."""

from __future__ import annotations

from dataclasses import replace

import matplotlib
import matplotlib.figure
import numpy as np
import pytest

from flightmodel.checks import GateError
from flightmodel.telemetry import Motion
from flightmodel.trajectory import difference
from postflight import plots
from postflight.flight import Flight
from postflight.plots import style
from postflight.plots.run_figures import draw_trajectory
from postflight.plots.style import FigureFolder, in_style, save
from postflight.plots.trajectory import (
    figure_attitude,
    figure_filter_and_smoother,
    figure_residuals,
    figure_sensitivity,
)
from postflight.reconstruction import check_attitude, reconstruction_from
from postflight.sensitivity import sensitivity
from recon.estimate import estimate
from recon.settings import Settings


@pytest.fixture(scope="module")
def flight(mini_flight):
    """A flight of which one radar point in a hundred is a kilometre off."""
    telemetry = replace(mini_flight(3), gnss={}, barometers={})
    north = telemetry.radars["north"]
    track = north.range_az_el.copy()
    track[50::100, 0] += 1000.0
    telemetry = replace(telemetry, radars=telemetry.radars | {"north": replace(north, range_az_el=track)})
    bet = estimate(telemetry, Settings(output_rate_hz=5.0))
    return replace(reconstruction_from(Flight(telemetry), bet), attitude=check_attitude(telemetry, bet))


@pytest.fixture(scope="module")
def ballistic(mini_flight):
    """The same fall without inertial sensors; the drag is a guess."""
    telemetry = mini_flight(3)
    bare = dict.fromkeys(("accelerometer", "rates", "magnetometer", "sun", "vehicle", "attitude_prior"))
    motion = Motion("ballistic", 0.05)
    telemetry = replace(telemetry, **bare, gnss={}, barometers={}, motion=motion)
    return reconstruction_from(Flight(telemetry), estimate(telemetry, Settings(output_rate_hz=5.0, passes=1)))


def drawn(figure, path):
    save(figure, path)
    assert path.stat().st_size > 10_000


def test_edited_points_are_counted_and_lie_in_view(flight, tmp_path):
    figure = figure_residuals(flight)
    drawn(figure, tmp_path / "residuals.png")
    table = flight.solution.residuals
    count = int((~table.accepted & (table.source == "north") & (table.component == "range")).sum())
    assert count >= 5
    axes = figure.get_axes()
    assert axes[0].get_title(loc="right").startswith(f"{count} of ")
    assert sum(len(line.get_xdata()) for line in axes[0].lines if line.get_marker() in "x^v") == count
    low, high = axes[0].get_ylim()
    marks = np.concatenate([line.get_ydata() for line in axes[0].lines if line.get_marker() in "x^v"])
    assert ((marks > low) & (marks < high)).all()
    assert axes[4].get_title(loc="right") == ""


def test_difference_of_filter_and_smoother_is_over_its_own_sd(flight, tmp_path):
    figure = figure_filter_and_smoother(flight)
    drawn(figure, tmp_path / "filter.png")
    axes = figure.get_axes()
    assert len(axes) == 6
    bet = flight.solution
    off = difference(bet.filtered, bet.smoothed)
    var = (np.diagonal(p.covariance, axis1=1, axis2=2) for p in (bet.filtered, bet.smoothed))
    ratio = off / np.sqrt(np.abs(np.subtract(*var)) + 1e-30)
    for row, part in enumerate((slice(0, 3), slice(3, 6), slice(6, 9))):
        shown = np.array([line.get_ydata() for line in axes[2 * row + 1].lines[:3]]).T
        known = np.isfinite(shown)
        assert known.mean() > 0.5
        assert np.allclose(shown[known], ratio[:, part][known])


def test_without_attitude_nothing_is_drawn_of_it(ballistic, tmp_path):
    assert not ballistic.has_attitude
    figure = figure_filter_and_smoother(ballistic)
    drawn(figure, tmp_path / "filter.png")
    assert len(figure.get_axes()) == 4
    drawn(figure_residuals(ballistic), tmp_path / "residuals.png")
    # of trackers that are all left out there are no residuals to draw
    alone = replace(ballistic.solution, residuals=ballistic.solution.residuals.assign(used=False))
    (tmp_path / "without").mkdir()
    draw_trajectory(replace(ballistic, solution=alone), FigureFolder(tmp_path / "without"))
    assert {path.name for path in (tmp_path / "without").iterdir()} == {"flown.png", "filter_and_smoother.png"}
    found = sensitivity(ballistic)
    assert not found.quantity.astype(str).str.contains("rotation|attack").any()
    assert (found[(found.rerun == "mass +1 %") & (found.quantity == "altitude")].change != 0.0).all()
    drawn(figure_sensitivity(ballistic, found), tmp_path / "sensitivity.png")


def test_attitude_figure_states_dependence(flight, tmp_path):
    free = figure_attitude(flight)
    drawn(free, tmp_path / "attitude.png")
    resting = figure_attitude(replace(flight, attitude=replace(flight.attitude, dependence="filter")))
    assert len(free.get_suptitle().splitlines()) == 1
    assert len(resting.get_suptitle().splitlines()) == 2


@pytest.mark.parametrize("form", style.FORMATS)
def test_same_data_give_the_same_bytes_and_the_callers_style_stays(flight, tmp_path, form):
    before = dict(matplotlib.rcParams)
    first, second = tmp_path / f"a.{form}", tmp_path / f"b.{form}"
    for path in (first, second):
        save(figure_filter_and_smoother(flight), path)
    assert first.read_bytes() == second.read_bytes()
    assert first.read_bytes()[:5] == {"png": b"\x89PNG\r", "pdf": b"%PDF-", "svg": b"<?xml"}[form]
    assert dict(matplotlib.rcParams) == before


def test_a_format_that_is_none_is_refused(tmp_path):
    with pytest.raises(GateError) as fault:
        save(matplotlib.figure.Figure(), tmp_path / "a.jpeg")
    assert fault.value.codes == ("option-format",)


def test_a_run_draws_every_figure_in_every_format(ballistic, tmp_path):
    draw_trajectory(ballistic, FigureFolder(tmp_path, ("png", "svg")))
    names = {path.name for path in tmp_path.iterdir()}
    stems = {"flown", "filter_and_smoother", "residuals"}
    assert names == {f"{stem}.{form}" for stem in stems for form in ("png", "svg")}


def test_names_are_no_tex_and_logarithmic_ticks_are(flight, tmp_path):
    name = r"costs $\frac{1}$ more"
    telemetry = replace(flight.telemetry, name=name)
    figure = figure_filter_and_smoother(replace(flight, flight=replace(flight.flight, telemetry=telemetry)))
    drawn(figure, tmp_path / "named.png")
    assert name in figure.get_supxlabel()
    ticks = [tick.label1 for ax in figure.get_axes() for tick in ax.yaxis.majorTicks if ax.get_yscale() == "log"]
    assert any(tick.get_text().startswith(r"$\mathdefault{10^") and tick.get_parse_math() for tick in ticks)
    # a title, too
    titled = in_style(lambda: matplotlib.figure.Figure())()
    titled.suptitle(name)
    with pytest.raises(ValueError, match="frac"):
        titled.savefig(tmp_path / "tex.png")
    as_text = in_style(lambda: titled)()
    as_text.savefig(tmp_path / "text.png")


@pytest.mark.parametrize("name", plots.__all__)
def test_every_figure_is_at_the_door(name):
    assert getattr(plots, name) is not None


@pytest.mark.parametrize("colours", [[style.COLOUR[m] for m in style.STROKE], list(style.AXES.values()), style.MANY])
def test_lines_that_share_axes_differ_in_colour(colours):
    assert len(set(colours)) == len(colours)


def test_a_full_disk_is_no_matter_of_one_figure(tmp_path) -> None:
    with pytest.raises(OSError, match="missing"):
        style.draw(tmp_path / "missing" / "a.png", matplotlib.figure.Figure)
