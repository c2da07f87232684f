"""Reports in a real browser: nothing but the file is loaded, nothing of others is executed, and readers can use the page."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests import projects, stores
from tests.browser import Browser
from tests.support import filmed, reported
from tests.waiting import until

pytestmark = pytest.mark.real


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The report of a project whose texts attack the page."""
    root = reported.make(tmp_path_factory.mktemp("report") / "project")
    stores.ask(root, "sizes")
    done = projects.quick(root, "report", "--to", str(root.parent / "report.html"))
    assert done.returncode == 0, done.stderr
    return root.parent / "report.html"


@pytest.fixture
def browser(require: Callable[..., str], tmp_path: Path) -> Iterator[Browser]:
    with Browser(require("chromium"), tmp_path / "profile") as browser:
        browser.call("Page.addScriptToEvaluateOnNewDocument", source="window.alert = () => console.error('alert')")
        yield browser


def opened(browser: Browser, file: Path, *, width: int = 1280, dark: bool = False) -> Browser:
    browser.open(file, width=width, dark=dark)
    assert browser.console == []
    assert [url for url in browser.requests if not url.startswith("data:image/svg+xml;base64,")] == [file.as_uri()]
    return browser


CONTRAST = """
(() => {
  const parts = (text) => text.match(/[\\d.]+/g).map(Number);
  const light = ([r, g, b]) => [r, g, b].map((v) => (v /= 255) <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4)
    .reduce((sum, v, k) => sum + v * [0.2126, 0.7152, 0.0722][k], 0);
  const back = (one) => { for (; one; one = one.parentElement) {
    const found = parts(getComputedStyle(one).backgroundColor); if (found.length < 4 || found[3] > 0) return found; }
    return [255, 255, 255]; };
  const texts = [...document.querySelectorAll("body *")].filter((one) => one.checkVisibility() && one.tagName != "SCRIPT" &&
    [...one.childNodes].some((child) => child.nodeType == 3 && child.textContent.trim()));
  const ratios = texts.map((one) => {
    const [a, b] = [light(parts(getComputedStyle(one).color)), light(back(one))].sort((x, y) => y - x);
    return [(a + 0.05) / (b + 0.05), one.tagName + " " + one.className + " " + one.textContent.slice(0, 40)]; });
  return ratios.sort((x, y) => x[0] - y[0])[0];
})()
"""
"""The smallest ratio of contrast of any text (WCAG 2.2), and that text."""


@pytest.mark.parametrize("width", [1280, 390])
@pytest.mark.parametrize("dark", [False, True])
def test_a_report_is_readable_at_every_width_in_light_and_dark(
    browser: Browser, report: Path, tmp_path: Path, width: int, dark: bool
) -> None:
    opened(browser, report, width=width, dark=dark)
    assert browser.run("document.documentElement.scrollWidth") == width
    browser.run("document.querySelectorAll('details').forEach(one => one.open = true)")
    browser.settle()
    assert browser.run("document.documentElement.scrollWidth") == width
    ratio, text = browser.run(CONTRAST)
    assert ratio >= 4.5, text
    browser.picture(tmp_path / "page.png")
    with Image.open(tmp_path / "page.png") as image:
        corner = np.asarray(image.convert("L"))[:5, :5].mean()
    assert (corner < 60) == dark
    assert browser.run("[...document.images].every(one => one.naturalWidth > 100 && one.alt.length > 20)")


def test_texts_of_others_do_nothing_in_a_browser(browser: Browser, report: Path) -> None:
    opened(browser, report)
    assert browser.run("document.querySelectorAll('img:not([src^=\"data:image/svg\"]), iframe, object, form').length") == 0
    assert browser.run("[...document.querySelectorAll('h3')].filter(one => one.textContent.includes('<script>')).length") >= 2
    browser.run("document.querySelectorAll('details').forEach(one => one.open = true)")
    browser.run("document.querySelectorAll('button').forEach(one => one.click())")
    browser.settle()
    assert [line for line in browser.console if "alert" in line or "Content Security" in line] == []
    assert "<script>" in browser.run("document.querySelector('.readout').innerText + document.title + document.body.innerText")


@pytest.mark.nightly
def test_a_report_can_be_used_with_the_keyboard_alone(browser: Browser, report: Path) -> None:
    opened(browser, report)
    browser.press("Tab")
    assert browser.run("document.activeElement.textContent") == "Skip to the content"
    assert browser.run("document.activeElement.getBoundingClientRect().left") >= 0
    assert browser.run("getComputedStyle(document.activeElement).outlineStyle") == "solid"
    browser.run("document.querySelector('.figure details').open = true; document.querySelector('.plot').focus()")
    browser.settle()
    browser.press("Home")
    browser.press("ArrowRight")
    assert "tick [s] = 1" in browser.run("document.querySelector('.readout').innerText")
    assert "interval [" in browser.run("document.querySelector('output').textContent")
    assert browser.run("document.querySelector('.u-over').getBoundingClientRect().width") > 200
    names = "[...document.querySelectorAll('[tabindex=\"0\"][role=region], button, nav, section')].filter(one => " \
        "!(one.ariaLabel || one.textContent.trim() || one.getAttribute('aria-labelledby'))).length"  # fmt: skip
    assert browser.run(names) == 0


@pytest.mark.nightly
def test_commands_and_sql_can_be_copied(browser: Browser, report: Path) -> None:
    opened(browser, report)
    browser.run("navigator.clipboard.writeText = async text => { window.copied = text }")
    browser.run("document.querySelector('#design details').open = true; document.querySelector('#design .copy').click()")
    browser.settle()
    assert browser.run("window.copied").startswith(
        "WITH members AS (SELECT DISTINCT ordinal, run FROM batch_runs WHERE batch = '"
    )
    assert browser.run("document.querySelector('#design [role=status]').textContent") == " Copied."
    browser.run("navigator.clipboard.writeText = () => Promise.reject(new Error('not allowed'))")
    browser.run("document.querySelector('#reproduce .copy').click()")
    browser.settle()
    assert "Jane Doe" in browser.run("getSelection().toString()")


def test_videos_are_played_in_the_page(browser: Browser, tmp_path: Path) -> None:
    root, _ = filmed.make(tmp_path / "project")
    assert projects.quick(root, "report", "--to", str(tmp_path / "report.html")).returncode == 0
    browser.open(tmp_path / "report.html", width=390)
    video = "document.querySelector('video')"
    browser.run(f"{video}.play().then(() => new Promise(done => {{ {video}.ontimeupdate = done }}))")
    assert browser.run(f"[{video}.videoWidth, {video}.videoHeight, {video}.error]") == [200, 160, None]
    assert browser.run(f"{video}.currentTime") > 0
    assert browser.run("document.documentElement.scrollWidth") == 390
    assert browser.console == []
    assert [url for url in browser.requests if not url.startswith("data:")] == [(tmp_path / "report.html").as_uri()]


def test_a_report_needs_no_script_and_can_be_printed(browser: Browser, report: Path) -> None:
    browser.call("Emulation.setScriptExecutionDisabled", value=True)
    browser.call("Page.navigate", url=report.as_uri())
    until(lambda: browser.run("document.readyState == 'complete' && location.protocol == 'file:'"))  # no callback is called
    assert browser.run("document.querySelectorAll('canvas').length") == 0
    assert browser.run("[...document.images].filter(one => one.naturalWidth > 100).length") == 4
    assert "13 of 18 runs succeeded" in browser.run("document.body.innerText")
    browser.call("Emulation.setEmulatedMedia", media="print")
    assert not browser.run(
        "document.querySelector('nav').checkVisibility() || document.querySelector('.copy').checkVisibility()"
    )
    assert len(browser.call("Page.printToPDF")["data"]) > 50_000
