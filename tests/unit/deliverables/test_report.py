"""Reports of batches: what they say, what they do not let in, and where they are written."""

from __future__ import annotations

import base64
import json
import re
import shutil
import signal
import subprocess
import sys
from datetime import UTC, datetime
from html.parser import HTMLParser
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

import sierra
from sierra.deliverables.report import files, make
from sierra.execution import list_batches
from tests import projects, stores
from tests.support import many_batches, reported
from tests.waiting import until

WAITING = """
import time
from pathlib import Path
if count == 2:
    Path("{folder}/waits").touch()
    while not Path("{folder}/go").exists():
        time.sleep(0.02)
"""
KILLED = """
import os, signal, sys
from pathlib import Path
from sierra.deliverables.report import files

def half(path, data):
    with path.open("wb") as file:
        file.write(data[:50])
    os.kill(os.getpid(), signal.SIGKILL)

Path.write_bytes = half
files.write(Path(sys.argv[1]), b"new" * 100)
"""
NOW = datetime(2026, 1, 1, tzinfo=UTC)
VOID = {"meta", "img", "br"}


class Page(HTMLParser):
    """A page: its elements with attributes and texts. It fails for elements that are not closed in order."""

    def __init__(self, data: bytes) -> None:
        super().__init__()
        self.open: list[str] = []
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.texts: list[str] = []
        self.feed(data.decode())
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] not in ("script", "style"):
            self.texts.append(data)

    @property
    def text(self) -> str:
        return " ".join("".join(self.texts).split())

    def all(self, tag: str) -> list[dict[str, str | None]]:
        return [attributes for name, attributes in self.elements if name == tag]

    def ids(self) -> list[str]:
        return [attributes["id"] for _, attributes in self.elements if attributes.get("id")]  # type: ignore[misc]


def reported_by(root: Path, *words: str, to: Path) -> tuple[Page, str]:
    """Return the report that the command writes, and the notes on standard error."""
    done = projects.quick(root, "report", *words, "--to", str(to))
    assert done.returncode == 0, done.stderr
    return Page(to.read_bytes()), done.stderr


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """A project with one batch, and the batch's id."""
    root = reported.make(tmp_path_factory.mktemp("report") / "project")
    return root, stores.ask(root, "sizes")


@pytest.fixture(scope="module")
def page(project: tuple[Path, str], tmp_path_factory: pytest.TempPathFactory) -> tuple[Page, str, bytes]:
    """The report of the batch, the notes, and its bytes."""
    file = tmp_path_factory.mktemp("page") / "report.html"
    found, notes = reported_by(project[0], to=file)
    return found, notes, file.read_bytes()


@pytest.mark.integration
def test_a_report_tells_the_whole_story_of_a_batch(project: tuple[Path, str], page: tuple[Page, str, bytes]) -> None:
    root, batch = project
    found, notes, _ = page
    for said in (
        "Complete, with failures. 13 of 18 runs succeeded, 5 did not.",
        "How do results depend on population size (1, 2, 4 robots)? 3 experiments with 6 runs each",
        "tick [s], coverage [m²]",
        "Run i has the same seed in every experiment",
        "mean, 95 % CI (Student's t), n = 1–6",
        "figure impossible could not be drawn: no output has 'no_such_column'",
        "population_size=2 is greater than population_size=1",
        "does not hold One robot covers ten square metres.",
        "rest on other batches, or on none that is recorded: later.",
        "5 runs: exit status 3",
        "the wheels came off",
        "dirty differed from the commit",
        f"SIERRA batch {batch}",
        f"sierra replay {batch[:10]}",
        "Jane Doe (2026). Coverage of swarms",
    ):
        assert said in found.text, said
    assert "note: figure impossible could not be drawn" in notes
    sections = [name for name in found.ids() if f"{name}-title" in found.ids()]
    order = ["question", "design", "figures", "tables", "comparisons", "claims", "failures", "environment", "reproduce"]
    assert sections == order
    assert [link["href"] for link in found.all("a")][1:] == [f"#{name}" for name in order]
    drawn = {
        path.stem: path.read_bytes()
        for path in sierra.open(root).deliverables.figures(batch, formats=["svg"])
        if path.suffix == ".svg"
    }
    shown = [base64.b64decode(str(one["src"]).partition(",")[2]) for one in found.all("img")]
    assert shown[:3] == [drawn["over_time"], drawn["at_the_end"], drawn["spread"]]
    assert "Coverage at the end. final coverage [m²] over population size [robots]." in str(found.all("img")[1]["alt"])


@pytest.mark.integration
def test_every_sql_in_a_report_can_be_executed(project: tuple[Path, str], page: tuple[Page, str, bytes]) -> None:
    root, batch = project
    texts = re.findall(r"<pre tabindex=\"0\"[^>]*><code>(.*?)</code>", page[2].decode(), re.DOTALL)
    own = [text for text in texts if f"&#x27;{batch}&#x27;" in text and "FROM" in text and "FROM data" not in text]
    assert len(own) >= 4
    for text in own:
        statement = text.replace("&#x27;", "'").replace("&lt;", "<").replace("&gt;", ">")
        assert projects.quick(root, "sql", statement).returncode == 0, statement


@pytest.mark.integration
def test_texts_of_others_are_only_text_in_a_report(page: tuple[Page, str, bytes]) -> None:
    found, _, data = page
    assert [tag for tag, _ in found.elements if tag in ("iframe", "object", "form", "link", "base", "svg", "b", "i")] == []
    assert [one for one in found.all("img") if not str(one["src"]).startswith("data:image/svg+xml;base64,")] == []
    assert not any(name.startswith("on") or name == "style" for _, attributes in found.elements for name in attributes)
    assert {str(link["href"])[0] for link in found.all("a")} == {"#"}
    assert len([one for one in found.all("script") if one.get("type") is None]) == 1
    assert b"\xe2\x80\xae" not in data
    assert len(found.ids()) == len(set(found.ids()))
    assert "</script><script>alert(1)</script><img src=x onerror=alert(2)>" in found.text
    assert found.text.count("# a second line") >= 2


@pytest.mark.nightly
def test_the_same_store_gives_the_same_report(project: tuple[Path, str], page: tuple[Page, str, bytes], tmp_path: Path) -> None:
    root, batch = project
    reported_by(root, batch[:6], to=tmp_path / "again.html")
    assert (tmp_path / "again.html").read_bytes() == page[2]


@pytest.mark.nightly
def test_a_report_of_all_batches_begins_with_a_list(recorded: Path, tmp_path: Path) -> None:
    batches = [one.batch for one in sierra.open(recorded).batches]
    found, _ = reported_by(recorded, "--all", to=tmp_path / "all.html")
    assert [name for name in found.ids() if re.fullmatch(r"b[0-9a-f]{10}", name)] == [
        f"b{batch[:10]}" for batch in reversed(batches)
    ]
    assert len(found.ids()) == len(set(found.ids()))
    assert {str(link["href"])[1:] for link in found.all("a")} <= set(found.ids())
    levels = [int(tag[1]) for tag, _ in found.elements if re.fullmatch(r"h\d", tag)]
    assert levels[0] == 1
    assert all(after - before <= 1 for before, after in pairwise(levels))
    assert "How do results vary if only the seeds differ?" not in found.text


@pytest.mark.nightly
def test_a_report_of_ten_thousand_batches_is_their_list(tmp_path: Path) -> None:
    root = projects.make(tmp_path / "project")
    many_batches.make(root, 10_000)
    found, notes = reported_by(root, "--all", to=tmp_path / "all.html")
    assert "10,000 batches are too many for one page, so it only has their list; name some" in notes
    assert "The first 1,000 of 10,000 batches are listed; sierra ls lists all." in found.text
    shown = re.findall(r">population_size=(\d+)<", (tmp_path / "all.html").read_text())
    assert list(map(int, shown)) == list(range(9999, 8999, -1))
    assert found.all("img") == []
    assert (tmp_path / "all.html").stat().st_size < 1_000_000


@pytest.mark.nightly
def test_a_batch_that_still_runs_is_reported_as_such(tmp_path: Path) -> None:
    waiting = WAITING.format(folder=tmp_path)
    root = projects.make(tmp_path / "project", simulator=projects.SIMULATOR + waiting)
    project = sierra.open(root)
    batch = project.run("population_size=1,2", only="population_size=1", figures=False).batch
    found, _ = reported_by(root, to=tmp_path / "part.html")
    assert "Incomplete. 2 of 4 runs succeeded, 2 have no result." in found.text
    running = projects.start(root, "run", "population_size=1,2", "--no-figures")
    try:
        until((tmp_path / "waits").exists)
        found, _ = reported_by(root, batch, to=tmp_path / "part.html")
    finally:
        (tmp_path / "go").touch()
        running.communicate()
    assert "Still running. 2 of 4 runs succeeded, 2 are not finished." in found.text
    found, _ = reported_by(root, to=tmp_path / "part.html")
    assert "Complete. 4 of 4 runs succeeded." in found.text


@pytest.mark.nightly
def test_a_single_run_differs_from_no_other(tmp_path: Path) -> None:
    root = projects.make(tmp_path / "project")
    sierra.open(root).run("population_size=1", runs=1, figures=False)
    found, _ = reported_by(root, to=tmp_path / "one.html")
    assert "1 experiment with 1 run." in found.text


def test_only_a_report_is_replaced(recorded: Path, tmp_path: Path) -> None:
    file = tmp_path / "thesis.html"
    file.write_text("<!DOCTYPE html><p>my thesis")
    (tmp_path / "folder").mkdir()
    for name, words, code in (
        ("thesis.html", "exists and is no report of SIERRA", 2),
        ("folder", "is no file", 2),
        ("no/such.html", "no such folder", 3),
    ):
        done = projects.quick(recorded, "report", "--to", str(tmp_path / name))
        assert (done.returncode, done.stdout) == (code, "")
        assert words in done.stderr
    assert file.read_text() == "<!DOCTYPE html><p>my thesis"


def test_a_report_that_is_interrupted_leaves_the_one_before(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = files.OURS + b'0.1.0">'
    (tmp_path / "report.html").write_bytes(before)

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(Path, "replace", interrupt)
    with pytest.raises(KeyboardInterrupt):
        files.write(tmp_path / "report.html", b"new")
    monkeypatch.undo()
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == {"report.html": before}


@pytest.mark.nightly
def test_a_report_whose_writer_is_killed_is_as_before_and_nothing_of_it_stays(tmp_path: Path) -> None:
    before = files.OURS + b'0.1.0">'
    file = tmp_path / "report.html"
    file.write_bytes(before)
    done = subprocess.run([sys.executable, "-c", KILLED, str(file)], check=False)
    assert done.returncode == -signal.SIGKILL
    assert file.read_bytes() == before
    assert len([*tmp_path.iterdir()]) == 2, "the unfinished file is in a folder of its own"
    files.write(file, before + b"after")
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == {"report.html": before + b"after"}


def test_a_list_of_too_many_batches_says_how_many_it_lacks() -> None:
    listed = [
        list_batches.ListedBatch(f"{k:064x}", NOW, "noise=1", None, None, (), 1, 2, NOW, 0, 0, (), (), (), 0)
        for k in range(10_000)
    ]
    section = make.index_section(listed, (), "name some, as in: sierra report HASH HASH")
    assert section.body.count("<tr>") == make.MOST + 1
    assert "The first 1,000 of 10,000 batches are listed; sierra ls lists all." in section.body
    assert "sierra report HASH HASH" in section.body


def test_unknown_batches_and_contradicting_words_are_refused(recorded: Path, tmp_path: Path) -> None:
    for words in (("ffffffff",), ("--all", "abcd"), ("one.zip", "abcd"), ("one.zip", "--all")):
        done = projects.quick(recorded, "report", *words, "--to", str(tmp_path / "report.html"))
        assert done.returncode == 2, words
        assert done.stderr.startswith("sierra: ")
    assert projects.quick(tmp_path, "report", "none.zip").returncode == 3
    assert projects.quick(tmp_path, "report").returncode == 3
    assert not (tmp_path / "report.html").exists()


@pytest.mark.integration
@pytest.mark.parametrize("damaged", ["output.swarm", "batches"])
def test_a_damaged_store_writes_no_report(recorded: Path, tmp_path: Path, damaged: str) -> None:
    root = stores.copy(recorded, tmp_path / "copy")
    found = stores.files(root, damaged)
    for file in found:
        file.write_bytes(file.read_bytes()[:40])
    assert found
    done = projects.quick(root, "report", "--to", str(tmp_path / "report.html"))
    assert done.returncode == 1
    assert done.stderr.count("\n") == 1
    assert not (tmp_path / "report.html").exists()


@pytest.mark.integration
def test_the_report_of_a_package_executes_nothing_of_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ran = tmp_path / "ran"
    model = f'[models.bad]\ncommand = ["touch", "{ran}"]\ncolumn = "coverage"\n'
    within = '[comparisons.sizes]\nby = "population_size"\n[comparisons.both]\ngroups = ["calm", "sizes"]\n'
    queries = '[queries.sizes]\ncriteria = "population_size=1,2"\n[queries.calm]\ncriteria = "noise=0"\n'
    about = '[package]\ntitle = "Title"\nauthors = [{ name = "A B" }]\nlicense = "MIT"\n'
    root = projects.make(tmp_path / "project", projects.CONFIG + model + within + queries + about)
    stores.ask(root, "sizes", runs=3)
    packed = projects.quick(root, "package", sierra.open(root).batches[0].batch, "-o", str(tmp_path / "results.zip"), "--yes")
    assert packed.returncode == 0, packed.stderr
    ran.unlink(missing_ok=True)
    shutil.rmtree(root)
    done = projects.quick(tmp_path, "report", "results.zip", "--json")
    assert done.returncode == 0, done.stderr
    answer: dict[str, Any] = json.loads(done.stdout)
    assert Path(answer["file"]).name == "results-report.html"
    found = Page((tmp_path / "results-report.html").read_bytes())
    assert "Models are left out, because commands of the package would have to be executed: bad." in found.text
    assert "comparisons of several batches are not made from the declarations of a package: both" in found.text
    assert "2 − 1" in found.text
    assert "sierra reproduce results.zip" in found.text
    assert "A B (" in found.text
    assert not ran.exists()
    monkeypatch.setattr("sierra.deliverables.report.make.AT_MOST", 0)
    listed = projects.quick(tmp_path, "report", "results.zip")
    assert "1 batches are too many for one page, so it only has their list; see: sierra open FILE.zip explore" in listed.stderr
