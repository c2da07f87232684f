"""The explorer in a real browser: batches, charts and SQL, on wide and narrow screens, without any foreign request."""

from __future__ import annotations

import json
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

import sierra
from sierra.util.text import visible
from tests import projects, stores
from tests.browser import INJECTED, Browser
from tests.support import many_batches
from tests.support.characters import MIXED, SHOWN
from tests.support.photographs import flaws, unfold, unnamed
from tests.support.reported import ATTACK, ATTACK_IN_TOML
from tests.tiers import needs_extension
from tests.waiting import PATIENCE_S

pytestmark = [pytest.mark.real, pytest.mark.integration]
FILM = "heat-population_size=1: <script>alert(1)</script>, population size = 1, run 0"
DRAWN = "document.querySelector('#drawn canvas') !== null || document.getElementById('chart-error').textContent"
READY = "document.getElementById('stop').disabled && document.querySelectorAll('#figures button').length > 0"
TEXT = "document.getElementById({!r}).innerText"


@pytest.fixture
def browser(require: Callable[..., str], tmp_path: Path) -> Iterator[Browser]:
    with Browser(require("chromium"), tmp_path / "profile") as browser:
        yield browser


HOLD = "((place, keys) => keys.forEach(key => place.dispatchEvent(new KeyboardEvent('keydown', {key, cancelable: true}))))"
"""A function that presses keys before anything else happens in the page."""
REVERSES = r"/[\u202a-\u202e\u2066-\u2069]/.test"
ESCAPED = "[...Array(0x110000).keys()].filter(code => (one => sierra.visible(one) !== one)(String.fromCodePoint(code)))"
HELD = """((ask, told) => { window.fetch = (...about) => {
    if (about[0] === "/ask/progress") return Promise.resolve(new Response(JSON.stringify(told)));
    return about[0] === "/ask/report" ? new Promise(done => { window.go = () => done(ask(...about)) }) : ask(...about);
} })(window.fetch, TOLD)""".replace("TOLD", json.dumps(f"figure 2 of 7: {MIXED}"))
"""Tells of a part, and makes no report before `window.go()`."""
ALL_TEXTS = "document.body.textContent + [...document.querySelectorAll('input, textarea')].map(one => one.value).join()"
TYPE = """((area, text) => { area.focus(); area.value = text; area.selectionStart = area.selectionEnd = text.length;
  area.dispatchEvent(new Event('input')); return [...document.querySelectorAll('#words li')].map(one => one.innerText);
})(document.getElementById('statement'), %r)"""
STATEMENT = "document.getElementById('statement').value"
SIMULATOR = (
    projects.SIMULATOR
    + f"""
with open("sizes.csv", "w", encoding="utf-8") as file:
    print('tick,Robot name,größe,"a,b","{ATTACK.replace(chr(34), chr(34) * 2).replace(chr(39), "")}"', file=file)
    for tick in range(3):
        print(tick, count, 1.5, tick, tick, sep=",", file=file)
"""
)
CONFIG = f"""{projects.CONFIG}
[outputs.sizes]
file = "sizes.csv"
time = "tick"

[figures.first]
column = "coverage"
title = "{ATTACK_IN_TOML}"

[figures.second]
sql = "SELECT run, tick, größe AS size FROM sizes -- {ATTACK_IN_TOML}"
column = "size"

[figures.impossible]
column = "{ATTACK_IN_TOML}"
"""


@contextmanager
def explored(root: Path, *options: str, package: str = "") -> Iterator[str]:
    """Run `sierra explore`; yield the address that it prints, and end it as a user does."""
    within = ["open", package] if package else []
    argv = [str(projects.SIERRA), *within, "explore", "--no-browser", *options]
    with subprocess.Popen(argv, cwd=root, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout
        try:
            yield process.stdout.readline().strip()
        finally:
            process.send_signal(signal.SIGINT)
        assert process.wait(PATIENCE_S) == 0


def until(browser: Browser, code: str) -> object:
    """Wait until an expression is true; return its value."""
    give_up = time.monotonic() + PATIENCE_S
    while not (found := browser.run(code)):
        assert time.monotonic() < give_up, (code, browser.console, browser.run(TEXT.format("chart-error")))
        time.sleep(0.05)
    return found


def answered(browser: Browser, statement: str) -> str:
    """Type a statement and ask it; return the answer's text."""
    browser.run("document.getElementById('result').replaceChildren()")
    browser.run(f"document.getElementById('statement').value = {statement!r}")
    browser.run("document.querySelector('#sql button').click()")
    until(browser, "document.querySelector('#result td') !== null || document.getElementById('sql-error').textContent")
    text: str = browser.run(TEXT.format("result")) or browser.run(TEXT.format("sql-error"))
    return text


@pytest.mark.parametrize(("width", "dark"), [(1280, False), (390, True), (1280, True), (390, False)])
def test_a_batch_is_drawn_and_answers_sql(browser: Browser, recorded: Path, tmp_path: Path, width: int, dark: bool) -> None:
    with explored(recorded) as url:
        browser.open(f"{url}&view=batches", width=width, dark=dark)
        until(browser, DRAWN)
        assert browser.run("document.querySelectorAll('#batches [role=option]').length") == 3
        assert "noise=0.5" in browser.run(TEXT.format("batch-title"))
        assert browser.run("document.documentElement.scrollWidth") == width
        assert "4" in answered(browser, "SELECT 2 + 2 AS four")
        assert "no statement" not in answered(browser, "SELECT '<img src=x onerror=alert(1)>' AS harmless")
        assert browser.run("document.querySelector('#result img')") is None
        assert "DROP" in answered(browser, "DROP TABLE runs")
        answered(browser, "SELECT range AS n, repeat('long ', 9) AS text, * FROM range(5000)")
        assert browser.run("document.querySelectorAll('#result tbody tr').length") == 1000
        assert browser.run("document.querySelector('#result .scroll').clientHeight") < 500
        assert browser.run("document.documentElement.scrollWidth") == width
        browser.run("document.getElementById('add').click()")
        assert flaws(browser, tmp_path / "page.png", dark=dark) == []
        unfold(browser)
        assert browser.run("document.querySelectorAll('summary :is(a, button, input)').length") == 0
        assert unnamed(browser) == []
        assert browser.console == [] or all("400" in line for line in browser.console)
        assert all(request.startswith(url.partition("#")[0]) for request in browser.requests)


@needs_extension("videos")
@pytest.mark.nightly
@pytest.mark.parametrize(("width", "dark"), [(1280, False), (390, True), (1280, True), (390, False)])
def test_everything_that_can_be_opened_is_readable(browser: Browser, tmp_path: Path, width: int, dark: bool) -> None:
    from tests.extensions.videos import filmed

    root, _ = filmed.make(tmp_path / "project")
    (root / "sierra.toml").write_text(filmed.CONFIG.replace('"gif", "mp4"', '"gif"').replace("=1", "=2"))
    stores.ask(root, "population_size=1,2", runs=4)
    assert projects.quick(root, "video", "heat").returncode == 0
    inner = "document.getElementById('frame').contentDocument"
    with explored(root, "--write") as url:
        browser.open(f"{url}&view=batches", width=width, dark=dark)
        for place in (1, 0):
            until(browser, f"document.querySelectorAll('#batches [role=option]').length > 1 && {READY}")
            browser.run(f"document.querySelectorAll('#batches [role=option]')[{place}].click()")
            until(browser, f"{READY} && document.querySelector('#drawn .series') !== null")
            browser.run("document.getElementById('add').click()")
        answered(browser, "SELECT * FROM floor LIMIT 20")
        browser.run("document.getElementById('test').click()")
        until(browser, "document.querySelector('#drawn .comparison') !== null")
        unfold(browser)
        assert flaws(browser, tmp_path / "compared.png", dark=dark) == []
        browser.run("document.getElementById('report').click()")
        until(browser, f"{inner}?.getElementById('reproduce') && document.getElementById('frame').height > 1000")
        until(browser, "document.querySelector('#videos img')?.naturalWidth")
        assert flaws(browser, tmp_path / "told.png", dark=dark) == []
        assert unnamed(browser) == []
        assert unnamed(browser, "frame") == []


@pytest.mark.nightly
def test_another_batch_is_chosen_by_keys_and_drawn_with_the_form(browser: Browser, recorded: Path) -> None:
    with explored(recorded) as url:
        browser.open(f"{url}&view=batches")
        until(browser, DRAWN)
        browser.run(f"{HOLD}(document.getElementById('batches'), ['ArrowDown', 'ArrowDown', 'ArrowUp'])")
        until(browser, "document.getElementById('batch-title').textContent == 'population_size=2,3'")
        until(browser, "document.querySelectorAll('#figures button').length > 0")
        until(browser, "document.querySelector('#drawn .series') !== null && document.getElementById('stop').disabled")
        assert [request.rpartition("/")[2] for request in browser.requests].count("batch") == 2, "not one for each key"
        browser.run("document.querySelector('#chart [name=kind]').value = 'box'")
        browser.run("document.querySelector('#chart [name=column]').value = 'coverage'")
        browser.run("document.querySelector('#chart button').click()")
        until(browser, "document.querySelector('#drawn img') !== null")
        assert 'kind = "box"' in browser.run("document.getElementById('toml').textContent")
        assert "This chart shows batch" in browser.run(TEXT.format("chart-of"))


def test_a_late_answer_about_another_batch_is_not_shown(browser: Browser, recorded: Path) -> None:
    late = """(ask => { window.fetch = (...about) => {
        if (!about[0].endsWith('chart')) return ask(...about);
        window.fetch = ask;
        return new Promise(done => { window.go = () => ask(...about).then(done) });
    } })(window.fetch)"""
    shown = TEXT.format("chart-of")
    with explored(recorded) as url:
        browser.open(f"{url}&view=batches")
        until(browser, DRAWN)
        first = browser.run(shown)
        browser.run(late)
        browser.run("document.querySelectorAll('#batches [role=option]')[1].click()")
        until(browser, "window.go !== undefined")
        assert browser.run("document.getElementById('drawn').childElementCount") == 0
        browser.run("document.querySelectorAll('#batches [role=option]')[2].click()")
        until(browser, f"{shown} && {shown} != {first!r}")
        second, drawn = browser.run(shown), browser.run("document.getElementById('drawn').innerHTML")
        browser.run("window.go()")
        until(browser, "document.getElementById('stop').disabled")
        assert (browser.run(shown), browser.run("document.getElementById('drawn').innerHTML")) == (second, drawn)


def test_hostile_names_are_shown_completed_and_drawn(browser: Browser, tmp_path: Path) -> None:
    root = projects.make(tmp_path / "project", CONFIG, simulator=SIMULATOR)
    stores.ask(root, "population_size=1", runs=2)
    browser.call("Page.addScriptToEvaluateOnNewDocument", source="window.alert = () => console.error('alert')")
    with explored(root) as url:
        browser.open(f"{url}&view=batches")
        until(browser, DRAWN)
        assert "evil" in browser.run(TEXT.format("drawn"))
        answered(browser, f"SELECT *, '{ATTACK.replace(chr(39), '')}' AS text FROM sizes")
        assert "evil" in browser.run(TEXT.format("result"))
        browser.run("document.querySelectorAll('#figures button')[1].click()")
        until(browser, "document.getElementById('toml').textContent.includes('figures.second')")
        assert "Its statement has characters that control" in browser.run(TEXT.format("chart-of"))
        assert "\\U0000202e" in browser.run("document.getElementById('toml').textContent")
        assert browser.run(f"{REVERSES}({ALL_TEXTS})") is False
        assert browser.run(ESCAPED) == [place for place in range(0x110000) if visible(chr(place)) != chr(place)]
        assert browser.run(f"sierra.visible({json.dumps(MIXED)})") == SHOWN
        assert browser.run(TYPE % "SELECT max(grö")[0].startswith('"größe"')
        browser.press("Tab")
        assert browser.run(STATEMENT) == 'SELECT max("größe"'
        assert browser.run(TYPE % "SELECT Rob")[0].startswith('"Robot name"')
        browser.run(TYPE % 'SELECT \'a\' AS "b", "Rob')
        browser.press("Tab")
        assert browser.run(STATEMENT) == 'SELECT \'a\' AS "b", "Robot name"'
        browser.run("document.querySelector('#chart [name=table]').value = 'sizes'")
        browser.run("document.querySelector('#chart [name=column]').value = 'a,b'")
        browser.run("document.querySelector('#chart button').click()")
        until(browser, "document.getElementById('toml').textContent.includes('column = \"a,b\"')")
        assert browser.console == []
        assert browser.run(INJECTED) == ["script-src-attr", "script-src-elem", 0]


@pytest.mark.nightly
def test_names_are_completed_with_keys(browser: Browser, recorded: Path) -> None:
    with explored(recorded) as url:
        browser.open(f"{url}&view=batches")
        until(browser, DRAWN)
        browser.run("(area => { area.focus(); area.value = 'SELECT max('; area.selectionStart = area.value.length })"
                    "(document.getElementById('statement'))")  # fmt: skip
        for letter in "cov":
            browser.call("Input.dispatchKeyEvent", type="char", text=letter)
        until(browser, "!document.getElementById('words').hidden")
        browser.press("Tab")
        assert browser.run("document.getElementById('statement').value") == "SELECT max(coverage"
        assert browser.run("document.getElementById('words').hidden")


@pytest.mark.nightly
def test_a_chart_is_written_and_new_batches_are_announced(browser: Browser, tmp_path: Path) -> None:
    figure = '\n[figures.declared]\ncolumn = "coverage"\ncenter = "median"\ntitle = "Its own title"\n'
    root = projects.make(tmp_path / "project", projects.CONFIG + figure)
    stores.ask(root, "population_size=1,2", runs=2)
    with explored(root, "--write") as url:
        browser.open(f"{url}&view=batches")
        until(browser, DRAWN)
        assert browser.run(TEXT.format("left-out")) == "1 batch, the newest first"
        assert "The form does not show its keys title." in browser.run(TEXT.format("chart-of"))
        browser.run("document.querySelector('#chart [name=name]').value = 'another'")
        browser.run("document.querySelector('#chart [name=log_y]').checked = true")
        browser.run("document.querySelector('#chart button').click()")
        until(browser, "document.getElementById('toml').textContent.includes('log_y')")
        browser.run("document.getElementById('declaration').open = true")
        browser.run("document.getElementById('write').click()")
        until(browser, "document.getElementById('written').textContent.startsWith('Written.')")
        first, second = sierra.open(root).config.figures.values()
        assert (second.title, second.center, second.log_y, second.table) == (first.title, "median", True, "")
        sierra.open(root).run("population_size=3", runs=1, figures=False)
        until(browser, "document.querySelectorAll('#batches [role=option]').length == 2")
        until(browser, "document.getElementById('status').textContent.includes('new records')")


def test_a_page_without_the_token_shows_nothing_of_the_store(browser: Browser, recorded: Path) -> None:
    with explored(recorded) as url:
        browser.open(url.partition("#")[0])
        until(browser, "document.getElementById('runs-error').textContent")
        assert "the address that sierra explore has printed" in browser.run(TEXT.format("runs-error"))
        assert "population_size" not in browser.run("document.body.innerText")


@needs_extension("videos")
def test_a_package_is_explored_and_not_changed(browser: Browser, tmp_path: Path) -> None:
    from tests.extensions.videos import filmed

    root, batch = filmed.make(tmp_path / "project")
    sierra.open(root).packages.pack(batch, report=False, path=tmp_path / "one.zip")
    before = (tmp_path / "one.zip").read_bytes()
    refused = projects.quick(tmp_path, "open", "one.zip", "explore", "--write")
    assert (refused.returncode, refused.stderr) == (2, "sierra: a package is never changed; leave out --write\n")
    with explored(tmp_path, package="one.zip") as url:
        browser.open(f"{url}&view=batches")
        until(browser, DRAWN)
        assert browser.run("document.querySelector('h1').textContent") == "one.zip"
        assert "population_size=1,2" in browser.run(TEXT.format("batch-title"))
        assert "6" in answered(browser, "SELECT count(*) FROM runs")
        video = "document.querySelector('#videos video')"
        until(browser, f"{video} !== null")
        browser.run(f"{video}.muted = true; {video}.play().then(() => new Promise(done => {{ {video}.ontimeupdate = done }}))")
        assert browser.run(f"[{video}.videoWidth, {video}.error, {video}.ariaLabel]") == [200, None, f"Video {FILM}"]
        assert browser.console == []
    assert (tmp_path / "one.zip").read_bytes() == before


@pytest.mark.nightly
def test_batches_are_drawn_together_and_reported(browser: Browser, recorded: Path) -> None:
    with explored(recorded) as url:
        browser.open(f"{url}&view=batches")
        until(browser, DRAWN)
        for place in (1, 2):
            browser.run(f"document.querySelectorAll('#batches [role=option]')[{place}].click()")
            until(browser, READY)
            until(browser, "document.querySelector('#drawn .series') !== null && document.getElementById('stop').disabled")
            browser.run("document.getElementById('add').click()")
        browser.run("document.getElementById('draw-together').click()")
        until(browser, TEXT.format("together-error"))
        assert "different values" in browser.run(TEXT.format("together-error"))
        browser.run("document.getElementById('test').click()")
        until(browser, "document.querySelector('#drawn .comparison') !== null")
        assert "[comparisons." in browser.run("document.getElementById('toml').textContent")
        assert "were compared" in browser.run(TEXT.format("drawn")) or "was compared" in browser.run(TEXT.format("drawn"))
        browser.run(HELD)
        browser.run("document.getElementById('report').click()")
        until(browser, f"{TEXT.format('status')} === {json.dumps(f'Making the report: figure 2 of 7: {SHOWN} …')}")
        browser.run("window.go()")
        inner = "document.getElementById('frame').contentDocument"
        until(browser, f"{inner}?.getElementById('reproduce') && document.getElementById('frame').height > 1000")
        assert browser.run(f"{inner}.body.innerText.includes('sierra replay')")
        browser.run("document.getElementById('close-report').click()")
        assert browser.run("document.activeElement.id") == "report"
        assert [line for line in browser.console if "400" not in line] == []


@pytest.mark.nightly
def test_ten_thousand_batches_are_turned_and_filtered(browser: Browser, tmp_path: Path) -> None:
    root = projects.make(tmp_path / "project")
    many_batches.make(root, 10_000)
    listed = "document.getElementById('left-out').textContent"
    with explored(root) as url:
        browser.open(f"{url}&view=batches")
        until(browser, f"{listed}.startsWith('1 to 100 of 10,000')")
        until(browser, "document.getElementById('stop').disabled")
        browser.run(
            "document.querySelectorAll('#batches [role=option]')[99].click(); document.getElementById('batches').focus()"
        )
        browser.press("ArrowDown")
        until(browser, "document.getElementById('batch-title').textContent == 'population_size=9899'")
        assert browser.run(listed).startswith("101 to 200 of 10,000")
        assert browser.run("document.querySelectorAll('#batches [role=option]').length") == 100
        browser.run("(field => { field.value = 'size=77'; field.dispatchEvent(new Event('input')) })"
                    "(document.getElementById('filter'))")  # fmt: skip
        until(browser, f"{listed}.startsWith('1 to 100 of 111 batches of 10,000 in all')")
