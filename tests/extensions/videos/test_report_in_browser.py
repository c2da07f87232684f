"""Reports in a real browser: nothing but the file is loaded, nothing of others is executed, and readers can use the page."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests import projects, robots, stores
from tests.browser import INJECTED, Browser
from tests.extensions.videos import filmed
from tests.support import reported
from tests.support.photographs import flaws, unfold, unnamed
from tests.waiting import until

pytestmark = [pytest.mark.real, pytest.mark.integration]


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The report of a project whose texts attack the page."""
    root = reported.make(tmp_path_factory.mktemp("report") / "project")
    stores.ask(root, "sizes")
    done = projects.quick(root, "report", "--to", str(root.parent / "report.html"))
    assert done.returncode == 0, done.stderr
    return root.parent / "report.html"


VIDEOS = """
[videos.still]
table = "floor"
column = ["i", "j", "heat"]
experiments = "population_size=1"
formats = ["gif"]
size = [320, 240]

[videos.heat]
table = "floor"
column = ["i", "j", "heat"]
experiments = "population_size=2"
title = "Heat"

[trials]
supervised = true
countdown = 0
arena = "hall 2"
"""


@pytest.fixture(scope="module")
def reports(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Path, Path]]:
    """Two reports, which have all kinds of sections: of all batches of a project with videos and trials, and of robots."""
    folder = tmp_path_factory.mktemp("reports")
    root = projects.make(
        folder / "trials", f"{reported.CONFIG}{filmed.OUTPUT}{VIDEOS}", simulator=reported.SIMULATOR + filmed.FLOOR
    )
    with pytest.MonkeyPatch.context() as monkeypatch:
        robots.register(monkeypatch)
        fleet = robots.project(folder / "robots")
        for project, *words in (
            (root, "run", "sizes", "--runs", "2", "--yes"),
            (root, "run", "population_size=1,2", "noise=0,1", "--runs", "1", "--yes"),
            (root, "video"),
            (root, "report", "--all", "--to", "../all.html"),
            (fleet, "run", "population_size=1,3", "--runs", "2", "--target", "robots"),
            (fleet, "report", "--to", "../robots.html"),
        ):
            assert projects.quick(project, *words).returncode in (0, 1)
        yield folder / "all.html", folder / "robots.html"


@pytest.fixture
def browser(require: Callable[..., str], tmp_path: Path) -> Iterator[Browser]:
    with Browser(require("chromium"), tmp_path / "profile") as browser:
        browser.call("Page.addScriptToEvaluateOnNewDocument", source="window.alert = () => console.error('alert')")
        yield browser


def opened(browser: Browser, file: Path, *, width: int = 1280, dark: bool = False) -> Browser:
    browser.open(file, width=width, dark=dark)
    assert browser.console == []
    assert [url for url in browser.requests if not url.startswith("data:")] == [file.as_uri()]
    return browser


@pytest.mark.parametrize("width", [1280, 390])
@pytest.mark.parametrize("dark", [False, True])
def test_a_report_is_readable_at_every_width_in_light_and_dark(
    browser: Browser, report: Path, tmp_path: Path, width: int, dark: bool
) -> None:
    opened(browser, report, width=width, dark=dark)
    assert flaws(browser, tmp_path / "page.png", dark=dark) == []
    unfold(browser)
    assert flaws(browser, tmp_path / "unfolded.png", dark=dark) == []
    assert unnamed(browser) == []
    assert browser.run("[...document.images].every(one => one.naturalWidth > 100 && one.alt.length > 20)")


@pytest.mark.nightly
@pytest.mark.parametrize("width", [1280, 390])
@pytest.mark.parametrize("dark", [False, True])
def test_reports_with_all_kinds_of_sections_are_readable(
    browser: Browser, reports: tuple[Path, Path], tmp_path: Path, width: int, dark: bool
) -> None:
    parts = set()
    for report in reports:
        opened(browser, report, width=width, dark=dark)
        assert flaws(browser, tmp_path / "page.png", dark=dark) == []
        unfold(browser)
        assert flaws(browser, tmp_path / "unfolded.png", dark=dark) == []
        assert unnamed(browser) == []
        parts |= set(browser.run("[...document.querySelectorAll('.part > :is(h2, h3), h4')].map(one => one.textContent)"))
    assert {"Figures", "Tables", "Videos and other files", "Comparisons", "Claims", "Failures", "Trials", "Robots"} <= parts


@pytest.mark.nightly
def test_a_gif_is_played_only_while_it_is_unfolded(browser: Browser, reports: tuple[Path, Path]) -> None:
    opened(browser, reports[0])
    shown = "document.querySelector('img[src^=\"data:image/gif\"]').checkVisibility()"
    assert not browser.run(shown)
    for moving in (True, False):
        browser.run("document.querySelector('.film summary').click()")
        assert browser.run(shown) == moving


def test_texts_of_others_do_nothing_in_a_browser(browser: Browser, report: Path) -> None:
    opened(browser, report)
    assert browser.run("document.querySelectorAll('img:not([src^=\"data:image/svg\"]), iframe, object, form').length") == 0
    assert browser.run("[...document.querySelectorAll('h3')].filter(one => one.textContent.includes('<script>')).length") >= 2
    unfold(browser)
    browser.run("document.querySelectorAll('button').forEach(one => one.click())")
    browser.settle()
    assert [line for line in browser.console if "alert" in line or "Content Security" in line] == []
    assert browser.run(INJECTED) == ["script-src-attr", "script-src-elem", 0]
    assert "<script>" in browser.run("document.querySelector('.readout').innerText + document.title + document.body.innerText")


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
