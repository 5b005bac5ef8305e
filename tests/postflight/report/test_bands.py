"""The flight against bands that others flew: which part of it lies inside, and what holds no bands."""

import json
import re

import numpy as np
import pandas as pd
import pytest

from flightmodel.checks import GateError
from postflight.report import panels
from postflight.report.write import page, write_report
from postflight.runs import read_run
from tests.refusing import numbers_in


@pytest.fixture(scope="module")
def run(reported):
    return read_run(reported)


def study(folder, name, quantity, time_s, low, high, **more):
    """Folder with bands as `montecarlo` writes them."""
    path = folder / name
    path.mkdir()
    numbers = {"p2.3": low, "p50": 0.5 * (low + high), "p97.7": high}
    table = pd.DataFrame({"history": quantity, "time_s": time_s, "flights": 100, **numbers, **more})
    table.to_csv(path / "bands.csv", index=False)
    return path


def test_share_is_that_of_the_pulse_inside(run, tmp_path):
    bet = run.tables["bet"]
    t, alpha = bet["t_s"].to_numpy(), bet["alpha_total_wind_deg"].to_numpy()
    q = bet["dynamic_pressure_pa"].to_numpy()
    pulse = t[q > 0.5 * q.max()]
    middle = 0.5 * (pulse[0] + pulse[-1])
    # right about the flight in the pulse's first half, far off in its second and outside of it
    off = np.where((t < middle) & (t > pulse[0] - 1.0), 0.0, 50.0)
    path = study(tmp_path, "before <b>", "alpha_total_deg", t, alpha + off - 0.5, alpha + off + 0.5)
    (panel,) = panels.study_panels(run, (path,))
    label = panel["lines"][0]["label"]
    assert label.startswith("before <b>, ")
    assert numbers_in(label)[-1] == pytest.approx(50.0, abs=6.0)
    text = page(run, (path,))
    assert "before &lt;b&gt;" in text
    assert "before <b>" not in text
    data = json.loads(re.search(r'<script type="application/json" id="data">(.*?)</script>', text, re.DOTALL)[1])
    assert [p["id"] for p in data["studies"]] == ["bands_alpha_total_deg"]
    assert str(tmp_path) not in text


def test_several_studies_share_a_panel(run, tmp_path):
    t = np.linspace(420.0, 450.0, 31)
    wide, narrow = np.zeros(31), np.full(31, 3.0)
    first = study(tmp_path, "one", "mach", t, wide, wide + 9.0)
    second = study(tmp_path, "two", "mach", t, narrow, narrow + 0.1, nominal=narrow)
    (panel,) = panels.study_panels(run, (first, second))
    labels = [line["label"] for line in panel["lines"]]
    assert [label.partition(",")[0] for label in labels] == ["one", "two", "two", "this flight"]
    assert numbers_in(labels[0]) == [100.0]
    assert len({line["colour"] for line in panel["lines"][:2]}) == 2


def test_without_studies_the_page_has_no_such_part(run):
    assert 'id="studies"' not in page(run)


def test_what_holds_no_bands_is_refused(run, reported, tmp_path):
    (tmp_path / "empty").mkdir()
    with pytest.raises(GateError) as refusal:
        write_report(reported, target=tmp_path / "r.html", studies=(tmp_path / "empty",))
    assert refusal.value.codes == ("file-missing",)
    (tmp_path / "other.csv").write_text("a,b\n1,2\n")
    with pytest.raises(GateError) as refusal:
        panels.study_panels(run, (tmp_path / "other.csv",))
    assert refusal.value.codes == ("file-unreadable",)
    (tmp_path / "bare").mkdir()
    (tmp_path / "bare" / "bands.csv").write_text("history,time_s,flights,p2.3,p50,p97.7\n")
    with pytest.raises(GateError) as refusal:
        panels.study_panels(run, (tmp_path / "bare",))
    assert refusal.value.codes == ("too-few-data",)
    late = study(tmp_path, "late", "mach", np.array([900.0, 901.0]), np.zeros(2), np.ones(2))
    with pytest.raises(GateError) as refusal:
        panels.study_panels(run, (late,))
    assert refusal.value.codes == ("time-not-covered",)
    assert not (tmp_path / "r.html").exists()
