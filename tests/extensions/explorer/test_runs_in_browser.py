"""The table of runs in a real browser: scrolled, sorted, filtered, compared and opened, by keys and by links."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests import projects, stores, waiting
from tests.browser import INJECTED, Browser
from tests.extensions.explorer.test_explorer import TEXT, explored, until
from tests.extensions.explorer.test_run_table import SLOW
from tests.support.photographs import flaws, unfold, unnamed
from tests.support.reported import ATTACK

pytestmark = [pytest.mark.real, pytest.mark.integration]
ROWS = "[...document.querySelectorAll('#runs-rows tr:not([hidden])')].map(row => row.querySelector('th').innerText)"
SHOWN = f"document.getElementById('stop').disabled && {ROWS}.length && !{ROWS}.includes('…')"
ACTIVE = "document.activeElement"


@pytest.fixture
def browser(require: Callable[..., str], tmp_path: Path) -> Iterator[Browser]:
    with Browser(require("chromium"), tmp_path / "profile") as browser:
        yield browser


def tick(browser: Browser, *places: int) -> None:
    for place in places:
        browser.run(f"document.querySelectorAll('#runs-rows input')[{place}].click()")


def open_run(browser: Browser, place: int) -> None:
    browser.run(f"document.querySelectorAll('#runs-rows th button')[{place}].click()")
    until(browser, "document.querySelectorAll('#run-files button').length > 0")


@pytest.mark.parametrize(("width", "dark"), [(1280, False), (390, True)])
def test_runs_are_the_first_view_and_are_compared_and_opened(
    browser: Browser, recorded: Path, tmp_path: Path, width: int, dark: bool
) -> None:
    with explored(recorded) as url:
        browser.open(url, width=width, dark=dark)
        until(browser, SHOWN)
        assert browser.run("document.getElementById('batches-view').hidden")
        assert "ok" in browser.run(TEXT.format("runs-count"))
        tick(browser, 0, 4)
        browser.run("document.getElementById('compare').click()")
        until(
            browser, "document.querySelector('#curves canvas') !== null && document.querySelector('#differences pre') !== null"
        )
        open_run(browser, 2)
        browser.run("document.querySelector('#run-files button').click()")
        until(browser, "document.querySelector('#run-file pre')?.innerText.includes('<arena')")
        browser.run("document.getElementById('ask-why').click()")
        until(browser, "document.getElementById('why').innerText.includes('effective executions')")
        unfold(browser)
        assert browser.run("document.documentElement.scrollWidth") == width
        assert flaws(browser, tmp_path / "runs.png", dark=dark) == []
        assert unnamed(browser) == []
        assert browser.console == []
        assert all(request.startswith(url.partition("#")[0]) for request in browser.requests)


def test_a_link_shows_the_same_again(browser: Browser, recorded: Path) -> None:
    with explored(recorded) as url:
        browser.open(url)
        until(browser, SHOWN)
        browser.run("document.querySelector('#runs-head [data-key=wall_s] button').click()")
        browser.run("document.querySelector('#runs-head [data-key=wall_s] button').click()")
        browser.run("document.querySelector('#choice input').value = \"number < 2 AND status = 'ok'\"")
        browser.run("document.querySelector('#choice button').click()")
        browser.run("document.querySelectorAll('#columns-choice input')[1].click()")
        until(browser, f"{SHOWN} && location.hash.includes('where')")
        tick(browser, 0, 3)
        open_run(browser, 1)
        picture = f"[{ROWS}, document.getElementById('runs').innerText, document.getElementById('run-title').innerText, " \
            "[...document.querySelectorAll('#runs-rows input')].map(one => one.checked)]"  # fmt: skip
        before, link = browser.run(picture), browser.run("location.href")
        browser.open("about:blank")
        browser.open(link)
        until(browser, f"{SHOWN} && document.querySelectorAll('#run-files button').length > 0")
        assert browser.run(picture) == before
        assert browser.run("document.querySelector('[data-key=wall_s]').getAttribute('aria-sort')") == "descending"
        until(browser, "document.querySelector('#curves canvas') !== null")
        browser.run("document.querySelector('#runs-rows td .link').click()")
        until(browser, "!document.getElementById('batches-view').hidden && document.querySelector('#drawn canvas') !== null")
        assert "view=batches" in browser.run("location.hash")


def test_an_error_is_beside_the_field_and_the_rows_stay(browser: Browser, recorded: Path) -> None:
    with explored(recorded) as url:
        browser.open(url)
        until(browser, SHOWN)
        rows = browser.run(ROWS)
        browser.run("document.querySelector('#choice input').value = 'nothing ='")
        browser.run("document.querySelector('#choice button').click()")
        until(browser, TEXT.format("runs-error"))
        assert "\n" not in browser.run(TEXT.format("runs-error"))
        assert browser.run(ROWS) == rows


def test_the_table_is_used_with_keys_and_keeps_its_place(browser: Browser, tmp_path: Path) -> None:
    root = projects.make(tmp_path / "project")
    stores.ask(root, "population_size=1", runs=120)
    with explored(root) as url:
        browser.open(url, height=500)
        until(browser, SHOWN)
        first = browser.run(ROWS)
        assert len(first) < 30
        browser.run("document.querySelector('#runs-rows input').focus()")
        browser.press("ArrowDown")
        assert browser.run(f"{ACTIVE}.getAttribute('aria-label')") == f"Tick run {first[1]}, row 2"
        browser.press("End")
        until(browser, f"{ACTIVE}.getAttribute('aria-label').endsWith('row {120 - len(first) + 2}')")
        until(browser, SHOWN)
        browser.press(" ")
        until(browser, "document.getElementById('ticked').innerText === '1 run ticked'")
        browser.press("Home")
        until(browser, f"{SHOWN} && {ROWS}[0] === '{first[0]}'")
        assert browser.run(ROWS) == first


def test_new_runs_appear_while_a_batch_executes_elsewhere(browser: Browser, tmp_path: Path) -> None:
    go, simulator = tmp_path / "go", SLOW.replace("GO", str(tmp_path / "go"))
    root = projects.make(tmp_path / "project", simulator=simulator)
    running = projects.start(root, "run", "population_size=1,2", "--runs", "4", "--no-figures", "-j2", stdout=None, stderr=None)
    try:
        waiting.until(lambda: any((root / ".sierra" / "segments").iterdir()), "the batch is recorded")
        with explored(root) as url:
            browser.open(url)
            until(browser, f"{SHOWN} && {TEXT.format('runs-count')}.includes('being executed now')")
            browser.run("document.querySelectorAll('#runs-rows input')[3].focus()")
            focused = browser.run(f"{ACTIVE}.getAttribute('aria-label')")
            go.touch()
            assert running.wait(waiting.PATIENCE_S) == 0
            until(browser, f"{TEXT.format('runs-count')} === '8 rows: 8 ok'")
            assert browser.run(f"{ACTIVE}.getAttribute('aria-label')") == focused
    finally:
        go.touch()
        running.wait(waiting.PATIENCE_S)


def test_hostile_texts_are_never_executed(browser: Browser, tmp_path: Path) -> None:
    simulator = projects.SIMULATOR + f"import sys\nprint({ATTACK!r}, file=sys.stderr)\nsys.exit(3)\n"
    root = projects.make(tmp_path / "project", simulator=simulator)
    stores.ask(root, "population_size=1", runs=2)
    browser.call("Page.addScriptToEvaluateOnNewDocument", source="window.alert = () => console.error('alert')")
    with explored(root) as url:
        hostile = f'&columns=["reason","{"<img src=x onerror=alert(1)>"}"]&where=status <> \'<script>alert(1)</script>\''
        browser.open(url + hostile + "&run=<script>alert(1)</script>")
        until(browser, SHOWN)
        open_run(browser, 0)
        assert "evil" in browser.run(TEXT.format("run-record"))
        names = "[...document.querySelectorAll('#run-files button')]"
        browser.run(f"{names}.find(one => one.innerText === 'stderr').click()")
        until(browser, "document.getElementById('run-file').innerText.includes('evil')")
        assert browser.run("document.querySelector('#runs-view :is(img, script)')") is None
        assert not re.search("[\u202a-\u202e\u2066-\u2069]", browser.run("document.body.innerText"))
        assert [line for line in browser.console if "400" not in line] == []
        assert browser.run(INJECTED) == ["script-src-attr", "script-src-elem", 0]
