"""A lens from checkerboard corners: a real one against a published calibration, made ones against their truth."""

from pathlib import Path

import cv2
import numpy as np
import pandas as pd
import pytest

from estimators.calibration import _sd, calibrate_lens
from flightmodel.checks import GateError

CORNERS = pd.read_csv(Path(__file__).parents[1] / "data/fisheye/corners_even.csv")
# of the data's own calibration with OpenCV, on all pictures (README beside the data)
REFERENCE_RMS_PX = 0.3384
PUBLISHED = {"focal": (333.156, 333.462), "centre": (347.358, 244.673)}


def made(lens, seed, noise_px=0.2):
    """Corners of a board in twenty poses through a known lens."""
    rng = np.random.default_rng(seed)
    x, y = np.meshgrid(0.03 * np.arange(8), 0.03 * np.arange(6))
    board = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    matrix = np.array([[420.0, 0.0, 330.0], [0.0, 417.0, 236.0], [0.0, 0.0, 1.0]])
    k = np.array([-0.03, 0.01, -0.004, 0.001]) if lens == "fisheye" else np.array([-0.12, 0.05, 0.001, -0.0008, -0.01])
    project = cv2.fisheye.projectPoints if lens == "fisheye" else cv2.projectPoints
    rows = []
    while len(rows) < 20 * len(board):
        turn = rng.uniform(-0.6, 0.6, 3)
        shift = np.array([rng.uniform(-0.25, 0.05), rng.uniform(-0.2, 0.05), rng.uniform(0.22, 0.45)])
        pixels = project(board[:, None], turn, shift, matrix, k)[0].reshape(-1, 2)
        if (pixels > 0.0).all() and (pixels < [639.0, 479.0]).all():
            pixels += noise_px * rng.standard_normal(pixels.shape)
            rows += [(len(rows) // len(board), *p[:2], *q) for p, q in zip(board, pixels, strict=True)]
    table = pd.DataFrame(rows, columns=["image", "X_m", "Y_m", "u_px", "v_px"])
    return table, np.concatenate([matrix[[0, 1], [0, 1]], matrix[:2, 2], k])


def test_a_real_fisheye_reprojects_as_well_as_the_published_calibration():
    found = calibrate_lens(CORNERS, (640, 480))
    assert found.rms_px == pytest.approx(REFERENCE_RMS_PX, rel=0.05)
    assert (found.pictures, found.corners) == (17, 816)
    np.testing.assert_allclose(found.focal_px, PUBLISHED["focal"], rtol=0.01)
    np.testing.assert_allclose(found.centre_px, PUBLISHED["centre"], atol=2.0)


def test_half_of_the_pictures_calibrates_for_the_other_half():
    odd = CORNERS[CORNERS["image"].rank(method="dense") % 2 == 1]
    found = calibrate_lens(odd, (640, 480))
    matrix = np.array(
        [[found.focal_px[0], 0, found.centre_px[0]], [0, found.focal_px[1], found.centre_px[1]], [0, 0, 1]]
    )
    square = []
    for image, rows in CORNERS.groupby("image"):
        if image in set(odd["image"]):
            continue
        board = np.column_stack([rows["X_m"], rows["Y_m"], np.zeros(len(rows))])
        seen = rows[["u_px", "v_px"]].to_numpy(dtype=float)
        flat = cv2.fisheye.undistortPoints(seen[:, None], matrix, found.distortion)
        _, turn, shift = cv2.solvePnP(board, flat, np.eye(3), None)
        # refined through the lens itself
        for _ in range(10):
            pixels, by = cv2.fisheye.projectPoints(board[:, None], turn, shift, matrix, found.distortion)
            step = np.linalg.lstsq(by[:, 8:14], (seen - pixels.reshape(-1, 2)).ravel(), rcond=None)[0]
            turn, shift = turn + step[:3, None], shift + step[3:, None]
        square.append(np.sum((seen - pixels.reshape(-1, 2)) ** 2, axis=1))
    # 5 % for the model's error, which eight or nine pictures leave larger than all do, and its own scatter
    assert np.sqrt(np.mean(np.concatenate(square))) < 1.1 * REFERENCE_RMS_PX


@pytest.mark.parametrize("lens", ["fisheye", "pinhole"])
def test_made_corners_give_their_lens_back_within_its_sd(lens):
    normal = []
    for seed in range(8):
        table, truth = made(lens, seed)
        found = calibrate_lens(table, (640, 480), lens)
        error = np.concatenate([found.focal_px, found.centre_px, found.distortion]) - truth
        normal.append(error / found.sd)
    # eight lenses of eight or nine correlated parameters: half of them count as independent, chi-square 0.1 % each side
    assert 0.4 < np.mean(np.square(normal)) < 2.0


def lens_of(found):
    return np.concatenate([found.focal_px, found.centre_px, found.distortion])


def test_halves_of_real_pictures_agree_within_their_sd():
    """Corners taken as independent leave the halves 2.1 sd apart (rms)."""
    rng, images, normal = np.random.default_rng(5), CORNERS["image"].unique(), []
    for _ in range(12):
        first = CORNERS["image"].isin(rng.permutation(images)[: len(images) // 2])
        a, b = (calibrate_lens(CORNERS[rows], (640, 480)) for rows in (first, ~first))
        normal.append((lens_of(a) - lens_of(b)) / np.hypot(a.sd, b.sd))
    # splits of the same pictures say much the same: no more than the size of one is tested
    assert 0.4 < np.sqrt(np.mean(np.square(normal))) < 1.3


def test_corners_that_err_together_in_each_picture_stay_within_the_sd():
    """Every picture's board bent by its own smooth half pixel: independent corners state a third of the error."""
    normal, narrow = [], []
    for seed in range(20, 32):
        table, truth = made("fisheye", seed, noise_px=0.1)
        rng = np.random.default_rng(seed)
        x, y = (table[c] / table[c].max() - 0.5 for c in ("X_m", "Y_m"))
        shape = np.stack([x * x, x * y, y * y])
        for column in ("u_px", "v_px"):
            size = 3.0 * rng.standard_normal((3, table["image"].nunique()))
            table[column] += np.sum(size[:, table["image"]] * shape, axis=0)
        table = table[table["u_px"].between(0.0, 639.0) & table["v_px"].between(0.0, 479.0)]
        found = calibrate_lens(table, (640, 480), "fisheye")
        normal.append((lens_of(found) - truth) / found.sd)
        narrow.append(found.rms_px)
    assert np.min(narrow) > 0.2  # the bends are there
    # twelve lenses of eight correlated parameters, half of which count as independent: chi-square 0.1 % each side
    assert 0.45 < np.mean(np.square(normal)) < 1.9


def test_of_corners_that_err_alone_the_sd_is_that_of_the_linear_problem():
    """Residuals that no picture's own fit would lessen: no jackknife, and the variance has its degrees of freedom."""
    rng = np.random.default_rng(8)
    pictures, corners, lens = 4, 12, 3
    jacobian = np.zeros((pictures * corners, lens + 6 * pictures))
    residual = rng.standard_normal(pictures * corners)
    for k in range(pictures):
        rows, pose = slice(k * corners, (k + 1) * corners), slice(lens + 6 * k, lens + 6 * (k + 1))
        jacobian[rows, :lens], jacobian[rows, pose] = (
            rng.standard_normal((corners, lens)),
            rng.standard_normal((corners, 6)),
        )
        own = np.linalg.qr(jacobian[rows][:, [*range(lens), *range(pose.start, pose.stop)]])[0]
        residual[rows] -= own @ (own.T @ residual[rows])
    variance = residual @ residual / (pictures * corners - lens - 6 * pictures)
    wanted = np.sqrt(variance * np.diag(np.linalg.inv(jacobian.T @ jacobian))[:lens])
    np.testing.assert_allclose(_sd(residual, jacobian, lens, [corners] * pictures), wanted, rtol=1e-9)


def test_the_lines_for_a_vehicle_file_are_toml():
    import tomllib

    lines = tomllib.loads(calibrate_lens(CORNERS, (640, 480)).toml())
    assert lines["lens"] == "fisheye"
    assert len(lines["distortion"]) == 4
    assert 0.0 < lines["uncertainty"]["focal"] < 0.01


def refusal_of(corners, code, size_px=(640, 480)):
    with pytest.raises(GateError) as refusal:
        calibrate_lens(corners, size_px)
    assert set(refusal.value.codes) == {code}
    return str(refusal.value)


def test_tables_that_cannot_be_used_say_why():
    misspelt = refusal_of(CORNERS.rename(columns={"u_px": "upx"}), "column-missing")
    assert "u_px" in misspelt
    assert "upx" in misspelt
    assert "320 x 240" in refusal_of(CORNERS, "value-range", (320, 240))
    few = CORNERS[CORNERS["image"].isin(CORNERS["image"].unique()[:2])]
    refusal_of(few, "too-few-data")
    broken = CORNERS.astype({"u_px": object})
    broken.loc[4, "u_px"] = "x"
    assert "line 6" in refusal_of(broken, "not-a-number")
    with pytest.raises(GateError) as flat:
        calibrate_lens(CORNERS.assign(X_m=0.0), (640, 480))
    assert set(flat.value.codes) <= {"not-converged", "not-observable"}


def test_ill_conditioned_pictures_are_refused():
    """A board that is never tilted leaves the focal length undetermined: nearer and longer look alike."""
    rng = np.random.default_rng(3)
    x, y = np.meshgrid(0.03 * np.arange(5), 0.03 * np.arange(4))
    rows = [
        (image, a, b, 250.0 + 900.0 * a, 200.0 + 900.0 * b)
        for image in range(5)
        for a, b in zip(x.flat, y.flat, strict=True)
    ]
    corners = pd.DataFrame(rows, columns=["image", "X_m", "Y_m", "u_px", "v_px"])
    corners[["u_px", "v_px"]] += 1e-4 * rng.standard_normal((len(corners), 2))
    with pytest.raises(GateError) as refusal:
        calibrate_lens(corners, (640, 480), "pinhole")
    assert refusal.value.codes == ("not-observable",)
