"""A package has all that its batches need and nothing of others, and is a project that replays them without git."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
import zipfile
from pathlib import Path

import pytest

import sierra
from sierra.errors import ConfigError, NotFound, UsageError
from sierra.packages import archive
from sierra.packages.members import MANIFEST
from sierra.packages.subject import Member
from tests import projects

TOML = """
[package]
title = "Coverage of a swarm"
authors = [{ name = "Jane Doe", orcid = "0000-0002-1825-0097" }]
license = "MIT"

[claims.some]
says = "Some | robots cover something."
paper = "Fig. 2"
query = "population_size=1,2"
runs = 2
sql = "SELECT count(*) > 0 AS holds FROM runs"
"""
NEEDS = """
SELECT sum(total) AS seconds, sum(least) AS shortest, max(most) AS longest, max(memory) AS memory, sum(runs)::INT AS measured
FROM (
    SELECT sum(wall_s) AS total, min(wall_s) AS least, max(wall_s) AS most, max(max_rss_bytes) AS memory, count(*) AS runs
    FROM executions JOIN batch_runs USING (batch, run) WHERE batch = '{}' GROUP BY ordinal)
"""
pytestmark = pytest.mark.integration


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A project in git with a batch, and another batch of a later, dirty source."""
    root = projects.commit(projects.make(tmp_path_factory.mktemp("pack") / "project", projects.CONFIG + TOML))
    for size in ("1,2", "2,3"):
        sierra.open(root).run(f"population_size={size}", runs=2, figures=False)
        (root / "sim.py").write_text((root / "sim.py").read_text() + "# later\n")
        (root / "tool.sh").write_text("#!/bin/sh\n")
        (root / "tool.sh").chmod(0o755)
        (root / "link").unlink(missing_ok=True)
        (root / "link").symlink_to("sim.py")
    return root


def batches(root: Path) -> list[str]:
    return [one.batch for one in sierra.open(root).batches]


def extracted(package: Path, folder: Path) -> Path:
    with zipfile.ZipFile(package) as file:
        file.extractall(folder)
    return folder / "project"


def test_a_package_is_a_project_that_replays_its_batch_without_git(root: Path, tmp_path: Path) -> None:
    first, second = batches(root)
    packed = sierra.open(root).packages.pack(first, report=False, path=tmp_path / "one.zip")
    assert packed is not None
    assert packed.preview.notes == ()
    project = sierra.open(extracted(tmp_path / "one.zip", tmp_path / "one"))
    command = [sys.executable, "-I", tmp_path / "one/reproduce.py"]
    said = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    assert "VERIFIED: " in said
    assert f"  id:      {packed.id} " in said
    assert f"  batch:   {first[:10]} " in said
    assert "reproduce.py --execute (it asks" in said
    assert [one.batch for one in project.batches] == [first]
    assert project.sql("SELECT count(*) AS n FROM executions").to_pylist() == [{"n": 4}]
    assert project.maintenance.fsck().sound
    assert "# later" not in (project.root / "sim.py").read_text()
    shown = [row["run"] for row in project.sql("SELECT run FROM runs").to_pylist()]
    assert len(shown) == 4
    verdict = project.replay(first)
    assert [one.verdict for experiment in verdict.experiments for one in experiment.runs] == ["identical"] * 4
    subprocess.run(["sha256sum", "--quiet", "--check", "manifest-sha256.txt"], cwd=tmp_path / "one", check=True)
    with pytest.raises(NotFound):
        project.replay(second)


def test_sources_of_several_batches_are_folders_and_dirty_ones_are_complete(root: Path, tmp_path: Path) -> None:
    first, second = batches(root)
    packed = sierra.open(root).packages.pack(second, first, report=False, path=tmp_path / "two.zip")
    assert packed is not None
    assert [note for note in packed.preview.notes if "link" in note] == [
        "project/link is a symbolic link; it is in the store only"
    ]
    folder = extracted(tmp_path / "two.zip", tmp_path / "two").parent
    described = json.loads((folder / "package.json").read_text())
    assert [one["batch"] for one in described["batches"]] == [first, second]
    older = described["sources"][1]["folder"]
    assert "# later" in (folder / "project" / "sim.py").read_text()
    assert "# later" not in (folder / older / "sim.py").read_text()
    with zipfile.ZipFile(tmp_path / "two.zip") as file:
        assert file.getinfo("project/tool.sh").external_attr >> 16 & 0o111
    assert sierra.open(folder / "project").maintenance.fsck().sound
    assert sierra.open(folder / "project").replay(second, runs=1).verdict == "identical"


@pytest.mark.nightly
def test_the_same_records_give_the_same_package_in_any_time_zone(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, zone in (("one", "UTC"), ("two", "America/New_York")):
        monkeypatch.setenv("TZ", zone)
        time.tzset()
        sierra.open(root).packages.pack(batches(root)[0], report=False, path=tmp_path / f"{name}.zip")
    monkeypatch.undo()
    time.tzset()
    assert (tmp_path / "one.zip").read_bytes() == (tmp_path / "two.zip").read_bytes()


@pytest.mark.nightly
def test_packing_changes_nothing_in_the_project_and_leaves_nothing_beside_the_file(root: Path, tmp_path: Path) -> None:
    before = sorted(path for path in root.rglob("*") if ".git/" not in str(path))
    assert (
        sierra.open(root).packages.pack(batches(root)[0], report=False, path=tmp_path / "no.zip", agree=lambda preview: False)
        is None
    )
    sierra.open(root).packages.pack(batches(root)[0], report=False, path=tmp_path / "one.zip")
    assert sorted(path for path in root.rglob("*") if ".git/" not in str(path)) == before
    assert os.listdir(tmp_path) == ["one.zip"]  # noqa: PTH208 - names only
    with pytest.raises(UsageError, match="exists already"):
        sierra.open(root).packages.pack(batches(root)[0], report=False, path=tmp_path / "one.zip")


def test_things_that_cannot_be_packed_are_refused_before_anything_is_written(tmp_path: Path) -> None:
    plain = projects.make(tmp_path / "plain")
    summary = sierra.open(plain).run("population_size=1", runs=1, figures=False)
    with pytest.raises(ConfigError, match="title, authors, license"):
        sierra.open(plain).packages.pack(summary.batch, report=False, path=tmp_path / "x.zip")
    crlf = projects.make(tmp_path / "crlf", projects.CONFIG + TOML)
    (crlf / ".gitattributes").write_text("notes.txt text eol=crlf\n")
    (crlf / "notes.txt").write_text("one\ntwo\n")
    projects.commit(crlf)
    batch = sierra.open(crlf).run("population_size=1", runs=1, figures=False).batch
    [run] = sierra.open(crlf).sql("SELECT run FROM runs").to_pylist()
    with pytest.raises(UsageError, match="is the id of a run"):
        sierra.open(crlf).packages.pack(run["run"], report=False, path=tmp_path / "x.zip")
    with pytest.raises(UsageError, match=r"git changes notes\.txt when it checks it out"):
        sierra.open(crlf).packages.pack(batch, report=False, path=tmp_path / "x.zip")
    assert not (tmp_path / "x.zip").exists()


def test_an_opened_package_answers_commands_that_read(root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    first, _ = batches(root)
    sierra.open(root).packages.pack(first, report=False, path=tmp_path / "one.zip")
    told = projects.quick(tmp_path, "open", "one.zip")
    assert (told.returncode, "Coverage of a swarm" in told.stdout, first[:10] in told.stdout) == (0, True, True)
    count = projects.quick(tmp_path, "open", "one.zip", "sql", "SELECT count(*) AS n FROM executions", "--json")
    assert json.loads(count.stdout) == [{"n": 4}]
    assert json.loads(projects.quick(tmp_path, "open", "one.zip", "ls", "--json").stdout)[0]["batch"] == first
    assert projects.quick(tmp_path, "open", "one.zip", "fsck").returncode == 0
    refused = projects.quick(tmp_path, "open", "one.zip", "run", "population_size=1")
    assert (refused.returncode, "'run'" in refused.stderr) == (2, True)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["cache", "one.zip"]
    assert not list((tmp_path / "cache").rglob("sim.py"))


def test_a_damaged_package_is_not_opened_and_leaves_nothing(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    sierra.open(root).packages.pack(batches(root)[0], report=False, path=tmp_path / "one.zip")
    whole = (tmp_path / "one.zip").read_bytes()
    with zipfile.ZipFile(tmp_path / "one.zip") as file:
        [segment] = [one for one in file.infolist() if one.filename.endswith("executions.parquet")]
    for damaged in (whole[:-100], whole[: segment.header_offset + 200] + b"?" + whole[segment.header_offset + 201 :]):
        (tmp_path / "bad.zip").write_bytes(damaged)
        ended = projects.quick(tmp_path, "open", "bad.zip", "ls")
        assert (ended.returncode, ended.stdout, ended.stderr.count("\n")) == (1, "", 1)
    assert not [path for path in (tmp_path / "cache").rglob("*") if path.is_file() and "packages" in path.parts]
    assert projects.quick(tmp_path, "open", "nothing.zip").returncode == 3


@pytest.mark.nightly
def test_files_that_runs_used_outside_the_source_are_packed_or_named(tmp_path: Path) -> None:
    root = projects.make(tmp_path / "project", projects.CONFIG + TOML)
    (root / ".gitignore").write_text("*.dat\n")
    for name in ("kept.dat", "changed.dat"):
        (root / name).write_text(name)
    code = (root / "sim.py").read_text()
    reading = "[Path(__file__).with_name(name).read_text() for name in ('kept.dat', 'changed.dat')]"
    (root / "sim.py").write_text(f"from pathlib import Path\n{reading}\n{code}")
    projects.commit(root)
    batch = sierra.open(root).run("population_size=1", runs=1, figures=False).batch
    (root / "changed.dat").write_text("other")
    ended = projects.quick(root, "package", batch, "--no-report", "-o", "../one.zip")
    assert (ended.returncode, "'changed.dat', which is not packed: it has changed since" in ended.stderr) == (2, True)
    assert not (tmp_path / "one.zip").exists()
    assert projects.quick(root, "package", batch, "--no-report", "-o", "../one.zip", "--yes").returncode == 0
    with zipfile.ZipFile(tmp_path / "one.zip") as file:
        names = set(file.namelist())
        listed = file.read("environment/used-files.txt").decode()
    assert "project/kept.dat" in names
    assert "project/changed.dat" not in names
    assert "python" in listed
    assert "kept.dat" not in listed


@pytest.mark.nightly
def test_incomplete_batches_and_studies_are_named(tmp_path: Path) -> None:
    failing = projects.SIMULATOR + "if seed % 2:\n    sys.exit(1)\n"
    root = projects.make(tmp_path / "project", projects.CONFIG + TOML, simulator=failing)
    project = sierra.open(root)
    summary = project.run("population_size=1,2", runs=4, figures=False)
    failed = sum(run.status != "ok" for run in project.sql("SELECT status FROM executions").frame().itertuples())
    packed = project.packages.pack(summary.batch, report=False, path=tmp_path / "failing.zip")
    assert packed is not None
    assert f"batch {summary.batch[:10]}: {failed} of 8 runs without a successful execution" in packed.preview.facts
    (root / "sim.py").write_text(projects.SIMULATOR)
    project = sierra.open(root)
    study = project.studies.run(
        project.plan("population_size=1", runs=2), until="ci(coverage) < 0.001", max_runs=4, figures=False
    )
    packed = project.packages.pack(study.looks[-1].row.batch, report=False, path=tmp_path / "study.zip")
    assert packed is not None
    count = len(study.looks)
    study_id = study.design.row.study
    assert packed.preview.notes == (f"study {study_id[:10]}: {count - 1} of {count} looks not packed; name their batches too",)
    other = projects.quick(projects.make(tmp_path / "other"), "run", "population_size=1", "--no-figures")
    assert other.returncode == 0
    assert "1 of studies left out" in projects.quick(tmp_path / "other", "import", str(tmp_path / "study.zip")).stdout


@pytest.mark.parametrize("name", ["project/.sierra/work/1/elsewhere", "project/.sierra/id", "project/.sierra/segments/x"])
def test_a_package_whose_store_has_more_than_records_is_not_opened(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    sierra.open(root).packages.pack(batches(root)[0], report=False, path=tmp_path / "one.zip")
    with zipfile.ZipFile(tmp_path / "one.zip") as file:
        contents = {one: Member(one, file.read(one), "") for one in file.namelist() if one != MANIFEST}
    archive.write(tmp_path / "bad.zip", {**contents, name: Member(name, b"/", "")})
    ended = projects.quick(tmp_path, "open", "bad.zip", "ls")
    assert (ended.returncode, ended.stdout, f"{name!r} is no record" in ended.stderr) == (1, "", True)


def test_a_package_with_an_unknown_description_is_not_opened_and_texts_control_no_terminal(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    sierra.open(root).packages.pack(batches(root)[0], report=False, path=tmp_path / "one.zip")
    with zipfile.ZipFile(tmp_path / "one.zip") as file:
        contents = {one: Member(one, file.read(one), "") for one in file.namelist() if one != MANIFEST}
    loud = contents["package.json"].content.replace(b"Coverage of a swarm", b"\\u001b[2J")
    archive.write(tmp_path / "loud.zip", {**contents, "package.json": Member("package.json", loud, "")})
    assert "\x1b" not in projects.quick(tmp_path, "open", "loud.zip").stdout
    newer = b'{"format": "sierra package 2"}'
    for number, described in enumerate((newer, b"[" * 100_000, b"[]", b"\xff")):
        archive.write(tmp_path / f"{number}.zip", {**contents, "package.json": Member("package.json", described, "")})
        ended = projects.quick(tmp_path, "open", f"{number}.zip")
        assert (ended.returncode, ended.stdout, ended.stderr.count("\n")) == (1, "", 1)
        assert "package.json" in ended.stderr


@pytest.mark.nightly
def test_the_instructions_have_commands_that_work_and_measured_needs(root: Path, tmp_path: Path) -> None:
    first, second = batches(root)
    assert sierra.open(root).packages.pack(first, second, report=False, path=tmp_path / "both.zip")
    project = extracted(tmp_path / "both.zip", tmp_path / "both")
    text = (project.parent / "REPRODUCING.md").read_text()
    described = json.loads((project.parent / "package.json").read_text())
    for batch in described["batches"]:
        assert batch["needs"] == pytest.approx(sierra.open(root).sql(NEEDS.format(batch["batch"])).to_pylist()[0], abs=1e-4)
        assert f"| `{batch['batch'][:10]}` | `{batch['query']}` | 2 | 4 | 4 |" in text
    [decided] = described["claims"]
    assert (decided["verdict"], decided["batches"]) == ("holds", [first])  # whose source is not that of today
    assert "| Some \\| robots cover something. | Fig. 2 | " in text
    [machine] = described["machines"]
    assert f"{machine['cores']} core" in text
    for line in (*text.splitlines(), *(project.parent / "README.md").read_text().splitlines()):
        assert "copy" in line or not any(f"`sierra {command}" in line for command in ("claims", "why", "ls"))  # they write
    last = text.split("```sh\n")[-1].split("```")[0]
    path = {**os.environ, "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"}
    subprocess.run(["sh", "-ec", last], cwd=project.parent, env=path, check=True)
    subprocess.run([sys.executable, "reproduce.py"], cwd=project.parent, check=True)


@pytest.mark.nightly
def test_submodules_and_data_of_git_lfs_are_packed_and_replayed_without_git(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("GIT_CONFIG_COUNT", "1")
    monkeypatch.setenv("GIT_CONFIG_KEY_0", "protocol.file.allow")
    monkeypatch.setenv("GIT_CONFIG_VALUE_0", "always")
    (tmp_path / "library").mkdir()
    (tmp_path / "library" / "factor.txt").write_text("3")
    projects.commit(tmp_path / "library")
    reading = (
        "from pathlib import Path\n"
        "here = Path(__file__).parent\n"
        "factor = int((here / 'library/factor.txt').read_text()) + len((here / 'big.dat').read_text())\n"
    )
    simulator = reading + projects.SIMULATOR.replace("count * tick", "factor * count * tick")
    root = projects.make(tmp_path / "project", projects.CONFIG + TOML, simulator=simulator)
    subprocess.run(["git", "init", "-q"], cwd=root, check=True)
    kept = tmp_path / "lfs"
    kept.mkdir()
    clean = f"cat > {kept}/new; h=$(sha256sum < {kept}/new | cut -c1-64); s=$(($(wc -c < {kept}/new))); mv {kept}/new {kept}/$h"
    text = "version https://git-lfs.github.com/spec/v1\\noid sha256:%s\\nsize %s\\n"
    smudge = f"cat {kept}/$(sed -n s/^oid.sha256:://p | cut -c1-64)"
    for name, command in (("clean", f"{clean}; printf '{text}' $h $s"), ("smudge", smudge.replace("::", ":"))):
        subprocess.run(["git", "config", f"filter.lfs.{name}", command], cwd=root, check=True)
    (root / ".gitattributes").write_text("*.dat filter=lfs -text\n")
    (root / "big.dat").write_text("data of git-lfs\n" * 100)
    subprocess.run(["git", "submodule", "--quiet", "add", tmp_path / "library", "library"], cwd=root, check=True)
    projects.commit(root)
    first = sierra.open(root).run("population_size=1", runs=1, figures=False).batch
    (root / "library" / "factor.txt").write_text("4")
    second = sierra.open(root).run("population_size=2", runs=1, figures=False).batch
    packed = sierra.open(root).packages.pack(first, second, report=False, path=tmp_path / "one.zip")
    assert packed is not None
    assert packed.preview.notes == ()
    seen: list[str] = []
    options = {"anonymous": True, "allow": (str(tmp_path),)}  # .gitmodules has the address of the submodule
    sierra.open(root).packages.pack(
        first, report=False, path=tmp_path / "review.zip", agree=lambda one: bool(seen.extend(one.notes)), **options
    )
    assert [note for note in seen if "commits of submodules" in note and note.endswith(": library")]
    project = sierra.open(extracted(tmp_path / "one.zip", tmp_path / "one"))
    assert (project.root / "library" / "factor.txt").read_text() == "4"
    assert (project.root / "big.dat").read_bytes() == (root / "big.dat").read_bytes()
    assert project.maintenance.fsck().findings == ()
    assert {project.replay(batch).verdict for batch in (first, second)} == {"identical"}
    again = project.packages.pack(first, report=False, path=tmp_path / "again.zip")
    assert again is not None
    project = sierra.open(extracted(tmp_path / "again.zip", tmp_path / "again"))
    assert (project.root / "library" / "factor.txt").read_text() == "3"
    assert project.replay(first).verdict == "identical"
