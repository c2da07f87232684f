"""Reports are recorded deliverables, play small videos, and are parts of packages."""

from __future__ import annotations

import base64
import json
import re
import shutil
import zipfile
from pathlib import Path
from typing import Any

import pytest

import sierra
from sierra.cli import progress
from sierra.deliverables.record import Deliverable, Recorder
from sierra.deliverables.report import moving_pictures
from sierra.packages.reading import received
from tests import projects, stores
from tests.extensions.videos import filmed
from tests.tiers import needs_extension

pytestmark = pytest.mark.integration
VIDEO = re.compile(rb'<(?:video|img) src="data:(video/\w+|image/gif);base64,([^"]*)"')
RECORDS = "SELECT name, kind, batches, files, made_by FROM deliverables WHERE kind = 'report'"


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    return filmed.make(tmp_path_factory.mktemp("filmed") / "project")


@pytest.fixture
def project(made: tuple[Path, str], tmp_path: Path) -> tuple[Path, str]:
    """A copy of the project with a video, and the id of its batch."""
    return stores.copy(made[0], tmp_path / "project"), made[1]


def checked(root: Path) -> dict[str, str | None]:
    """Return the problem of each deliverable of the last batch by its kind, as `sierra figures --check` tells it."""
    return {one["kind"]: one["problem"] for one in json.loads(projects.quick(root, "figures", "--check", "--json").stdout)}


@pytest.mark.nightly
def test_a_log_has_lines_on_parts_of_a_report_and_frames_of_videos(
    project: tuple[Path, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    root, _ = project
    monkeypatch.setattr(progress, "FIRST_S", 0.0)
    alone = projects.quick(root, "report").stderr
    assert "figure 1 of 1: coverage\n" in alone
    drawn = projects.quick(root, "video").stderr.splitlines()
    assert [line for line in drawn if line.endswith("frames read")] == [f"{k} of 10 frames read" for k in range(1, 11)]
    assert [line for line in drawn if line.endswith("frames drawn")] == [f"{k} of 20 frames drawn" for k in range(1, 21)]
    assert "figure" not in projects.quick(root, "report", "--json").stderr.replace("of the figure", "")
    assert "frames" not in projects.quick(root, "video", "-q").stderr
    stores.ask(root, "population_size=1", runs=1)
    assert "batch 2 of 2, figure 1 of 1: coverage\n" in projects.quick(root, "report", "--all").stderr


@pytest.mark.parametrize("damaged", ["output.floor", "batches"])
def test_a_damaged_store_makes_no_video(project: tuple[Path, str], damaged: str) -> None:
    root, _ = project
    shutil.rmtree(root / "figures")
    for file in stores.files(root, damaged):
        file.write_bytes(file.read_bytes()[:40])
    done = projects.quick(root, "video")
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (1, "", 1), done.stderr
    assert "store" in done.stderr
    assert list(root.glob("figures/*/*.*")) == []


def test_a_report_is_recorded_once_and_checked_like_figures(project: tuple[Path, str], tmp_path: Path) -> None:
    root, batch = project
    file = root / f"figures/reports/{batch[:10]}.html"
    for _ in range(2):
        assert projects.quick(root, "report").returncode == 0
    [row] = projects.sql(root, RECORDS)
    assert (row["name"], row["batches"], row["files"]) == (batch[:10], [batch], [f"figures/reports/{batch[:10]}.html"])
    assert any(name.startswith("matplotlib==") for name in row["made_by"])
    assert checked(root) == {"report": None, "video": None}
    shown = projects.quick(root, "show", str(file), "--json")
    assert json.loads(shown.stdout)["deliverable_kind"] == "report"
    page = file.read_bytes()
    file.write_bytes(page + b" ")
    assert "is not the file that SIERRA made" in str(checked(root)["report"])
    edited = projects.quick(root, "show", str(file))
    assert f"says that SIERRA {sierra.__version__} made it from batch {batch[:10]}" in edited.stderr
    file.write_bytes(page)
    project_ = sierra.open(root)
    project_.comparisons.draw(project_.comparisons.make(batch, by=["population_size"], column="coverage", measure="mean"))
    assert checked(root)["report"] == "the store or sierra.toml has changed since; write it again with: sierra report"
    assert projects.quick(root, "report", "--to", str(tmp_path / "elsewhere.html")).returncode == 0
    assert len(projects.sql(root, RECORDS)) == 1, "a file outside of the project is not recorded"
    assert projects.quick(root, "report", "--all").returncode == 0
    assert checked(root)["report"] is None


@pytest.mark.nightly
def test_small_videos_are_played_in_the_report_if_they_are_the_recorded_ones(
    project: tuple[Path, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    root, _ = project
    to = tmp_path / "report.html"
    film = next(root.glob("figures/*/heat*.mp4"))

    def played() -> list[tuple[bytes, bytes]]:
        assert projects.quick(root, "report", "--to", str(to)).returncode == 0
        return [(kind, base64.b64decode(data)) for kind, data in VIDEO.findall(to.read_bytes())]

    assert played() == [(b"video/mp4", film.read_bytes())], "one format of each film"
    page = to.read_text()
    assert "; media-src data:" in page
    assert "&lt;script&gt;alert(1)&lt;/script&gt;" in page
    assert all(file.name in page for file in root.glob("figures/*/heat*"))
    film.write_bytes(film.read_bytes()[:-1])
    assert [kind for kind, _ in played()] == [b"image/gif"]
    shutil.move(root / "figures", tmp_path / "figures")
    (root / "figures").symlink_to(tmp_path / "figures")
    assert played() == [], "nothing outside of the project becomes a part of a page"
    monkeypatch.setattr(moving_pictures, "LARGEST", 100)
    assert played() == []
    assert "These files are not in this page." in to.read_text()


@needs_extension("trials")
def test_a_report_says_which_videos_are_older_than_the_results(project: tuple[Path, str], tmp_path: Path) -> None:
    from sierra.extensions.trials import mark_trial

    root, _ = project
    to, opened = tmp_path / "report.html", sierra.open(root)
    opened.deliverables.report(to=to)
    assert "are older than the last results" not in to.read_text()
    [one, *_] = projects.sql(root, "SELECT execution FROM effective ORDER BY execution")
    mark_trial(opened, one["execution"], valid=False, reason="wet floor")
    opened.deliverables.report(to=to)
    assert "files are older than the last results of this batch: heat. sierra figures --check tells" in to.read_text()


@pytest.mark.nightly
def test_a_package_has_a_report_and_the_videos(project: tuple[Path, str], tmp_path: Path) -> None:
    root, batch = project
    film = next(root.glob("figures/*/heat*.mp4"))
    assert projects.quick(root, "report").returncode == 0
    packed = projects.quick(root, "package", batch, "-o", "../one.zip", "--yes")
    assert packed.returncode == 0, packed.stderr
    with zipfile.ZipFile(tmp_path / "one.zip") as archive:
        names, inside = archive.namelist(), archive.read("report.html")
        assert "- `report.html`: what the records say" in archive.read("REPRODUCING.md").decode()
    assert {name for name in names if name.endswith((".html", ".mp4"))} == {
        "report.html",
        film.relative_to(root).as_posix(),
    }
    shutil.rmtree(root)
    done = projects.quick(tmp_path, "open", "one.zip", "report", "--json")
    assert done.returncode == 0, done.stderr
    assert Path(json.loads(done.stdout)["file"]).name == "one-report.html"
    outside = (tmp_path / "one-report.html").read_bytes()
    for page in (inside, outside):
        assert [base64.b64decode(data) for _, data in VIDEO.findall(page)] != []
        assert b"Nothing of it was executed to make this page" in page
    assert re.findall(rb'src="data:[^"]*"', inside) == re.findall(rb'src="data:[^"]*"', outside)
    listed = projects.quick(tmp_path, "open", "one.zip", "video", "--json")
    assert [(one["name"], one["kind"], len(one["files"])) for one in json.loads(listed.stdout)] == [("heat", "video", 2)]
    assert projects.quick(tmp_path, "open", "one.zip", "video", "--to", "here").returncode == 0
    assert len([*(tmp_path / "here").rglob("heat*")]) == 2
    assert projects.quick(tmp_path, "open", "one.zip", "video", "other").returncode == 2


@pytest.mark.nightly
@needs_extension("explorer")
def test_the_explorer_of_a_package_plays_its_videos(project: tuple[Path, str], tmp_path: Path) -> None:
    from sierra.extensions.explorer import explorer
    from tests.extensions.explorer.page import served

    root, batch = project
    film = next(root.glob("figures/*/heat*.mp4")).read_bytes()
    assert projects.quick(root, "package", batch, "-o", "../one.zip", "--yes").returncode == 0
    package = received.open_package(tmp_path / "one.zip")
    with served(explorer(sierra.open(package.project.root), package=package)) as page_:
        [video] = page_.ask("batch", batch=batch)["videos"]
        status, body, headers = page_.send("GET", video["address"], X_Sierra_Token="", Range="bytes=4-99")
        assert (status, body, headers["Content-Type"]) == (206, film[4:100], "video/mp4")
        (tmp_path / "one.zip").unlink()
        assert page_.send("GET", video["address"])[0] == 404


@pytest.mark.nightly
def test_the_report_and_the_videos_can_be_left_out_of_a_package(project: tuple[Path, str], tmp_path: Path) -> None:
    root, batch = project
    words = ("package", batch, "-o", "../one.zip", "--no-report", "--no-videos", "--yes")
    assert projects.quick(root, *words).returncode == 0
    with zipfile.ZipFile(tmp_path / "one.zip") as archive:
        assert not [name for name in archive.namelist() if name.endswith((".html", ".mp4", ".gif"))]
        assert f"- the videos of batch {batch[:10]} are left out: heat" in archive.read("REPRODUCING.md").decode()


@pytest.mark.nightly
def test_an_anonymous_package_has_a_report_without_names(project: tuple[Path, str], tmp_path: Path) -> None:
    root, batch = project
    packed = projects.quick(root, "package", batch, "-o", "../one.zip", "--anonymous", "--yes")
    assert packed.returncode == 0, packed.stderr
    with zipfile.ZipFile(tmp_path / "one.zip") as archive:
        page = archive.read("report.html").decode()
    assert "host-1" in page
    assert "Jane" not in page


def test_records_of_strangers_show_no_file_and_execute_nothing(project: tuple[Path, str], tmp_path: Path) -> None:
    root, batch = project
    (root / "x.mp4").write_bytes(b"not a video")
    recorder = Recorder(sierra.open(root).store, root, batch)
    definitions: list[Any] = [{"files": 3}, [], {"files": {"x": {"title": "</script><script>alert(1)"}}}]
    for kind in ("video", "comparison", "report", "table"):
        for number, definition in enumerate(definitions):
            stranger = Deliverable(kind, f"<script>{number}", (batch,), definition, "", "0" * 64, ())
            recorder.add(stranger, (root / "x.mp4",))
    recorder.close()
    packed = projects.quick(root, "package", batch, "-o", "../one.zip", "--yes")
    assert packed.returncode == 0, packed.stderr
    for words in (("report",), ("video",), ("figures",)):
        done = projects.quick(tmp_path, "open", "one.zip", *words)
        assert done.returncode == 0, done.stderr
    page = (tmp_path / "one-report.html").read_text()
    assert "<script>alert" not in page
    assert "has a definition that SIERRA does not write" in page
    assert len(VIDEO.findall(page.encode())) == 1
