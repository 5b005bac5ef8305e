"""The table of an analyst's decisions about a film: written, read back, refused where it cannot be meant."""

from pathlib import Path

import numpy as np
import pytest

from flightmodel.camera_edits import NO_EDITS, POSE, CameraEdits, Edit, read_edits, write_edits
from flightmodel.checks import GateError

TIMES, SIZE = np.array([421.0, 421.04, 440.0]), (720, 480)
NAN = float("nan")
ROWS = (
    Edit("camera5", 421.04, "benchmark"),
    Edit("camera5", 440.0, "reject", note='glare, "worst"\nof all'),
    Edit("camera5", NAN, "mask", "sun", 1.0, 2.0),
    Edit("camera5", NAN, "mask", "sun", 100.0, 2.0),
    Edit("camera5", NAN, "mask", "sun", 50.0, 90.0),
    Edit("camera5", 440.0, "rim", "", 300.25, 20.5),
    Edit("camera5", 440.0, "feature", "dot 3", 10.0, 11.0),
    Edit("camera5", NAN, "pose", "rotation_x_deg", value=0.25),
)


def write(path: Path, *lines: str) -> Path:
    path.write_text("\n".join(["camera,t_s,edit,name,u_px,v_px,value,note", *lines]) + "\n")
    return path


def test_edits_come_back_as_they_were_written(tmp_path):
    path = tmp_path / "camera_edits.csv"
    other = Edit("camera1", 5.0, "reject")
    write_edits(path, [*ROWS, other])
    first = path.read_bytes()
    found = read_edits(path, "camera5", TIMES, SIZE)
    assert len(found.rows) == len(ROWS)
    for one, two in zip(found.rows, ROWS, strict=True):
        assert (one.edit, one.name) == (two.edit, two.name)
        numbers = [[r.t_s, r.u_px, r.v_px, r.value] for r in (one, two)]
        np.testing.assert_array_equal(*numbers)
    assert found.rows[1].note == 'glare, "worst" of all'
    write_edits(path, [*found.rows, other])
    assert path.read_bytes() == first
    write_edits(path, [])
    assert not path.exists()


def test_edits_are_found_by_frame():
    edits = CameraEdits(ROWS)
    assert edits.benchmark_s == 421.04
    assert NO_EDITS.benchmark_s is None
    assert edits.verdict(440.0).edit == "reject"
    assert edits.verdict(421.0) is None
    (corners,) = edits.masks_px(440.0)
    assert corners.shape == (3, 2)
    np.testing.assert_allclose(edits.pose, [np.deg2rad(0.25), 0.0, 0.0, 1.0])
    np.testing.assert_array_equal(NO_EDITS.pose, [0.0, 0.0, 0.0, 1.0])
    assert list(edits.features_px(440.0)) == ["dot 3"]
    assert edits.features_px(421.0) == {}
    assert "mask 1" in str(edits)
    assert len(POSE) == 4


@pytest.mark.parametrize(
    ("line", "code"),
    [
        ("camera5,430,reject,,,,,", "time-not-covered"),
        ("camera5,,reject,,,,,", "time-not-covered"),
        ("camera5,440,rejct,,,,,", "edit-unusable"),
        ("camera5,440,rim,,720,3,,", "value-range"),
        ("camera5,440,rim,,,3,,", "value-range"),
        ("camera5,440,feature,,20,3,,", "edit-unusable"),
        ("camera5,440,mask,a,20,3,,", "edit-unusable"),
        ("camera5,,pose,roll,,,2,", "edit-unusable"),
        ("camera5,,pose,rotation_x_deg,,,50,", "value-range"),
        ("camera5,,pose,focal_factor,,,,", "value-range"),
        ("camera5,440,reject,,,,," + 501 * "n", "value-range"),
        ("camera5,x,reject,,,,,", "not-a-number"),
    ],
)
def test_edits_that_cannot_be_meant_are_refused(tmp_path, line, code):
    with pytest.raises(GateError) as refusal:
        read_edits(write(tmp_path / "e.csv", line), "camera5", TIMES, SIZE)
    assert refusal.value.codes == (code,)
    if code not in ("edit-unusable",):
        assert "line 2" in refusal.value.faults[0]


def test_all_faults_come_at_once_and_other_cameras_are_left_alone(tmp_path):
    path = write(tmp_path / "e.csv", "camera5,430,reject,,,,,", "camera2,1,zzz,,,,,", "camera5,440,rim,,-9,3,,")
    with pytest.raises(GateError) as refusal:
        read_edits(path, "camera5", TIMES, SIZE)
    assert refusal.value.codes == ("time-not-covered", "value-range")
    path.write_text("camera,t_s\ncamera5,3\n")
    with pytest.raises(GateError) as refusal:
        read_edits(path, "camera5", TIMES, SIZE)
    assert set(refusal.value.codes) == {"column-missing"}


def test_an_edit_of_a_camera_that_the_vehicle_lacks_is_refused(tmp_path):
    """A misspelled camera: its edit is not another camera's to leave alone."""
    path = write(tmp_path / "e.csv", "camera5,440,reject,,,,,", "camra5,421,reject,,,,,", "camera2,1,reject,,,,,")
    with pytest.raises(GateError) as refused:
        read_edits(path, "camera5", TIMES, SIZE, ("camera2", "camera5"))
    assert refused.value.codes == ("name-unknown",)
    assert "line 3" in str(refused.value)
    assert "camera5" in str(refused.value)
    assert len(read_edits(path, "camera5", TIMES, SIZE).rows) == 1
