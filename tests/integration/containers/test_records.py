"""Records of containers: images by their content, and the isolation of executions, are shown, compared and kept."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

import sierra
from sierra.containers.engines import podman_ways_to_start
from sierra.containers.engines.base import Capabilities
from sierra.maintenance.findings import Kind
from tests import containers, images, projects, stores
from tests.unit.maintenance.test_fsck import seal

pytestmark = pytest.mark.real
LIMITS = '[limits]\nmemory = "64 MB"\n'
VERSIONS = {"old": {"libc6": "2.36-9", "tzdata": "1"}, "new": {"libc6": "2.36-10", "zlib": "3"}}
ENFORCED = Capabilities("podman 1, runc 1", enforced=frozenset({"cpus", "pids"}), user="root")
IGNORED = Capabilities("podman 2, runc 1", enforced=frozenset({"pids"}), user="root")


def image(folder: Path, name: str) -> Path:
    """Make an image with a shell, and a list of packages in the format of Debian."""
    links = [(f"bin/{applet} -> busybox", "") for applet in ("sh", "sed", "cat")]
    shell = images.layer(*((one, "") for one in containers.FOLDERS), ("bin/busybox", containers.BUSYBOX.read_bytes()), *links)
    status = "".join(
        f"Package: {package}\nStatus: install ok installed\nVersion: {version}\n\n"
        for package, version in VERSIONS[name].items()
    )
    more = images.layer(("var/lib/dpkg/status", status), ("usr/lib/libm.so", name))
    made = images.config([shell, more], config={"Env": [f"MODEL={name}"]}, history=[{"created_by": f"COPY {name}"}])
    return images.docker_archive(folder / f"{name}.tar", [shell, more], made)


def configure(root: Path, name: str, *more: str) -> None:
    """Make the project's runs execute in this image; `more` are lines of [container]."""
    before = (root / "sierra.toml").read_text().partition("[container]")[0]
    container = "\n".join(("[container]", f'image = "../{name}.tar"', *more))
    (root / "sierra.toml").write_text(f"{before}{container}\n")


def succeed(root: Path, *words: str) -> str:
    done = projects.quick(root, *words)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def ask(root: Path, *words: str) -> str:
    succeed(root, "run", *words, "--runs", "1", "--no-figures")
    return str(sierra.open(root).batches[-1].batch)


def make(folder: Path) -> Path:
    """Make a project with the batches `old`, `new` in another image, and `reaching` in that image with more host access."""
    for name in VERSIONS:
        image(folder, name)
    root = projects.make(folder / "project", projects.CONFIG.replace("python3 sim.py {input}", "sh sim.sh {input}") + LIMITS)
    (root / "sim.py").unlink()
    (root / "sim.sh").write_text(containers.SIMULATOR)
    for name in ("a", "b"):
        (folder / "maps" / name).mkdir(parents=True)
        (folder / "maps" / name / "town").write_text(name)
    (folder / "maps" / "town").write_text("1")
    batches = {}
    with pytest.MonkeyPatch.context() as patch:
        for called, able, name, more in (
            ("old", ENFORCED, "old", ("cpus = 1.0", "pids = 50")),
            ("new", IGNORED, "new", ("cpus = 1.0", "pids = 50")),
            ("reaching", ENFORCED, "new", ("network = true", 'mounts = { "/maps" = "../maps" }')),
        ):
            patch.setattr(podman_ways_to_start, "podman", lambda able=able: able)
            configure(root, name, *more)
            succeed(root, "image", "pin")
            batches[called] = ask(root, "population_size=1")
    (folder / "batches.json").write_text(json.dumps(batches))
    return folder


@pytest.fixture(scope="session")
def made(tmp_path_factory: pytest.TempPathFactory) -> Callable[[], Path]:
    """Return a function that makes this project once; callers have checked its requirements."""
    folder = tmp_path_factory.mktemp("contained")

    def once() -> Path:
        return folder if (folder / "batches.json").exists() else make(folder)

    return once


@pytest.fixture
def root(tmp_path: Path, made: Callable[[], Path], require: Callable[..., str]) -> Path:
    """Return a copy of this project, which a test may change."""
    require("busybox-static, as /bin/busybox", there=containers.BUSYBOX.exists())
    require("podman")
    return stores.copy(made(), tmp_path / "copy") / "project"


@pytest.fixture
def batches(root: Path) -> dict[str, str]:
    found: dict[str, str] = json.loads((root.parent / "batches.json").read_text())
    return found


def said(root: Path, *words: str) -> dict[str, Any]:
    answer: dict[str, Any] = json.loads(projects.quick(root, *words, "--json").stdout)
    return answer


def execution(root: Path, batch: str) -> str:
    [row] = sierra.open(root).sql("SELECT execution FROM executions WHERE batch = $b", b=batch).to_pylist()
    return str(row["execution"])


def forge(root: Path, table: str, change: Mapping[str, Any]) -> None:
    """Rewrite all rows of a table with changes and with correct hashes of files."""
    for path in sorted(root.glob(f".sierra/segments/*/{table}.parquet")):
        found = pq.read_table(path)
        pq.write_table(pa.Table.from_pylist([{**row, **change} for row in found.to_pylist()], schema=found.schema), path)
        seal(path.parent)


# ---------------------------------------------------------------- shown


@pytest.mark.nightly
@pytest.mark.parametrize("kind", ["batch", "execution"])
def test_show_displays_the_image_and_the_isolation(root: Path, batches: Mapping[str, str], kind: str) -> None:
    identity = batches["old"] if kind == "batch" else execution(root, batches["old"])
    shown = said(root, "show", identity)
    assert shown["image"]["packages"] == {"dpkg": ["libc6==2.36-9", "tzdata==1"]}
    assert (shown["image"]["name"], shown["image"]["kind"]) == ("../old.tar", "oci")
    isolation = shown["isolation"] if kind == "execution" else shown["isolations"][0]
    assert (isolation["engine"], isolation["version"], isolation["mode"]) == ("podman", "podman 1, runc 1", "run")
    assert isolation["limits_enforced"] == {"cpus": 1.0, "pids": 50}
    assert isolation["limits_asked"] == {"cpus": 1.0, "memory": 64_000_000, "pids": 50}
    text = succeed(root, "show", identity)
    for words in (
        shown["image"]["image"],
        "2 of dpkg",
        "COPY old",
        "host access   none",
        "one for each run",
        "cpus 1, pids 50",
    ):
        assert words in text
    assert "IGNORED" not in text


@pytest.mark.nightly
def test_show_highlights_ignored_limits(root: Path, batches: Mapping[str, str]) -> None:
    text = succeed(root, "show", batches["new"])
    assert [line.split() for line in text.splitlines() if "IGNORED" in line] == [["LIMITS", "IGNORED", "cpus", "1"]]
    assert "limits monitored  memory 64 MB" in text
    [isolation] = said(root, "show", batches["new"])["isolations"]
    assert (isolation["limits_watched"], isolation["limits_ignored"]) == ({"memory": 64_000_000}, {"cpus": 1.0})


@pytest.mark.nightly
def test_show_displays_the_host_access_of_runs(root: Path, batches: Mapping[str, str]) -> None:
    text = succeed(root, "show", execution(root, batches["reaching"]))
    assert "mount /maps, network" in text
    assert "/maps from /" in text


@pytest.mark.nightly
def test_show_reports_an_execution_without_a_container(root: Path, batches: Mapping[str, str]) -> None:
    """A replay on the host itself leaves such a record."""
    one = execution(root, batches["old"])
    forge(root, "isolations", {"isolation": "0" * 64})
    assert "engine  not recorded" in succeed(root, "show", one)
    forge(root, "executions", {"isolation": None})
    assert "isolation: none, executed directly on the host" in succeed(root, "show", one)


# ---------------------------------------------------------------- compared


def differences(root: Path, *words: str) -> dict[tuple[str, str], dict[str, Any]]:
    return {(one["kind"], one["name"]): one for one in said(root, "diff", *words)["differences"]}


def test_images_are_compared_by_their_content(root: Path, batches: Mapping[str, str]) -> None:
    found = differences(root, batches["old"], batches["new"])
    names = [name for kind, name in found if kind == "image"]
    assert names == ["image", "dpkg", "variables", "files"]
    assert found["image", "image"]["line"].startswith("image: ../old.tar (sha256:")
    packages = found["image", "dpkg"]
    assert packages["line"].endswith("3 differ: libc6 2.36-9 → 2.36-10, zlib 3 new, tzdata 1 gone")
    assert packages["after"] == {"libc6": "2.36-10", "tzdata": None, "zlib": "3"}
    assert "MODEL old → new" in found["image", "variables"]["line"]
    assert found["image", "files"]["line"].endswith("2 differ: usr/lib/libm.so, var/lib/dpkg/status")


@pytest.mark.nightly
def test_isolations_are_compared_by_enforced_and_ignored_limits(root: Path, batches: Mapping[str, str]) -> None:
    found = differences(root, batches["old"], batches["new"])
    told = {name: one["line"] for (kind, name), one in found.items() if kind == "isolation"}
    assert told == {
        "limits_enforced": "limits enforced: cpus 1 → nothing",
        "limits_ignored": "limits ignored: cpus nothing → 1",
        "version": "engine version: podman 1, runc 1 → podman 2, runc 1",
    }


@pytest.mark.nightly
def test_the_host_access_of_runs_is_compared(root: Path, batches: Mapping[str, str]) -> None:
    found = differences(root, batches["new"], batches["reaching"])
    assert [name for kind, name in found if kind == "image"] == ["host_access"]
    assert "mount /maps is new, network is new" in found["image", "host_access"]["line"]
    assert found["isolation", "network"]["line"] == "network of the container: none → host"


@pytest.mark.nightly
def test_executions_with_and_without_a_container_are_compared(root: Path, batches: Mapping[str, str]) -> None:
    (root / "sierra.toml").write_text((root / "sierra.toml").read_text().partition("[container]")[0])
    plain = ask(root, "population_size=1")
    found = differences(root, batches["old"], plain)
    assert found["image", "image"]["line"].endswith(" → none")
    assert found["isolation", "engine"]["line"] == "isolated by: podman 1, runc 1 → none (on the host)"


@pytest.mark.nightly
def test_images_without_recorded_content_are_compared_by_id(root: Path, batches: Mapping[str, str]) -> None:
    for path in root.glob(".sierra/segments/*/images.parquet"):
        path.unlink()
    found = differences(root, batches["old"], batches["new"])
    assert [name for kind, name in found if kind == "image"] == ["image"]
    assert "(not recorded)" in found["image", "image"]["line"]


# ---------------------------------------------------------------- why runs are new


def explained(root: Path) -> str:
    return succeed(root, "run", "population_size=1", "--runs", "1", "--dry-run", "--explain")


def test_another_image_makes_runs_new_and_changed_packages_are_named(root: Path, batches: Mapping[str, str]) -> None:
    succeed(root, "rm", batches["old"], batches["reaching"], "--yes")
    configure(root, "old")
    text = explained(root)
    assert "image: ../new.tar (sha256:" in text
    assert "dpkg packages of the image: 3 differ: libc6 2.36-10 → 2.36-9, zlib 3 gone, tzdata 1 new" in text
    assert sierra.open(root).records.why(batches["new"]).next_run.differences[0].kind == "image"


@pytest.mark.nightly
def test_why_reports_differences_of_images_and_host_access(root: Path, batches: Mapping[str, str]) -> None:
    text = succeed(root, "why", batches["new"])
    assert "image: ../old.tar (sha256:" in text
    assert "libc6 2.36-9 → 2.36-10" in text
    assert "host access of runs: mount /maps is new, network is new" in succeed(root, "why", batches["reaching"])


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("lines", "told"),
    [
        (['mounts = { "/maps" = "../maps" }'], "network is gone"),
        (["network = true", 'devices = ["/dev/null"]'], "device /dev/null is new, mount /maps is gone"),
    ],
)
def test_changed_host_access_makes_runs_new(root: Path, lines: list[str], told: str) -> None:
    configure(root, "new", *lines)
    assert f"host access of runs: {told}" in explained(root)


@pytest.mark.nightly
def test_changed_files_in_mounts_are_named(root: Path, batches: Mapping[str, str]) -> None:
    assert "1 run: reused" in explained(root)
    maps = root.parent / "maps"
    (maps / "town").write_text("2")
    assert "{mount}/maps/town: 6b86b273ff recorded" in explained(root)
    assert "{mount}/maps/town: 6b86b273ff recorded" in succeed(root, "why", batches["reaching"])


@pytest.mark.nightly
def test_swapped_files_in_mounts_execute_runs_again(root: Path) -> None:
    one, other = (root.parent / "maps" / folder / "town" for folder in ("a", "b"))
    assert "1 run: reused" in explained(root)
    one.write_text("b")
    other.write_text("a")
    assert "1 run: executed with other programs" in explained(root)


# ---------------------------------------------------------------- kept


def wrong(root: Path) -> set[Kind]:
    return {finding.kind for finding in sierra.open(root).maintenance.fsck().findings if not finding.kind.fine}


@pytest.mark.nightly
def test_fsck_finds_the_records_of_containers_sound(root: Path) -> None:
    assert "sound: " in succeed(root, "fsck")
    assert said(root, "fsck")["findings"] == []


def test_the_isolation_is_recorded_together_with_executions(root: Path) -> None:
    """After `kill -9`, the records that a session writes at its end are missing."""
    for path in root.glob(".sierra/segments/*/sessions.parquet"):
        shutil.rmtree(path.parent)
    found = sierra.open(root).maintenance.fsck()
    assert found.executions == 3
    assert all("isolation" not in finding.what for finding in found.findings)
    assert len(sierra.open(root).sql("SELECT DISTINCT isolation FROM isolations JOIN executions USING (isolation)")) == 3


FORGED: dict[str, tuple[str, dict[str, Any], Kind]] = {
    "a network": ("isolations", {"network": "none at all"}, Kind.INCONSISTENT),
    "an isolation": ("isolations", {"isolation": "0" * 64}, Kind.LOST),
    "an image": ("images", {"image": "sha256:" + "0" * 64}, Kind.LOST),
    "a listing": ("images", {"files": "0" * 64}, Kind.LOST),
}


@pytest.mark.parametrize("what", FORGED)
def test_a_forged_record_of_containers_is_detected(root: Path, what: str) -> None:
    table, change, kind = FORGED[what]
    forge(root, table, change)
    assert kind in wrong(root)


def rows(root: Path, table: str) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = sierra.open(root).sql(f"SELECT * FROM {table}").to_pylist()
    return found


@pytest.mark.nightly
def test_removing_a_batch_removes_only_images_that_no_other_batch_needs(root: Path, batches: Mapping[str, str]) -> None:
    named = {row["name"]: row for row in rows(root, "images")}
    succeed(root, "rm", batches["reaching"], "--yes")
    assert {row["name"] for row in rows(root, "images")} == {"../old.tar", "../new.tar"}
    assert {row["network"] for row in rows(root, "isolations")} == {"none"}
    succeed(root, "rm", batches["old"], "--yes")
    assert [row["name"] for row in rows(root, "images")] == ["../new.tar"]
    assert [row["version"] for row in rows(root, "isolations")] == ["podman 2, runc 1"]
    kept = {row["sha256"] for row in sierra.open(root).sql("SELECT sha256 FROM objects").to_pylist()}
    assert named["../new.tar"]["files"] in kept
    assert named["../old.tar"]["files"] not in kept
    assert wrong(root) == set()
    succeed(root, "rm", batches["new"], "--yes")
    assert rows(root, "images") == rows(root, "isolations") == []


@pytest.mark.nightly
def test_merged_segments_keep_the_records_of_containers(root: Path) -> None:
    before = {table: sorted(map(str, rows(root, table))) for table in ("images", "isolations")}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sierra.maintenance.gc.MANY", 2)
        assert "9 small segments, merged into 3" in succeed(root, "gc", "--yes")
    assert {table: sorted(map(str, rows(root, table))) for table in before} == before
    assert wrong(root) == set()
