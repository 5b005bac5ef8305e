"""The report as a reader meets it, in a headless Chromium: one cursor, one zoom, a view that follows, no network."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from flightmodel.deflection import lv_direction
from flightmodel.geometry import bend
from tests.postflight.report.conftest import HOSTILE, HOSTILE_EVENT
from tests.refusing import numbers_in

pytestmark = pytest.mark.browser

WINDOWS = "charts.map((c) => [c.u.scales.x.min, c.u.scales.x.max])"
CURSORS = """charts.map((c) => {
    const line = c.cursor.getBoundingClientRect(), area = c.u.over.getBoundingClientRect();
    return c.u.posToVal(line.left + line.width / 2 - area.left, "x");
})"""
PIXELS = "document.getElementById('vehicle').toDataURL()"


def middle_of(page, panel: str, share: float = 0.5) -> tuple[float, float]:
    """Place on the screen of a share of a panel's width."""
    area = page.locator(f"#panel-{panel} .u-over")
    area.scroll_into_view_if_needed()
    box = area.bounding_box()
    return box["x"] + share * box["width"], box["y"] + 0.5 * box["height"]


def test_nothing_is_asked_for_and_nothing_complains(opened, report) -> None:
    seen = opened()
    assert seen.said == []
    assert {url for url in seen.requests if not url.startswith("data:")} == {report.as_uri()}


ATTEMPTS = (
    "fetch('http://192.0.2.1/a').catch(() => 0)",
    "new Image().src = 'http://192.0.2.1/b'",
    "document.body.appendChild(document.createElement('script')).textContent = '1'",
)


@pytest.mark.parametrize("attempt", ATTEMPTS)
def test_policy_forbids_network_and_foreign_scripts(opened, attempt: str) -> None:
    page = opened().page
    blocked = page.evaluate(
        f"""() => new Promise((tell) => {{
            document.addEventListener("securitypolicyviolation", (e) => tell(e.effectiveDirective));
            {attempt};
            setTimeout(() => tell(""), 3000);
        }})"""
    )
    assert blocked in ("connect-src", "img-src", "script-src-elem", "script-src")


def test_hostile_names_stay_text(opened) -> None:
    seen = opened()
    assert seen.dialogs == []
    assert HOSTILE in seen.page.locator(".kicker").inner_text()
    assert HOSTILE_EVENT in seen.page.locator("#events").inner_text()
    assert seen.page.evaluate("data.events.map((e) => e.name)").count(HOSTILE_EVENT) == 1
    assert seen.page.locator("script").count() == 2
    seen.page.evaluate("document.querySelectorAll('details').forEach((d) => { d.open = true; })")
    assert HOSTILE in seen.page.locator("#how").inner_text()


def test_one_cursor_on_all_panels(opened) -> None:
    page = opened().page
    before = page.evaluate(CURSORS)
    values = page.locator("#panel-mach .legend").inner_text()
    page.mouse.move(*middle_of(page, "altitude", 0.3))
    page.wait_for_timeout(50)
    at, window = page.evaluate("clock.now"), page.evaluate(WINDOWS)[0]
    assert at == pytest.approx(window[0] + 0.3 * (window[1] - window[0]), abs=0.2)
    after = page.evaluate(CURSORS)
    assert len(after) >= 10
    # a pixel of the narrowest panel is a tenth of a second
    assert after == pytest.approx([at] * len(after), abs=0.15)
    assert after[0] != pytest.approx(before[0], abs=1.0)
    assert float(page.locator("#time").input_value()) == pytest.approx(at, abs=0.011)
    assert page.locator("#panel-mach .legend").inner_text() != values


def test_zoom_is_shared_and_comes_back(opened) -> None:
    page = opened().page
    first = page.evaluate(WINDOWS)
    page.mouse.move(*middle_of(page, "speed", 0.4))
    page.mouse.down()
    page.mouse.move(*middle_of(page, "speed", 0.6), steps=4)
    page.mouse.up()
    page.wait_for_timeout(100)
    zoomed = page.evaluate(WINDOWS)
    low, high = first[0]
    assert zoomed[0] == pytest.approx([low + 0.4 * (high - low), low + 0.6 * (high - low)], abs=0.2)
    assert all(window == pytest.approx(zoomed[0], abs=1e-6) for window in zoomed)
    page.mouse.dblclick(*middle_of(page, "speed"))
    assert page.evaluate(WINDOWS) == first
    page.locator("#whole").click()
    assert page.evaluate(WINDOWS) == [page.evaluate("data.span")] * len(first)


def test_view_follows_time_and_sliders_and_turns(opened) -> None:
    page = opened().page
    page.wait_for_timeout(100)
    slider, canvas = page.locator("#time"), page.locator("#vehicle")
    at_peak, pixels = float(canvas.get_attribute("data-deflection")), page.evaluate(PIXELS)
    assert at_peak > 3.0
    slider.fill("426")
    page.wait_for_timeout(100)
    early = page.evaluate(PIXELS)
    assert float(canvas.get_attribute("data-deflection")) < 1.5
    assert early != pixels
    assert page.locator("#nearest").get_attribute("data-time") == "426"
    slider.fill("440.6")
    page.locator("#exaggeration").fill("5")
    page.wait_for_timeout(100)
    large = page.evaluate(PIXELS)
    assert large not in (pixels, early)
    assert 5.0 in numbers_in(page.locator("#vehicle-words").inner_text())
    canvas.focus()
    page.keyboard.press("ArrowLeft")
    page.wait_for_timeout(100)
    assert page.evaluate(PIXELS) != large


def test_a_picture_sets_the_time(opened) -> None:
    page = opened().page
    frame = page.locator(".frame").first
    frame.click()
    assert page.evaluate("clock.now") == pytest.approx(float(frame.get_attribute("data-time")))
    assert frame.get_attribute("aria-current") == "true"


def test_a_line_can_be_hidden(opened) -> None:
    page = opened().page
    button = page.locator("#panel-deflection .legend button").first
    button.click()
    assert button.get_attribute("aria-pressed") == "false"
    assert page.evaluate("charts[0].u.series.slice(1, 5).map((s) => s.show)") == [False, False, False, True]


def test_everything_is_reached_by_keyboard_and_shows_it(opened) -> None:
    page = opened().page
    reached = []
    for _ in range(80):
        page.keyboard.press("Tab")
        name, outline = page.evaluate(
            "[document.activeElement.id || document.activeElement.className || document.activeElement.tagName,"
            " getComputedStyle(document.activeElement).outlineStyle]"
        )
        assert outline != "none", f"{name} shows no focus"
        reached.append(name)
        if name == "plot" and "vehicle" in reached:
            break
    assert {"skip", "frame", "time", "pulse", "whole", "plot"} <= set(reached)
    page.locator("#panel-mach .plot").focus()
    before = page.evaluate("clock.now")
    page.keyboard.press("Shift+ArrowRight")
    page.keyboard.press("ArrowLeft")
    width = page.evaluate("clock.to - clock.from")
    assert page.evaluate("clock.now") == pytest.approx(before + 0.045 * width, abs=1e-6)
    page.keyboard.press("+")
    assert page.evaluate("clock.to - clock.from") < 0.7 * width
    page.keyboard.press("0")
    assert page.evaluate(WINDOWS)[-1] == page.evaluate("data.span")


@pytest.mark.parametrize("width", [1440, 800, 390])
def test_page_is_not_wider_than_the_window(opened, width: int) -> None:
    page = opened(width).page
    assert page.evaluate("document.documentElement.scrollWidth") <= width


def test_prints_with_everything_open(opened) -> None:
    page = opened().page
    assert page.locator("details[open]").count() == 0
    count = "window.openThen = document.querySelectorAll('details[open]').length"
    page.evaluate(f"window.addEventListener('beforeprint', () => {{ {count}; }})")
    pdf = page.pdf(format="A4", print_background=True)
    assert pdf.startswith(b"%PDF")
    assert pdf.count(b"/Type /Page\n") >= 6
    assert page.evaluate("window.openThen") == page.locator("details:not(.listed)").count() > 5
    assert page.locator("details[open]").count() == 0


def test_no_table_is_wider_than_paper_and_no_list_is_printed(opened) -> None:
    """A4 less its margins is 184 mm, 695 px; a list is in its CSV, and on the page in a part that is folded."""
    page = opened(695).page
    page.emulate_media(media="print")
    page.evaluate("window.dispatchEvent(new Event('beforeprint'))")
    size = "(one) => [one.getBoundingClientRect().right, one.rows.length, one.offsetHeight]"
    tables = page.evaluate(f"[...document.querySelectorAll('table')].map({size})")
    assert max(right for right, _, _ in tables) <= 695
    assert any(rows > 20 and height == 0 for _, rows, height in tables), "frames are a list"
    assert all(rows <= 45 for _, rows, height in tables if height)


def test_cursor_stays_at_its_time_on_paper(opened) -> None:
    page = opened(800).page
    page.evaluate("clock.set(436.5); window.dispatchEvent(new Event('beforeprint'))")
    page.wait_for_timeout(100)
    widths = page.evaluate("charts.map((c) => c.u.width)")
    assert page.evaluate(CURSORS) == pytest.approx([436.5] * len(widths), abs=0.15)
    page.evaluate("window.dispatchEvent(new Event('afterprint'))")
    page.wait_for_timeout(100)
    assert page.evaluate("charts.map((c) => c.u.width)") != widths


def test_aeroshell_deflects_on_the_page_as_in_the_library(opened) -> None:
    page = opened().page
    theta, plane, station = np.deg2rad(7.0), np.deg2rad(215.0), 0.2
    points = np.array([[-0.4, 1.1, 0.3], [0.0, 0.0, -1.4], [-0.2, 0.0, 0.0]])
    lateral = (7.0 * lv_direction(plane)[1:]).tolist()
    drawn = page.evaluate(
        "([points, b, joint]) => points.map(rotation(b, 1, joint))", [(1e3 * points).tolist(), lateral, 1e3 * station]
    )
    assert np.array(drawn) / 1e3 == pytest.approx(bend(points, theta, plane, station), abs=1e-9)


def test_flight_without_vehicle_reads_as_well(opened, rocket: Path) -> None:
    seen = opened(path=next((rocket / "runs").glob("*/report.html")))
    assert seen.said == []
    assert seen.page.locator("#vehicle").count() == 0
    seen.page.locator("#time").fill("30")
    assert len(set(seen.page.evaluate("charts.map((c) => c.cursor.dataset.time)"))) == 1
