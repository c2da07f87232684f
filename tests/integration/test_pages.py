"""Pages of figures in a real browser: nothing but the file is loaded, and readers can explore the chart."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from sierra.deliverables.figures.drawing import Drawing, rendered
from tests.browser import Browser
from tests.unit.deliverables.test_figures import NAMES, SIZES, drawing
from tests.unit.deliverables.test_html import HOSTILE, TITLE

pytestmark = pytest.mark.real


@pytest.fixture
def browser(require: Callable[..., str], tmp_path: Path) -> Iterator[Browser]:
    with Browser(require("chromium"), tmp_path / "profile") as browser:
        yield browser


def opened(browser: Browser, shown: Drawing, folder: Path, **more: object) -> Browser:
    ((_, data),) = rendered(replace(shown, formats=("html",)))
    (folder / "figure.html").write_bytes(data)
    browser.open(folder / "figure.html", **more)  # type: ignore[arg-type]
    assert browser.console == []
    assert [url for url in browser.requests if not url.startswith("data:image/svg+xml;base64,")] == [
        (folder / "figure.html").as_uri()
    ]
    return browser


def plot(browser: Browser) -> tuple[float, float, float, float]:
    """Return left, top, width and height of the area of the first chart."""
    return tuple(
        browser.run("(() => { const r = document.querySelector('.u-over').getBoundingClientRect(); "
                    "return [r.x, r.y, r.width, r.height] })()")
    )  # fmt: skip


def said(browser: Browser) -> str:
    text: str = browser.run("document.querySelector('.readout').innerText.replace(/\\s+/g, ' ')")
    return text


def has(browser: Browser, folder: Path, colour: str) -> bool:
    """Return whether a colour is on the page, or one that is hardly different: edges of lines are blended."""
    browser.picture(folder / "page.png")
    with Image.open(folder / "page.png") as image:
        pixels = np.asarray(image.convert("RGB")).astype(int)
    distances = np.abs(pixels - list(bytes.fromhex(colour[1:]))).sum(axis=2)
    return bool((distances < 20).any())


def picture(browser: Browser) -> list[str]:
    """Return the curves of all charts as they are drawn."""
    found: list[str] = browser.run("[...document.querySelectorAll('canvas')].map(one => one.toDataURL())")
    return found


def series(browser: Browser, folder: Path) -> dict[str, bool]:
    """Return whether the color of each series is on the page, except for its swatch in the legend."""
    browser.run("document.querySelectorAll('.swatch').forEach(one => one.style.visibility = 'hidden')")
    names = browser.run("JSON.parse(document.querySelector('section > script').textContent).charts[0].series")
    dark = browser.run("matchMedia('(prefers-color-scheme: dark)').matches")
    return {one["name"]: has(browser, folder, one["colours"][dark]) for one in names}


@pytest.mark.parametrize("width", [1200, 390])
@pytest.mark.parametrize("dark", [False, True])
def test_a_chart_over_time_is_drawn_and_shows_values_where_the_pointer_is(
    browser: Browser, tmp_path: Path, width: int, dark: bool
) -> None:
    opened(browser, drawing(), tmp_path, width=width, dark=dark)
    assert browser.run("document.documentElement.scrollWidth") == width
    left, top, across, down = plot(browser)
    browser.move(left + across * 10 / 19, top + down / 2)
    browser.settle()
    assert said(browser) == (
        "time [s] = 10 population size [robots] value interval n 1 20 [19, 21] 10 2 30 [29, 31] 10 "
        "4 40 [39, 41] 10 8 50 [49, 51] 10"
    )
    assert set(series(browser, tmp_path).values()) == {True}


@pytest.mark.nightly
def test_a_series_can_be_hidden_and_shown_again(browser: Browser, tmp_path: Path) -> None:
    opened(browser, drawing(), tmp_path)
    assert series(browser, tmp_path)["2"]
    toggle = "document.querySelectorAll('.series')[1].click()"
    browser.run(toggle)
    browser.settle()
    assert series(browser, tmp_path) == {"1": True, "2": False, "4": True, "8": True}
    assert browser.run("document.querySelectorAll('.series')[1].ariaPressed") == "false"
    browser.run(toggle)
    browser.settle()
    assert series(browser, tmp_path)["2"]


@pytest.mark.nightly
def test_a_part_of_time_can_be_chosen_with_the_pointer_and_everything_with_a_key(browser: Browser, tmp_path: Path) -> None:
    opened(browser, drawing("timeseries", (SIZES, NAMES)), tmp_path)
    whole = picture(browser)
    left, top, across, down = plot(browser)
    browser.move(left + across * 0.25, top + down / 2, "mousePressed", "left")
    browser.move(left + across * 0.5, top + down / 2, button="left")
    browser.move(left + across * 0.5, top + down / 2, "mouseReleased", "left")
    browser.settle()
    assert picture(browser) != whole
    browser.run("document.querySelector('.plot').focus()")
    seen = []
    for key in ("Home", "ArrowRight", "End", "ArrowLeft"):
        browser.press(key)
        seen.append(said(browser).split(" population")[0])
    assert seen == ["time [s] = 0", "time [s] = 1", "time [s] = 19", "time [s] = 18"]
    assert "1 28, interval [27, 29], n = 10" in browser.run("document.querySelector('output').textContent")
    browser.press("0")
    assert picture(browser) == whole
    assert browser.console == []


def test_a_summary_has_points_for_numbers_and_names(browser: Browser, tmp_path: Path) -> None:
    for axes in ((SIZES,), (NAMES,), (NAMES, SIZES), ()):
        opened(browser, drawing("summary", axes), tmp_path)
        assert set(series(browser, tmp_path).values()) == {True}
    opened(browser, drawing("summary", (NAMES,)), tmp_path)
    left, top, across, down = plot(browser)
    browser.move(left + across / 4, top + down / 2)
    browser.settle()
    assert "scenario = low" in said(browser)
    assert "10 [9, 11] 10" in said(browser)


def test_text_of_others_is_only_text(browser: Browser, tmp_path: Path) -> None:
    browser.call("Page.addScriptToEvaluateOnNewDocument", source="window.alert = () => console.error('alert')")
    for kind in ("timeseries", "summary", "box"):
        opened(browser, drawing(kind, (HOSTILE,), title=TITLE), tmp_path)
        assert browser.run("document.querySelector('h2').textContent") == TITLE
        assert browser.run("document.querySelectorAll('b, iframe, section img[onerror]').length") == 0
    opened(browser, drawing("timeseries", (HOSTILE,)), tmp_path)
    assert str(HOSTILE.values[0]) in said(browser)


@pytest.mark.nightly
def test_the_data_can_be_copied(browser: Browser, tmp_path: Path) -> None:
    opened(browser, drawing("summary", (NAMES,)), tmp_path)
    browser.run("navigator.clipboard.writeText = async text => { window.copied = text }")
    browser.run("document.querySelector('details').open = true; document.querySelector('[data-csv]').click()")
    rows = browser.run("window.copied").split("\r\n")
    assert rows[0].startswith("scenario,never,missing,infinite,n,mean")
    assert [row.split(",")[:6] for row in rows[1:3]] == [
        ["low", "0", "0", "0", "10", "10"],
        ["high", "0", "0", "0", "10", "20"],
    ]
    assert browser.run("document.querySelector('[role=status]').textContent") == "Copied."


@pytest.mark.nightly
def test_a_page_that_may_not_use_the_clipboard_shows_the_text(browser: Browser, tmp_path: Path) -> None:
    opened(browser, drawing("box"), tmp_path)
    browser.run("navigator.clipboard.writeText = () => Promise.reject(new Error('not allowed'))")
    browser.run("document.querySelector('[data-csv]').click()")
    browser.settle()
    assert browser.run("document.querySelector('textarea').value").startswith("population_size [robots],never")


def test_other_kinds_are_shown_as_they_are_printed(browser: Browser, tmp_path: Path) -> None:
    opened(browser, drawing("box"), tmp_path)
    assert browser.run("document.querySelector('.picture img').naturalWidth") > 200
    assert has(browser, tmp_path, "#8cc0dc")
