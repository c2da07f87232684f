"""Records of figures: what was drawn from which data, and whether it still follows from the store."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

import sierra
from sierra.store.segments import manifest
from sierra.util.hashing import sha256
from tests import projects, stores


@pytest.fixture(scope="module")
def drawn_once(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = projects.make(tmp_path_factory.mktemp("drawn") / "project")
    sierra.open(root).run("population_size=1,2", runs=2)
    return root


@pytest.fixture
def drawn(drawn_once: Path, tmp_path: Path) -> Path:
    """A project with one batch of two experiments, and its figures."""
    return stores.copy(drawn_once, tmp_path / "project")


def rows(root: Path) -> list[tuple[str, str, str]]:
    found = sierra.open(root).sql("SELECT name, data, deliverable FROM deliverables ORDER BY ALL")
    return [tuple(row) for row in zip(*(found.column(name).to_pylist() for name in found.column_names), strict=True)]


def a_figure(root: Path, ending: str = "svg") -> Path:
    return min(root.glob(f"figures/*/*.{ending}"))


def check(root: Path, *words: str) -> tuple[int, str]:
    done = projects.quick(root, "figures", "--check", *words)
    return done.returncode, done.stdout + done.stderr


@pytest.mark.integration
def test_each_figure_is_recorded_once_however_often_it_is_drawn(drawn: Path) -> None:
    before = rows(drawn)
    names = {path.stem for path in drawn.glob("figures/*/*.svg")}
    assert {name for name, _, _ in before} == names
    assert len(before) == len(names)
    project = sierra.open(drawn)
    project.deliverables.figures()
    project.run("population_size=1,2", runs=2)
    assert rows(drawn) == before


@pytest.mark.integration
def test_a_run_without_new_data_leaves_figures_and_draws_those_that_were_changed_again(drawn: Path) -> None:
    left, changed = sorted(drawn.glob("figures/*/*.svg"))
    edited, removed = changed.with_suffix(".pdf"), changed.with_suffix(".png")
    content = {path: path.read_bytes() for path in (left, edited, removed)}
    number = left.stat().st_ino
    edited.write_bytes(b"other")
    removed.unlink()
    sierra.open(drawn).run("population_size=1,2", runs=2)
    assert {path: path.read_bytes() for path in content} == content
    assert left.stat().st_ino == number


@pytest.mark.integration
def test_check_is_successful_while_files_and_data_are_unchanged(drawn: Path) -> None:
    code, said = check(drawn)
    assert code == 0
    assert said.count("follows from the store") == len(rows(drawn)) > 0


@pytest.mark.integration
def test_figures_of_tables_that_no_declared_figure_shows_are_checked_too(drawn: Path) -> None:
    config = drawn / "sierra.toml"
    other = '[tables.other]\nsql = "SELECT run, coverage FROM swarm"\n[figures.other]\ntable = "other"\ncolumn = "coverage"\n'
    config.write_text(config.read_text() + other)
    assert check(drawn)[0] == 0


DECLARED = """
[figures.a]
column = "coverage"
title = "first"
[figures.default]
inherit = "a"
[paper_tables.t]
column = "coverage"
caption = "first"
[comparisons.c]
by = "population_size"
column = "coverage"
"""
DRAWN = ("a", "default", "swarm_coverage_summary", "swarm_coverage_timeseries")


@pytest.fixture(scope="module")
def declared(drawn_once: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A project with declared figures, a table and a comparison, which were drawn."""
    root = stores.copy(drawn_once, tmp_path_factory.mktemp("declared") / "project")
    (root / "sierra.toml").write_text(projects.CONFIG + DECLARED)
    assert projects.quick(root, "figures", "--format", "svg").returncode == 0
    assert projects.quick(root, "compare", "c").returncode == 0
    assert check(root)[0] == 0
    return root


@pytest.mark.integration
@pytest.mark.parametrize(
    ("old", "new", "changed"),
    [
        ('title = "first"', 'title = "second"', ["a: title", "default: title"]),
        ('title = "first"', 'title = "first"\nylim = [0, 9]', ["a: ylim", "default: ylim"]),
        ('inherit = "a"', 'inherit = "a"\nlog_y = true', ["default: log_y"]),
        ('column = "coverage"\ntitle', 'kind = "timeseries"\nformats = ["pdf"]\ncolumn = "coverage"\ntitle', []),
        ('caption = "first"', 'caption = "second"', ["t: caption"]),
        ('by = "population_size"', 'by = "population_size"\nalpha = 0.01', ["c: alpha"]),
        (
            '= "//swarm/@count"',
            '= { set = "//swarm/@count", label = "robots" }',
            [*(f"{one}: axes" for one in DRAWN), "t: headers"],
        ),
    ],
)
def test_check_notices_each_change_of_what_sierra_toml_declares(
    declared: Path, tmp_path: Path, old: str, new: str, changed: list[str]
) -> None:
    root = stores.copy(declared, tmp_path / "project")
    (root / "sierra.toml").write_text((projects.CONFIG + DECLARED).replace(old, new, 1))
    code, said = check(root)
    lines = [line for line in said.splitlines() if "follows from the store" not in line]
    found = [re.sub(r": sierra.toml changes how it is made: it has another (\w+) now; .*", r": \1", line) for line in lines]
    assert (code, found) == (int(bool(changed)), changed)


@pytest.mark.parametrize("change", ["edited", "removed"])
def test_check_names_a_file_that_is_not_the_one_that_was_drawn(drawn: Path, change: str) -> None:
    file = a_figure(drawn)
    if change == "edited":
        file.write_bytes(file.read_bytes().replace(b"1", b"2", 1))
    else:
        file.unlink()
    code, said = check(drawn)
    assert code == 1
    (line,) = [line for line in said.splitlines() if "follows from the store" not in line]
    assert f"figures/{file.parent.name}/{file.name}" in line
    assert ("is missing" if change == "removed" else "is not the file that SIERRA made") in line


@pytest.mark.integration
def test_check_says_that_the_store_has_other_data_after_an_execution_was_removed(drawn: Path) -> None:
    (execution,) = sierra.open(drawn).sql("SELECT min(execution) AS e FROM executions").column("e").to_pylist()
    assert projects.quick(drawn, "rm", execution, "--yes").returncode == 0
    code, said = check(drawn, "--json")
    assert code == 1
    assert all("other data" in one["problem"] for one in json.loads(said))


@pytest.mark.nightly
def test_formats_are_drawn_on_request_and_all_of_their_files_are_checked(drawn: Path) -> None:
    name = a_figure(drawn).stem
    done = projects.quick(drawn, "figures", "--format", "html, pgf", "--json")
    assert {Path(path).suffix for path in json.loads(done.stdout)} == {".html", ".pgf"}
    code, said = check(drawn)
    assert code == 0
    assert {f"{name} (html, pgf): follows from the store", f"{name} (png, pdf, svg, txt, tex): follows from the store"} <= set(
        said.splitlines()
    )
    page, before = a_figure(drawn, "html"), a_figure(drawn, "png").stat().st_ino
    shown = json.loads(projects.quick(drawn, "show", str(page), "--json").stdout)
    assert (shown["name"], shown["problem"], shown["definition"]["formats"]) == (name, None, ["html", "pgf"])
    sierra.open(drawn).run("population_size=1,2", runs=2)
    assert a_figure(drawn, "png").stat().st_ino == before
    a_figure(drawn).write_text("changed")
    code, said = check(drawn)
    assert (code, said.count("is not the file that SIERRA made")) == (1, 1)


@pytest.mark.nightly
def test_files_of_formats_that_are_no_longer_drawn_can_be_removed(drawn: Path) -> None:
    sierra.open(drawn).deliverables.figures(formats=["svg"])
    for ending in ("png", "pdf"):
        a_figure(drawn, ending).unlink()
    code, said = check(drawn)
    assert code == 0
    assert "is missing" not in said
    a_figure(drawn).unlink()
    assert check(drawn)[0] == 1


@pytest.mark.nightly
def test_sierra_toml_declares_formats(drawn: Path) -> None:
    config = drawn / "sierra.toml"
    text = 'figure_formats = ["svg", "html"]\n' + config.read_text() + '[figures.a]\ncolumn = "coverage"\n'
    config.write_text(text + '[figures.b]\ncolumn = "coverage"\nkind = "summary"\nformats = ["pdf"]\n')
    done = projects.quick(drawn, "run", "population_size=1,2", "--runs", "2")
    assert [line.split("/")[-1] for line in done.stdout.splitlines() if "figures/" in line] == ["a.svg (and .html)", "b.pdf"]
    assert {path.name for path in drawn.glob("figures/*/[ab].*")} == {"a.svg", "a.html", "b.pdf"}
    done = projects.quick(drawn, "compare", "--by", "population_size", "--json")
    assert {path.suffix for path in drawn.glob("figures/comparisons/[!.]*")} == {".svg", ".html"}, done.stderr


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--format", "htm"), "unknown format of figures 'htm'; did you mean 'html'?"),
        (("--format", ""), "unknown format of figures ''; known are png, pdf, svg, html, pgf"),
        (("--format", "pdf,svg,pdf"), "format 'pdf' is named twice; name each format once"),
        (("--format", "pdf", "--check"), "leave out --format"),
    ],
)
def test_formats_that_cannot_be_drawn_are_refused_in_one_line(drawn_once: Path, words: tuple[str, ...], said: str) -> None:
    done = projects.quick(drawn_once, "figures", *words)
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1)
    assert said in done.stderr


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('figure_formats = ["pdf", "pdf"]\n', "figure_formats: 'pdf' is named twice"),
        ("figure_formats = []\n", "figure_formats should not be empty"),
        (
            '[figures.a]\nformats = ["doc"]\n',
            "figures.a.formats.0 should be 'png', 'pdf', 'svg', 'html', 'pgf', 'txt' or 'tex'",
        ),
    ],
)
def test_declared_formats_are_checked(drawn: Path, text: str, said: str) -> None:
    config = drawn / "sierra.toml"
    config.write_text(text + config.read_text() if text.startswith("figure") else config.read_text() + text)
    done = projects.quick(drawn, "figures")
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert said in done.stderr


@pytest.mark.integration
def test_check_of_a_batch_without_figures_says_how_to_draw_them(drawn: Path) -> None:
    sierra.open(drawn).run("population_size=1", runs=1, figures=False)
    code, said = check(drawn)
    assert code == 0
    assert "sierra figures" in said


def test_check_takes_no_name(drawn: Path) -> None:
    (name, _, _), *_ = rows(drawn)
    batch = sierra.open(drawn).batches[-1].batch
    code, said = check(drawn, batch[:10], name)
    assert code == 2
    assert "--check" in said


@pytest.mark.parametrize("ending", ["svg", "png", "pdf"])
def test_show_tells_what_a_file_shows_wherever_it_is(drawn: Path, tmp_path: Path, ending: str) -> None:
    file = a_figure(drawn, ending)
    moved = shutil.copy(file, tmp_path / f"fig1.{ending}")
    done = projects.quick(drawn, "show", str(moved), "--json")
    assert done.returncode == 0, done.stderr
    shown = json.loads(done.stdout)
    assert shown["name"] == file.stem
    assert shown["problem"] is None
    assert shown["batch"] == sierra.open(drawn).batches[-1].batch
    assert "SELECT" in shown["sql"]
    assert shown["data"].encode() in Path(moved).read_bytes()


def test_show_of_a_changed_file_names_its_batch(drawn: Path, tmp_path: Path) -> None:
    changed = tmp_path / "changed.svg"
    changed.write_bytes(a_figure(drawn).read_bytes() + b"\n")
    done = projects.quick(drawn, "show", str(changed))
    assert done.returncode == 1
    assert sierra.open(drawn).batches[-1].batch[:10] in done.stderr
    assert "the file was changed" in done.stderr


def test_show_of_another_file_says_that_sierra_did_not_make_it(drawn: Path) -> None:
    done = projects.quick(drawn, "show", str(drawn / "sierra.toml"))
    assert done.returncode == 2
    assert "was not made by SIERRA" in done.stderr


@pytest.mark.integration
def test_removing_a_batch_removes_the_records_of_its_figures(drawn: Path) -> None:
    batch = sierra.open(drawn).batches[-1].batch
    assert projects.quick(drawn, "rm", batch, "--yes").returncode == 0
    assert rows(drawn) == []
    assert projects.quick(drawn, "fsck").returncode == 0


@pytest.mark.integration
def test_figures_are_drawn_although_the_store_cannot_be_written(drawn: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from sierra.deliverables import record
    from sierra.errors import Missing

    def full(*_: object, **__: object) -> None:
        raise Missing("cannot write to the store: No space left on device")

    config = drawn / "sierra.toml"
    config.write_text(config.read_text() + '[figures.new]\ncolumn = "coverage"\n')
    monkeypatch.setattr(record, "Session", full)
    _, notes = sierra.open(drawn).deliverables.draw()
    assert any("not recorded" in note and "No space left" in note for note in notes)
    assert list(drawn.glob("figures/*/new.svg"))


@pytest.mark.integration
def test_fsck_finds_a_record_that_was_changed(drawn: Path) -> None:
    assert projects.quick(drawn, "fsck").returncode == 0
    (path,) = drawn.glob(".sierra/segments/*/deliverables.parquet")
    found = pq.read_table(path)
    rows = [{**row, "data": "0" * 64} for row in found.to_pylist()]
    pq.write_table(pa.Table.from_pylist(rows, schema=found.schema), path)
    text = manifest(sorted(file for file in path.parent.iterdir() if file.name != "MANIFEST"))
    (path.parent / "MANIFEST").write_bytes(text)
    path.parent.rename(path.parent.with_name(path.parent.name[:13] + sha256(text)[:16]))
    done = projects.quick(drawn, "fsck")
    assert done.returncode == 1
    assert "does not have the id that follows from its columns" in done.stdout
