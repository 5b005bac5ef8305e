"""Text burnt into a film is found, whatever lies behind it; paint, shade and a film at rest are not taken for it."""

import os
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from flightmodel.film import Frames, burnt_in

TEXT_AT, HEIGHT, WIDTH = (200, 150), 240, 480


def with_text(picture, number):
    """A time code of which the last digits change."""
    out = picture.copy()
    cv2.putText(out, f"229:12:59:{10.0 + 0.137 * number:06.3f}", TEXT_AT, cv2.FONT_HERSHEY_SIMPLEX, 0.6, 255, 2)
    return out


def cloth(count, moved_px=3.0, seed=0):
    """Pictures (count) of painted cloth that moves, with noise."""
    rng = np.random.default_rng(seed)
    paint = cv2.resize(
        rng.uniform(40, 200, (40, 80)).astype(np.float32), (WIDTH, HEIGHT), interpolation=cv2.INTER_NEAREST
    )
    paint = cv2.GaussianBlur(paint, (0, 0), 0.8)
    pictures = []
    for k in range(count):
        shift = np.array([[1.0, 0.0, moved_px * np.sin(1.7 * k)], [0.0, 1.0, moved_px * np.cos(1.1 * k)]])
        picture = cv2.warpAffine(paint, shift, (WIDTH, HEIGHT), borderMode=cv2.BORDER_REFLECT)
        pictures.append(np.clip(picture + rng.standard_normal(paint.shape), 0, 255).astype(np.uint8))
    return pictures


def compressed(picture):
    return cv2.imdecode(cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 60])[1], cv2.IMREAD_GRAYSCALE)


@pytest.mark.parametrize("change", [lambda p: p, compressed], ids=["as written", "compressed"])
def test_a_time_code_is_found_with_its_changing_digits(change):
    pictures = [change(with_text(p, k)) for k, p in enumerate(cloth(9))]
    found = burnt_in(pictures)
    (wide, tall), _ = cv2.getTextSize("229:12:59:10.000", cv2.FONT_HERSHEY_SIMPLEX, 0.6, 2)
    u, v = TEXT_AT
    assert found[v - tall : v, u : u + wide].all()
    assert found.mean() < 0.15
    assert not found[: v - 3 * tall].any()
    # a frame without a picture, and one of another size, change nothing
    again = burnt_in([*pictures[:4], np.zeros((0, 0), np.uint8), np.zeros((20, 20), np.uint8), *pictures[4:]])
    np.testing.assert_array_equal(again, found)


def test_what_moves_is_no_text_and_what_rests_is_not_told_from_it():
    assert burnt_in(cloth(9)) is None
    # nothing moves: the paint is as steady as the text
    assert burnt_in([with_text(p, 0) for p in cloth(9, moved_px=0.0)]) is None
    assert burnt_in([with_text(p, k) for k, p in enumerate(cloth(4))]) is None
    assert burnt_in([]) is None


def test_dead_rows_and_columns_are_left_out():
    """Also where they hardly stand out, and where most of what is steady and sharp is theirs."""
    columns, row = np.arange(20, WIDTH, 53), 77
    pictures = cloth(9)
    for picture in pictures:
        picture[:, columns] = np.linspace(60, 255, len(columns))
        picture[row] = 120
    found = burnt_in(pictures)
    assert found[:, columns].all()
    assert found[row].all()
    assert found[:, columns[:-1] + 26].mean() < 0.1  # between two columns, but for the row


def test_frames_of_a_folder_and_of_a_film_show_the_same_text(tmp_path):
    pictures = [with_text(p, k) for k, p in enumerate(cloth(30))]
    film = cv2.VideoWriter(str(tmp_path / "film.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 10.0, (WIDTH, HEIGHT), False)
    for k, picture in enumerate(pictures):
        cv2.imwrite(str(tmp_path / f"{k:02d}.png"), picture)
        film.write(picture)
    film.release()
    time_s, camera = np.arange(30.0), SimpleNamespace(size_px=(WIDTH, HEIGHT))
    of_folder = Frames(camera, "c", time_s, tuple(sorted(tmp_path.glob("*.png"))), 0.0)
    of_film = Frames(camera, "c", time_s, (tmp_path / "film.avi",), 0.0, np.arange(30))
    assert np.mean(of_folder.burnt_in & of_film.burnt_in) > 0.9 * np.mean(of_folder.burnt_in | of_film.burnt_in)
    # what is no picture is not waited for
    (tmp_path / "00.png").unlink()
    os.mkfifo(tmp_path / "00.png")
    (tmp_path / "29.png").write_bytes(b"nothing")
    again = Frames(camera, "c", time_s, tuple(sorted(tmp_path.glob("*.png"))), 0.0).burnt_in
    assert np.mean(again & of_folder.burnt_in) > 0.9 * np.mean(again | of_folder.burnt_in)
    (tmp_path / "film.avi").write_bytes(b"nothing")
    assert Frames(camera, "c", time_s, (tmp_path / "film.avi",), 0.0, np.arange(30)).burnt_in is None
