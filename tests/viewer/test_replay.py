"""The replay page: complete, small, harmless, and alive in a real browser."""

from __future__ import annotations

import io
import os
import shutil
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from outlap.errors import OutlapError
from outlap.evaluation.recording import Event
from outlap.viewer.replay import write_replay
from recordings import circling
from synthetic_tracks import ring

TRACK = ring()
HOSTILE = "</script><script>window.hacked = 1</script><img src=x onerror='window.hacked = 1'>"
EVENTS = (
    Event(time_s=0.0, car=0, kind="start", text="start"),
    Event(time_s=1.5, car=0, kind="overtake", text=HOSTILE),
    Event(time_s=3.0, car=0, kind="lap", text="lap 1"),
)


def test_a_minute_of_four_cars_is_less_than_three_megabytes(tmp_path: Path):
    rng = np.random.default_rng(0)
    race = circling(
        TRACK, seconds=60.0, cars=4, beams=540, interval=0.01, context=rng.standard_normal((6001, 20)),
    )  # fmt: skip
    race.motion[...] += rng.normal(0.0, 0.01, race.motion.shape)  # nothing that compresses well
    race.scan[...] += rng.uniform(0.0, 5.0, race.scan.shape).astype(np.float16)
    path = write_replay([race], TRACK, tmp_path / "race.html")
    assert path.stat().st_size < 3e6


def test_nothing_is_loaded_from_elsewhere_and_no_text_becomes_markup(tmp_path: Path):
    race = circling(TRACK, title=HOSTILE, drivers=(HOSTILE,), events=EVENTS)
    text = write_replay([race], TRACK, tmp_path / "race.html", title=HOSTILE).read_text()
    assert "http:" not in text.replace("http://www.w3.org", "")
    assert "https:" not in text
    assert "default-src 'none'" in text
    assert HOSTILE not in text
    assert text.count("</script>") == 2  # the page's own


def test_what_cannot_be_shown_together(tmp_path: Path):
    other = ring(radius=5.0)
    for races, said in (
        ([], "0 recordings; 1 to 8"),
        ([circling(TRACK)] * 9, "9 recordings; 1 to 8"),
        ([circling(TRACK), circling(other, radius=5.0)], "was raced on ring5, and ring8 is another track"),
    ):
        with pytest.raises(OutlapError, match=said):
            write_replay(races, TRACK, tmp_path / "race.html")


@pytest.fixture(scope="module")
def browser() -> Iterator[object]:
    """Debian's Chromium without a screen; skips where there is none."""
    chromium, driver = shutil.which("chromium"), shutil.which("chromedriver")
    if not (chromium and driver):
        assert "OUTLAP_NEEDS_BROWSER" not in os.environ
        pytest.skip("needs a browser: apt install chromium chromium-driver")
    from selenium import webdriver

    options = webdriver.ChromeOptions()
    options.binary_location = chromium
    for word in (
        "--headless=new",
        "--no-sandbox",
        "--disable-gpu",
        "--disable-dev-shm-usage",
        "--window-size=1300,800",
    ):
        options.add_argument(word)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    session = webdriver.Chrome(options, webdriver.ChromeService(driver))
    yield session
    session.quit()


@pytest.fixture(scope="module")
def page(browser, tmp_path_factory: pytest.TempPathFactory):
    """Two races in the browser, whose names would like to run code."""
    rng = np.random.default_rng(0)
    before = circling(TRACK, title="before", cars=2, beams=90, events=EVENTS, context=rng.standard_normal((101, 8)))
    after = circling(TRACK, title=HOSTILE, speed=5.0, beams=90, drivers=(HOSTILE,), outcome="crash")
    path = write_replay([before, after], TRACK, tmp_path_factory.mktemp("page") / "race.html", title=HOSTILE)
    browser.get(path.as_uri())
    return browser


def at(page) -> float:
    """The time that is shown."""
    return page.execute_script("return outlap.state.time")


def picture(page) -> np.ndarray:
    """What the browser shows: (height, width, 3)."""
    return np.asarray(Image.open(io.BytesIO(page.get_screenshot_as_png())).convert("RGB"))


def test_it_loads_without_a_complaint_and_runs_no_foreign_code(page):
    assert [entry for entry in page.get_log("browser") if entry["level"] in ("SEVERE", "WARNING")] == []
    assert page.execute_script("return window.hacked") is None
    assert HOSTILE in page.find_element("id", "title").text
    assert len(page.find_elements("css selector", "img")) == 0


def test_it_shows_both_cars_where_they_are(page):
    page.execute_script("outlap.seek(0)")
    shown = picture(page)
    for colour in ((0, 0x72, 0xB2), (0xD5, 0x5E, 0)):
        assert (np.abs(shown.astype(int) - colour).max(axis=2) < 12).sum() > 30
    page.execute_script("outlap.seek(3)")
    assert (picture(page) != shown).any()


@pytest.mark.parametrize("speed", ["0.5", "2"])
def test_it_plays_at_its_speed_and_pauses(page, speed: str):
    page.execute_script("outlap.seek(0); window.begun = performance.now()")
    page.find_element("css selector", f"#speed option[value='{speed}']").click()
    page.find_element("id", "play").click()
    until = time.monotonic() + 20.0
    while at(page) < 0.5 and time.monotonic() < until:
        time.sleep(0.02)
    # Until the last picture, by the page's own clock; it began a little before the click.
    shown, taken = page.execute_script("return [outlap.state.time, (outlap.state.last - window.begun) / 1000]")
    page.find_element("id", "play").click()
    assert shown >= 0.5
    assert shown <= float(speed) * taken + 1e-3
    assert shown >= float(speed) * (taken - 1.0)
    stopped = at(page)
    time.sleep(0.1)
    assert at(page) == stopped


def test_it_steps_and_scrubs(page):
    page.execute_script("outlap.seek(1)")
    page.find_element("id", "forward").click()
    assert at(page) == pytest.approx(1.04, abs=1e-3)
    page.find_element("id", "back").click()
    assert at(page) == pytest.approx(1.0, abs=1e-3)
    scrub = page.find_element("id", "scrub")
    page.execute_script("arguments[0].value = 2.5; arguments[0].dispatchEvent(new Event('input'))", scrub)
    assert at(page) == pytest.approx(2.5)


def test_a_click_on_an_event_or_a_plot_leads_there(page):
    rows = page.find_elements("css selector", "#events tr")
    assert [row.get_attribute("data-kind") for row in rows] == ["start", "overtake", "lap"]
    rows[2].click()
    assert at(page) == pytest.approx(3.0)
    plots = page.find_elements("css selector", "#plots canvas")
    labels = [plot.get_attribute("aria-label") for plot in plots]
    for wanted in ("speed [m/s]", "steering [rad]", "slip angle [rad]", "reward: progress", "context, component 2"):
        assert wanted in labels
    plots[0].click()  # in its middle
    assert at(page) == pytest.approx(2.0, abs=0.05)


def test_views_follow_and_compare(page):
    page.execute_script("outlap.seek(1)")
    overlaid = picture(page)
    page.find_element("css selector", "#layout option[value='beside']").click()
    beside = picture(page)
    assert (beside != overlaid).any()
    page.find_element("css selector", "#follow option[value='0:1']").click()
    assert (picture(page) != beside).any()
    for toggle in ("lidar", "lines", "trails"):
        before = picture(page)
        page.find_element("id", toggle).click()
        assert (picture(page) != before).any(), toggle
        page.find_element("id", toggle).click()
    assert [entry for entry in page.get_log("browser") if entry["level"] == "SEVERE"] == []
