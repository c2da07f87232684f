"""Answers about charts, several batches, reports and videos are what the commands of the same name make."""

from __future__ import annotations

import hashlib
import json
import os
import random
import re
import shutil
import tomllib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

import sierra
from sierra.deliverables.figures.drawing import Drawing, explorable, explored, rendered
from sierra.deliverables.record import Deliverable, Recorder
from sierra.deliverables.report.make import ReportSource
from sierra.deliverables.report.moving_pictures import TooLarge
from sierra.errors import Damaged, UsageError
from sierra.extensions.explorer import explorer
from sierra.extensions.explorer.answers import Answers
from sierra.extensions.explorer.ranges import BadRange, Range
from sierra.extensions.explorer.server import Server
from sierra.extensions.explorer.tickets import ServedFile, Tickets
from sierra.model import Axis
from sierra.store import derived_tables, read_lock, several_batches
from sierra.store.derived_tables import Limits
from tests import projects, stores
from tests.extensions.explorer.page import Page, served
from tests.support import many_batches
from tests.unit.deliverables.test_figures import NAMES, SIZES, drawing, table
from tests.unit.store.test_verified_files import flip

SWARM = {"table": "swarm", "column": "coverage", "kind": "timeseries"}
SETTINGS = "SELECT current_setting('memory_limit'), current_setting('max_temp_directory_size')"
DATA = re.compile(r"data ([0-9a-f]{64})")
NEGATIVE = {"energy": table(4, 20, **{name: [-1.0] * 80 for name in ("mean", "mean_low", "mean_high")})}


@pytest.fixture(scope="module")
def page(recorded: Path) -> Iterator[Page]:
    with served(explorer(sierra.open(recorded))) as page:
        yield page


@pytest.fixture
def own(recorded: Path, tmp_path: Path) -> Path:
    return stores.copy(recorded, tmp_path / "project")


def ids(root: Path) -> list[str]:
    return [one.batch for one in sierra.open(root).batches]


@pytest.mark.parametrize("shown", [drawing(), drawing("summary", (SIZES, NAMES)), drawing(log_y=True)], ids=str)
def test_a_chart_has_the_numbers_of_the_figure_that_is_printed(shown: Drawing) -> None:
    printed, _ = explorable(shown)
    alone, svg = explored(shown)
    assert (alone.charts, alone.note, alone.data, svg) == (printed.charts, printed.note, printed.data, b"")


@pytest.mark.integration
def test_a_kind_without_charts_is_shown_as_it_is_printed() -> None:
    shown = drawing("stacked")
    assert explored(shown) == explorable(shown)
    assert explored(shown)[1].startswith(b"<?xml")


@pytest.mark.parametrize(
    "shown",
    [
        drawing(tables=NEGATIVE, log_y=True),
        drawing("summary", (Axis("x", (0, 1)),), log_x=True),
        drawing("timeseries", (SIZES, Axis("room", tuple("abcdefghi"))), facet="room"),
        drawing("timeseries", (SIZES, Axis("room", tuple(map(str, range(37)))))),
        drawing("summary", (SIZES, Axis("room", tuple(map(str, range(37))))), facet="room"),
    ],
    ids=["log y", "log x", "columns", "panels", "facets"],
)
def test_a_chart_is_refused_like_the_figure(shown: Drawing) -> None:
    with pytest.raises(UsageError) as printed:
        rendered(replace(shown, formats=("svg",)))
    with pytest.raises(UsageError, match=re.escape(str(printed.value))):
        explored(shown)


@pytest.mark.integration
def test_a_chart_of_a_statement_can_be_drawn_again(page: Page, recorded: Path) -> None:
    keys = {"sql": "SELECT run, tick, avg(coverage) AS mean FROM swarm GROUP BY ALL", "kind": "timeseries", "column": "mean"}
    first, again = (page.ask("chart", batch=ids(recorded)[0], name="drawn", keys=keys) for _ in range(2))
    assert first["section"] == again["section"]


@pytest.mark.nightly
def test_several_batches_are_drawn_together_as_by_the_command(own: Path) -> None:
    first = ids(own)[0]
    second = sierra.open(own).run("population_size=1,2", sets=[("noise", "0.5")], figures=False).batch
    with served(explorer(sierra.open(own), write=True)) as page:
        found = page.ask("chart", batch=first, name="both", keys=SWARM, others=[second])
        assert found["command"] == f"sierra figures {first[:10]} {second[:10]} both"
        page.ask("write", name="both", keys=SWARM, file=found["file"])
    [html], _ = sierra.open(own).deliverables.draw_batches(first, second, name="both", formats=["html"])
    [data] = set(DATA.findall(found["section"]))
    assert data in html.read_text()


@pytest.mark.integration
def test_batches_are_compared_as_by_the_command(own: Path) -> None:
    first, second, _ = ids(own)
    with served(explorer(sierra.open(own), write=True)) as page:
        found = page.ask("compare", batches=[first, second], name="mine", keys={"table": "swarm", "column": "coverage"})
        assert tomllib.loads(found["toml"])["comparisons"]["mine"]["groups"] == [first[:10], second[:10]]
        page.ask("write", **{key: found[key] for key in ("name", "keys", "file", "kind")})
    compared = sierra.open(own).comparisons.declared("mine")
    assert compared.batches == {first[:10]: first, second[:10]: second}
    assert compared.text in found["section"]


@pytest.mark.integration
@pytest.mark.parametrize(
    ("question", "why"),
    [
        ({"keys": SWARM | {"kind": "heatmap"}}, "shows one batch"),
        ({"keys": SWARM | {"facet": "population_size"}}, "series and facet"),
        ({"keys": SWARM, "others": ["FIRST"]}, "each of them once"),
        ({"keys": SWARM, "others": ["0123456789"]}, "0123456789"),
    ],
)
def test_batches_that_do_not_go_together_are_refused(page: Page, recorded: Path, question: Any, why: str) -> None:
    first, second, _ = ids(recorded)
    others = [one.replace("FIRST", first) for one in question.get("others", [second])]
    assert why in page.error("chart", batch=first, name="x", keys=question["keys"], others=others)


@pytest.mark.integration
def test_the_report_is_the_page_that_the_command_writes(page: Page, recorded: Path, tmp_path: Path) -> None:
    batch = ids(recorded)[0]
    address = page.ask("report", batch=batch)["address"]
    status, body, headers = page.send("GET", address, X_Sierra_Token="", Origin="")
    assert status == 200
    assert body == sierra.open(recorded).deliverables.report(batch, to=tmp_path / "report.html").file.read_bytes()
    assert headers["Content-Security-Policy"] == "frame-ancestors 'self'"
    [policy] = re.findall(r'<meta http-equiv="Content-Security-Policy" content="([^"]*)">', body.decode())
    assert re.sub(r"sha256-[\w+/]{43}=", "HASH", policy) == (
        "default-src 'none'; script-src 'HASH'; style-src 'HASH'; img-src data:; base-uri 'none'; form-action 'none'; "
        "media-src data:"
    )
    assert page.send("GET", address, Host="evil.example", X_Sierra_Token="")[0] == 403
    assert page.send("GET", f"{address}x", X_Sierra_Token="")[0] == 404


@pytest.mark.integration
def test_videos_are_played_in_parts_and_only_as_they_were_recorded(own: Path) -> None:
    batch, project = ids(own)[0], sierra.open(own)
    film = own / "films" / "one.webm"
    film.parent.mkdir()
    film.write_bytes(bytes(range(256)) * 4)
    other = film.with_name("two.gif")
    other.write_bytes(b"GIF")
    titles = {"video": {"title": "Both"}, "files": {"one": {"title": "noise = 1"}}}
    recorder = Recorder(project.store, own, batch)
    recorder.add(Deliverable("video", "films", (batch,), titles, "", "0" * 64, ()), (other, film))
    recorder.close()
    with served(explorer(project)) as page:
        video, moving = page.ask("batch", batch=batch)["videos"]
        assert (video["name"], video["file"], video["picture"]) == ("one: Both, noise = 1", "films/one.webm", False)
        assert (moving["name"], moving["picture"]) == ("two: Both", True)
        status, body, headers = page.send("GET", video["address"], X_Sierra_Token="", Range="bytes=254-257")
        assert (status, body, headers["Content-Range"]) == (206, b"\xfe\xff\x00\x01", "bytes 254-257/1024")
        assert headers["Content-Type"] == "video/webm"
        assert page.send("GET", video["address"], Range="bytes=1024-")[0] == 416
        assert b"data:video/webm" in page.send("GET", page.ask("report", batch=batch)["address"])[1]
        film.write_bytes(b"another film")
        assert b"data:video/webm" not in page.send("GET", page.ask("report", batch=batch)["address"])[1]
        assert "not the recorded one" in page.ask("batch", batch=batch)["videos"][0]["problem"]
        film.unlink()
        film.symlink_to("/etc/passwd")
        assert "address" not in page.ask("batch", batch=batch)["videos"][0]
        film.unlink()
        assert page.send("GET", video["address"])[0] == 404


@pytest.mark.parametrize(
    ("header", "start", "stop"),
    [
        (None, 0, 10),
        ("bytes=0-", 0, 10),
        ("bytes=2-4", 2, 5),
        ("bytes=8-99", 8, 10),
        ("bytes=-3", 7, 10),
        ("bytes=1-2,4-5", 0, 10),
    ],
)
def test_ranges(header: str | None, start: int, stop: int) -> None:
    found = Range.of(header, 10)
    assert (found.start, found.stop, sum(found.pieces())) == (start, stop, stop - start)


@pytest.mark.parametrize("header", ["bytes=10-", "bytes=5-4", "bytes=-0"])
def test_a_range_behind_the_end_is_refused(header: str) -> None:
    with pytest.raises(BadRange):
        Range.of(header, 10)


def test_old_addresses_end(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sierra.extensions.explorer.tickets.MOST_BYTES", 10)
    monkeypatch.setattr("sierra.extensions.explorer.tickets.MOST_FILES", 3)
    tickets = Tickets()
    pages = [tickets.issue(ServedFile("text/html", b"1234")) for _ in range(3)]
    films = [tickets.issue(ServedFile("video/mp4", bytes)) for _ in range(4)]
    assert [tickets.find(address) is not None for address in pages] == [False, True, True]
    assert [tickets.find(address) is not None for address in films] == [False, True, True, True]
    large = tickets.issue(ServedFile("text/html", b"1" * 11))
    assert [tickets.find(address) is not None for address in (*pages, large)] == [False, False, False, True]


def replaced_by_a_link(film: Path) -> None:
    film.unlink()
    film.symlink_to("/etc/hostname")


def written_again(film: Path) -> None:
    film.write_bytes(film.read_bytes()[::-1])
    os.utime(film, (1, 1))


def rendered_again(film: Path) -> None:
    before = film.stat()
    film.rename(film.with_suffix(".old"))
    film.write_bytes(bytes(before.st_size))
    os.utime(film, ns=(before.st_atime_ns, before.st_mtime_ns))


@pytest.mark.integration
@pytest.mark.parametrize("change", [replaced_by_a_link, written_again, rendered_again, Path.unlink])
def test_the_address_of_a_video_never_has_another_file(own: Path, change: Callable[[Path], object]) -> None:
    batch = ids(own)[0]
    film = recorded_film(own, batch)
    with served(explorer(sierra.open(own))) as page:
        [video] = page.ask("batch", batch=batch)["videos"]
        assert page.send("GET", video["address"])[:2] == (200, film.read_bytes())
        change(film)
        assert page.send("GET", video["address"])[0] == 404


@pytest.mark.integration
def test_a_video_is_hashed_once(own: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    batch, digest, hashed = ids(own)[0], hashlib.file_digest, []
    film = recorded_film(own, batch)
    monkeypatch.setattr("hashlib.file_digest", lambda *about: hashed.append(about) or digest(*about))
    with served(explorer(sierra.open(own))) as page:
        assert all("address" in page.ask("batch", batch=batch)["videos"][0] for _ in range(3))
        assert len(hashed) == 1
        film.write_bytes(b"another film")
        assert "not the recorded one" in page.ask("batch", batch=batch)["videos"][0]["problem"]


@pytest.mark.integration
def test_a_video_that_is_too_large_to_be_played_is_no_missing_one(own: Path) -> None:
    def read(name: str, most: int) -> bytes | None:
        raise TooLarge(name)

    batch, project = ids(own)[0], sierra.open(own)
    recorded_film(own, batch)
    answers = Answers(lambda: ReportSource(project.loaded, project.store, read=read), project.store)
    with served(Server(answers, "project")) as page:
        assert "too large to be played" in page.ask("batch", batch=batch)["videos"][0]["problem"]
        assert page.ask("report", batch=batch)["address"]


def recorded_film(root: Path, batch: str) -> Path:
    """Write a file that is recorded as a video of a batch."""
    film = root / "films" / "one.webm"
    film.parent.mkdir()
    film.write_bytes(bytes(range(256)) * 4)
    recorder = Recorder(sierra.open(root).store, root, batch)
    recorder.add(Deliverable("video", "films", (batch,), {}, "", "0" * 64, ()), (film,))
    recorder.close()
    return film


def test_an_explorer_hinders_nobody_between_questions(page: Page, recorded: Path) -> None:
    batch = ids(recorded)[0]
    page.ask("query", statement="SELECT avg(coverage) FROM swarm", batch=batch)
    page.ask("chart", batch=batch, name="mine", keys=SWARM)
    with read_lock.alone(sierra.open(recorded).store.paths.reading, patience=5) as alone:
        assert alone


def test_two_explorers_answer_at_once(page: Page, recorded: Path) -> None:
    with served(explorer(sierra.open(recorded))) as other:
        assert page.ask("batches") == other.ask("batches")
        assert other.send("POST", "/ask/state", b"{}", X_Sierra_Token=page.token)[0] == 403


@pytest.mark.integration
def test_a_damaged_store_is_reported_and_answers_again_when_it_is_repaired(own: Path) -> None:
    with served(explorer(sierra.open(own))) as page:
        batch = ids(own)[0]
        assert page.ask("query", statement="SELECT count(*) FROM swarm", batch=batch)["rows"]
        whole = own / ".sierra" / "segments"
        shutil.copytree(whole, own / "kept")
        for file in stores.files(own, "output.swarm"):
            file.write_bytes(file.read_bytes()[:100])
        fresh = "SELECT count(*), sum(coverage) FROM swarm"
        assert "has other bytes than SIERRA wrote" in page.error("query", statement=fresh, batch=batch)
        assert page.error("chart", batch=batch, name="mine", keys=SWARM)
        shutil.rmtree(whole)
        shutil.copytree(own / "kept", whole)
        assert page.ask("query", statement=fresh, batch=batch)["rows"]
        shutil.rmtree(whole)
        assert "segments is missing: run sierra fsck --repair" in page.error("batches")
        assert "removed" in page.error("batch", batch=batch) or page.error("batch", batch=batch)


@pytest.mark.integration
def test_a_store_that_was_moved_away_is_missed_and_not_taken_for_an_empty_one(own: Path) -> None:
    with served(explorer(sierra.open(own))) as page:
        everything = page.ask("query", statement="SELECT count(*) FROM executions")
        store = (own / ".sierra").rename(own / "elsewhere")
        for question in ("state", "batches", "tables"):
            assert page.error(question).startswith(f"no store in {own / '.sierra'}"), question
        assert "no store in" in page.error("query", statement="SELECT count(*) FROM executions")
        store.rename(own / ".sierra")
        assert page.ask("query", statement="SELECT count(*) FROM executions") == everything


HOSTILE = '[sql]\nmemory = "400 GB"\nwall = 1e9\n[tables.few]\nsql = "SELECT run, tick, coverage FROM swarm"\n'
Limited = list[tuple[float, list[tuple[str, str]]]]


@pytest.fixture
def limited(monkeypatch: pytest.MonkeyPatch) -> Limited:
    """Return the time limits and the settings that statements of derived tables have while they are executed."""
    found: Limited = []
    set_up = derived_tables.limited

    @contextmanager
    def recording(connection: Any, limits: Limits, origin: str) -> Iterator[Any]:
        with set_up(connection, limits, origin) as ready:
            found.append((limits.wall, ready.execute(SETTINGS).fetchall()))
            yield ready

    for module in (derived_tables, several_batches):
        monkeypatch.setattr(module, "limited", recording)
    return found


@pytest.mark.nightly
def test_a_project_cannot_raise_the_limits_of_the_explorer(tmp_path: Path, limited: Limited) -> None:
    root = projects.make(tmp_path / "project", f"{projects.CONFIG}\n{HOSTILE}")
    batches = [stores.ask(root, "population_size=1,2", runs=2), stores.ask(root, "population_size=2,3", runs=2)]
    keys = {"table": "few", "column": "coverage"}
    with served(explorer(sierra.open(root))) as page:
        page.ask("query", statement="SELECT count(*) FROM few", batch=batches[0])
        page.ask("chart", batch=batches[0], name="mine", keys={"sql": "SELECT run, tick FROM few", "column": "tick"})
        page.ask("chart", batch=batches[0], name="mine", keys=keys)
        page.ask("compare", batches=batches, name="mine", keys=keys)
    assert len(limited) >= 4
    assert {settings for _, [settings] in limited} == {("1.8 GiB", "0 bytes")}


@pytest.mark.integration
def test_a_package_cannot_raise_the_limits_of_statements(tmp_path: Path, limited: Limited) -> None:
    claim = '[claims.few]\nsays = "x"\npaper = "1"\nquery = "population_size=1,2"\nsql = "SELECT count(*) > 0 AS x FROM few"\n'
    figure = '[figures.few]\ntable = "few"\ncolumn = "coverage"\n[package]\ntitle = "T"\nlicense = "MIT"\n'
    root = projects.make(tmp_path / "project", f"{projects.CONFIG}\n{HOSTILE}{figure}authors = [{{ name = 'J' }}]\n{claim}")
    package = str(tmp_path / "one.zip")
    sierra.open(root).packages.pack(stores.ask(root, "population_size=1,2", runs=2), report=False, path=package)
    limited.clear()
    for words in (["report", package], ["open", package, "sql", "SELECT * FROM few"], ["open", package, "claims"]):
        assert projects.quick(tmp_path, *words).returncode == 0
        assert {wall for wall, _ in limited} == {300.0}
        assert {settings for _, [settings] in limited} == {("3.7 GiB", "14.9 GiB")}
        limited.clear()


@pytest.mark.integration
@pytest.mark.parametrize(("name", "written"), [("größe.t", "gr_e_t"), ("1st", "st"), ("mine\n", "mine"), ("é", "my_name")])
def test_the_lines_of_a_chart_have_a_name_that_sierra_toml_takes(recorded: Path, name: str, written: str) -> None:
    with served(explorer(sierra.open(recorded))) as page:
        found = page.ask("chart", batch=ids(recorded)[0], name=name, keys=SWARM)
    assert (found["name"], list(tomllib.loads(found["toml"])["figures"])) == (written, [written])


@pytest.mark.nightly
def test_a_condition_of_a_package_that_never_ends_is_ended(tmp_path: Path) -> None:
    endless = "(SELECT count(*) FROM range(1000000000000000) a, range(1000000000000) b) > tick"
    figure = f'[figures.few]\ntable = "swarm"\ncolumn = "coverage"\nwhere = "{endless}"\n[sql]\nwall = 0.2\n'
    about = "[package]\ntitle = 'T'\nlicense = 'MIT'\nauthors = [{ name = 'J' }]\n"
    root = projects.make(tmp_path / "project", f"{projects.CONFIG}\n{figure}{about}")
    package = str(tmp_path / "one.zip")
    sierra.open(root).packages.pack(stores.ask(root, "population_size=1", runs=1), report=False, path=package)
    assert projects.quick(tmp_path, "report", package).returncode == 0
    assert "the statement did not end within 0.2 s" in (tmp_path / "one-report.html").read_text()


@pytest.mark.integration
def test_no_statement_fills_the_memory_or_the_disk(tmp_path: Path) -> None:
    root = projects.make(tmp_path / "project", projects.CONFIG + '\n[tables.few]\nsql = "SELECT run, tick FROM swarm"\n')
    batch = stores.ask(root, "population_size=1", runs=1)
    with served(explorer(sierra.open(root))) as page:
        before = page.ask("query", statement=SETTINGS, batch=batch)["rows"]
        page.ask("query", statement="SELECT count(*) FROM few", batch=batch)
        assert page.ask("query", statement=SETTINGS, batch=batch)["rows"] == before == [["1.8 GiB", "0 bytes"]]


@pytest.mark.integration
@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"sha256s": []}, "the record of 'films' has 1 files, but 0 hashes of files"),
        ({"sha256s": [None]}, "a record has no 'sha256s'"),
    ],
)
def test_a_hostile_record_of_a_video_is_one_line(own: Path, change: dict[str, Any], said: str) -> None:
    batch, project = ids(own)[0], sierra.open(own)
    recorder = Recorder(project.store, own, batch)
    row = recorder._row(Deliverable("video", "films", (batch,), {}, "", "0" * 64, ()), ["one.mp4"], ["0" * 64])
    recorder._new.append(row._replace(**change))
    recorder.close()
    with served(explorer(project)) as page:
        assert said in page.error("batch", batch=batch)
        assert said in page.error("report", batch=batch)


def test_batches_of_several_segments_are_listed_in_parts(tmp_path: Path) -> None:
    root = projects.make(tmp_path / "project")
    many_batches.make(root, 3000)
    with served(explorer(sierra.open(root))) as page:
        found = page.ask("batches")
        assert (found["all"], found["found"], len(found["batches"])) == (3000, 3000, 100)
        assert [one["query"] for one in page.ask("batches", first=2999)["batches"]] == ["population_size=0"]
        assert page.ask("batches", words="size=77 missing")["found"] == 11
        assert len(json.dumps(found)) < 50_000


def test_kept_snapshots_notice_damage(own: Path) -> None:
    project = sierra.open(own)
    answers = Answers(lambda: ReportSource(project.loaded, project.store), project.store)
    assert answers.query("FROM swarm")["rows"]
    flip(stores.files(own, "output.swarm")[0], random.Random(7))
    with pytest.raises(Damaged):
        answers.query("FROM swarm")
