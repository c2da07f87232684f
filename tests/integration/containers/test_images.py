"""Images with the real programs: repeated builds, transfer between podman storages, moved tags, apptainer builds."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import tarfile
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

import sierra
from sierra.api import Project
from sierra.containers import engines, images
from sierra.containers.images import containerfile_folder as containerfile
from sierra.containers.images import merge_layers, oci, podman_images
from sierra.errors import Missing
from sierra.store.layout import StorePaths
from tests import images as made
from tests import projects
from tests.containers import sleepers
from tests.projects import quick
from tests.waiting import PATIENCE_S, until

pytestmark = pytest.mark.real
RECIPES = Path(__file__).parents[3] / "containers"
LAYERS = [
    made.layer(
        ("bin/tool", "1"), ("bin/link -> tool", ""), ("etc/", ""), ("etc/gone", "1"), ("etc/deep/file", "1"), ("all/one", "1"),
        ("shared/a", "linked"), ("shared/b => shared/a", ""), ("shared/c => shared/b", ""), ("all/two", "1"),
        ("lib -> usr/lib", ""), ("usr/lib/", ""),
    ),
    made.layer(
        ("etc/.wh.gone", ""), ("all/.wh..wh..opq", ""), ("all/three", "2"), ("etc/deep", "now a file"), ("shared/a", "another"),
        ("lib/through", "2"), ("own -> all", ""), ("own/four", "2"),
    ),
]  # fmt: skip


class Storages:
    """Separate storages of podman; one of them is selected at a time."""

    def __init__(self, patch: pytest.MonkeyPatch) -> None:
        self._patch = patch
        self._folder = Path(tempfile.mkdtemp(dir="/tmp"))  # sockets of podman need short paths

    def choose(self, name: str) -> None:
        folder = self._folder / name
        folder.mkdir(exist_ok=True)
        graph, running = folder / "graph", folder / "run"
        text = f'[storage]\ndriver = "overlay"\ngraphroot = "{graph}"\nrunroot = "{running}"\n'
        (folder / "storage.conf").write_text(text)
        self._patch.setenv("CONTAINERS_STORAGE_CONF", str(folder / "storage.conf"))

    def close(self) -> None:
        for graph in self._folder.glob("*/graph/overlay"):
            subprocess.run(["umount", "--lazy", graph], check=False, capture_output=True)
        shutil.rmtree(self._folder, ignore_errors=True)


@pytest.fixture
def storages(monkeypatch: pytest.MonkeyPatch, require: Callable[..., str]) -> Iterator[Storages]:
    """Yield storages; the selected one is new and empty."""
    require("podman")
    found = Storages(monkeypatch)
    found.choose("here")
    works = subprocess.run(["podman", "info"], check=False, capture_output=True).returncode == 0
    require("a podman that works", there=works)
    yield found
    found.close()


@pytest.fixture
def project(tmp_path: Path) -> Project:
    return sierra.open(projects.make(tmp_path / "a project's"))


@pytest.fixture
def busybox(project: Project, storages: Storages, require: Callable[..., str]) -> Project:
    """Return a project with the recipe of busybox; require the programs that build it."""
    require("apt-get")
    shutil.copytree(RECIPES / "busybox", project.root / "containers" / "busybox")
    return project


BUSYBOX = "containers/busybox"


def test_two_builds_give_the_same_image(busybox: Project, storages: Storages) -> None:
    before = os.umask(0o077)
    try:
        shutil.copytree(busybox.root / BUSYBOX, busybox.root / "elsewhere" / "busybox")
        first = busybox.images.build("elsewhere/busybox").id
    finally:
        os.umask(before)
    storages.choose("there")
    done = quick(busybox.root, "image", "build", BUSYBOX)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[0] == f"{first}  {BUSYBOX}, tagged localhost/sierra/busybox"
    found = busybox.images.pin(BUSYBOX)
    assert found.image.id == first
    assert found.program("sh") == "/bin/sh"
    assert found.labels[containerfile.LABEL] == containerfile.identity(busybox.root / BUSYBOX)
    assert "busybox-static" in found.packages["dpkg"][0]
    assert found.recipe.endswith((busybox.root / BUSYBOX / "Containerfile").read_text())


@pytest.mark.nightly
def test_a_recipe_that_changed_since_its_build_is_reported(busybox: Project) -> None:
    with (busybox.root / "sierra.toml").open("a") as file:
        file.write(f'[container]\nimage = "{BUSYBOX}"\n')
    busybox.images.build(BUSYBOX)
    busybox.images.pin(BUSYBOX)
    asking = (busybox.root, "run", "population_size=1", "-n")
    assert "has changed since its image was built" not in quick(*asking).stderr
    with (busybox.root / BUSYBOX / "Containerfile").open("a") as file:
        file.write("LABEL other=1\n")
    assert f"{BUSYBOX} has changed since its image was built" in quick(*asking).stderr


@pytest.mark.nightly
def test_an_exported_image_has_the_same_id_after_import(busybox: Project, storages: Storages, tmp_path: Path) -> None:
    built = busybox.images.build(BUSYBOX)
    busybox.images.pin(BUSYBOX)
    digests = set()
    for name in ("one.tar", "two.tar"):
        assert busybox.images.export(BUSYBOX, tmp_path / name).id == built.id
        digests.add(made.sha256((tmp_path / name).read_bytes()))
    assert len(digests) == 1
    storages.choose("there")
    assert podman_images.identify(built.id) is None
    done = quick(busybox.root, "image", "import", str(tmp_path / "one.tar"), "--name", "localhost/images-copy:1")
    assert done.returncode == 0, done.stderr
    assert podman_images.identify("localhost/images-copy:1") == built.id == podman_images.identify(built.id)
    assert done.stdout.splitlines()[1] == "next: sierra image pin localhost/images-copy:1"
    done = quick(busybox.root, "image", "import", str(tmp_path / "one.tar"))
    assert done.stdout.splitlines()[1] == f"pinned already: {BUSYBOX}"
    images.verify(busybox.root, images.pinned(busybox.root, BUSYBOX))


def test_a_damaged_archive_is_not_imported_into_podman(project: Project, storages: Storages) -> None:
    path = made.docker_archive(project.root / "sim.tar", LAYERS, layer1=LAYERS[0])
    done = quick(project.root, "image", "import", str(path), "--name", "localhost/images-bad:1")
    assert (done.returncode, done.stderr.count("\n")) == (1, 1)
    assert "layer 2 of 2 does not match the configuration" in done.stderr
    assert podman_images.identify("localhost/images-bad:1") is None
    assert list((project.root / ".sierra").glob("images/*")) == []


@pytest.mark.nightly
def test_importing_an_archive_moves_no_tag(project: Project, storages: Storages) -> None:
    tag = "localhost/images-mine:1"
    mine = project.images.import_archive(made.docker_archive(project.root / "mine.tar", LAYERS[:1], tag=tag)).image
    assert (mine.name, podman_images.identify(tag)) == (tag, mine.id)
    other = project.images.import_archive(made.docker_archive(project.root / "other.tar", LAYERS, tag=tag)).image
    assert podman_images.identify(tag) == mine.id
    assert other.name == other.id == podman_images.identify(other.id)
    assert project.images.pin(other.name).image.id == other.id


def test_podman_imports_the_image_that_was_checked(project: Project, storages: Storages) -> None:
    """An archive may contain two images, one for each format; a reader takes the one of the format that it knows."""
    good = made.oci_archive(project.root / "good.tar", LAYERS).read_bytes()
    evil = made.docker_archive(project.root / "evil.tar", LAYERS[:1]).read_bytes()
    (project.root / "both.tar").write_bytes(evil[: len(evil.rstrip(b"\0")) // 512 * 512 + 512] + good)
    image = project.images.import_archive(project.root / "both.tar").image
    assert image.id == oci.read(project.root / "good.tar").id
    listed = subprocess.run(["podman", "images", "--all", "--quiet", "--no-trunc"], check=True, capture_output=True, text=True)
    assert listed.stdout.split() == [image.id]


def test_a_tag_that_moved_is_detected(project: Project, storages: Storages) -> None:
    tag = "localhost/images-moving:1"
    made.docker_archive(project.root / "first.tar", LAYERS[:1])
    made.docker_archive(project.root / "second.tar", LAYERS)
    first = project.images.import_archive(project.root / "first.tar", tag).image.id
    image = project.images.pin(tag).image
    images.verify(project.root, image)
    second = project.images.import_archive(project.root / "second.tar", tag).image.id
    with pytest.raises(Missing, match="has moved") as said:
        images.verify(project.root, image)
    assert images.short(first) in str(said.value)
    assert images.short(second) in str(said.value)
    [known] = [one for one in project.images.known() if one.name == tag]
    assert (known.state, known.id, known.now, known.podman) == ("moved", first, second, True)
    assert project.images.pin(tag).image.id == second
    images.verify(project.root, images.pinned(project.root, tag))


@pytest.mark.nightly
def test_an_image_whose_tag_was_removed_can_be_executed_by_its_id(project: Project, storages: Storages) -> None:
    tag = "localhost/images-gone:1"
    image = project.images.import_archive(made.docker_archive(project.root / "sim.tar", LAYERS), tag).image
    pinned = project.images.pin(tag).image
    podman_images.tag(image.id, "localhost/images-other:1")
    subprocess.run(["podman", "untag", tag, tag], check=True, capture_output=True)
    images.verify(project.root, pinned)
    assert engines.find("podman").prepare(pinned, project.root, StorePaths(project.root / ".sierra")) == image.id
    storages.choose("there")
    with pytest.raises(Missing, match="not in podman's storage"):
        engines.find("podman").prepare(pinned, project.root, StorePaths(project.root / ".sierra"))
    with pytest.raises(Missing, match="not in podman's storage; build it, or run sierra image export"):
        project.images.export(tag, project.root / "copy.tar")
    shutil.rmtree(project.root / ".sierra")
    with pytest.raises(Missing, match=f"{tag} .* is not in podman's storage"):
        images.rootfs(project.root, StorePaths(project.root / ".sierra"), pinned)


@pytest.mark.nightly
def test_a_broken_podman_does_not_affect_commands_without_podman(
    project: Project, storages: Storages, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, require: Callable[..., str]
) -> None:
    require("mksquashfs")
    tag, store = "localhost/images-there:1", StorePaths(project.root / ".sierra")
    project.images.import_archive(made.docker_archive(project.root / "sim.tar", LAYERS), tag)
    image = project.images.pin(tag).image
    system = images.rootfs(project.root, store, image)
    (tmp_path / "broken.conf").write_text("[storage]\ndriver = 1\n")
    monkeypatch.setenv("CONTAINERS_STORAGE_CONF", str(tmp_path / "broken.conf"))
    images.verify(project.root, image)
    assert images.rootfs(project.root, store, image) == system
    [known] = project.images.known()
    assert (known.state, known.podman, known.squashfs) == ("gone", False, True)
    assert "podman" in known.why
    assert "\n" not in known.why


@pytest.mark.nightly
def test_an_archive_is_loaded_for_podman_by_its_content(project: Project, storages: Storages) -> None:
    made.oci_archive(project.root / "sim.tar", LAYERS)
    image, store = project.images.pin("sim.tar").image, StorePaths(project.root / ".sierra")
    assert engines.find("podman").prepare(image, project.root, store) == image.id == podman_images.identify(image.id)
    assert engines.find("podman").prepare(image, project.root, store) == image.id


@pytest.mark.nightly
def test_identifying_an_unchanged_image_does_not_start_podman(
    project: Project, storages: Storages, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tag = "localhost/images-still:1"
    project.images.import_archive(made.docker_archive(project.root / "sim.tar", LAYERS), tag)
    project.images.pin(tag)
    time.sleep(2.1)  # recent changes are queried again
    with monkeypatch.context() as patch:
        patch.setenv("PATH", str(tmp_path))  # no podman is on this path
        images.verify(project.root, images.pinned(project.root, tag))


@pytest.mark.nightly
def test_merged_layers_equal_the_file_system_of_podman(project: Project, storages: Storages, tmp_path: Path) -> None:
    path = made.docker_archive(tmp_path / "sim.tar", LAYERS)
    identity = project.images.import_archive(path).image.id.removeprefix("sha256:")
    made_of_it = subprocess.run(
        ["podman", "create", "--pull=never", "--network=none", identity, "true"], check=True, capture_output=True, text=True
    )
    exported = tmp_path / "podman.tar"
    subprocess.run(["podman", "export", "--output", exported, made_of_it.stdout.strip()], check=True)
    theirs: dict[str, tuple[str, str]] = {}
    with tarfile.open(exported) as tar:
        for member in tar:
            kind = "folder" if member.isdir() else "link" if member.issym() else "file"
            file = tar.extractfile(member) if kind == "file" else None
            theirs[member.name.rstrip("/")] = (kind, made.sha256(file.read()) if file else member.linkname)
    ours = {entry.path: (entry.type, entry.sha256 or entry.target) for entry in merge_layers.merge(oci.read(path)).entries}
    for name in ("dev", "etc/hosts", "etc/hostname", "etc/mtab", "etc/resolv.conf", "proc", "run", "sys", "run/.containerenv"):
        theirs.pop(name, None)
    assert theirs == ours


@pytest.mark.nightly
def test_a_failed_recipe_is_reported_in_one_line_and_leaves_no_files(
    project: Project, storages: Storages, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "temporary").mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "temporary"))
    folder = project.root / "containers" / "sim"
    folder.mkdir(parents=True)
    (folder / "Containerfile").write_text("FROM scratch\nADD rootfs.tar /\n")
    program = folder / "rootfs"
    for script, words in (
        (
            "echo working; echo 'E: Unable to locate package nonsense' >&2; echo done; exit 7",
            "Unable to locate package nonsense",
        ),
        (
            "echo 'dpkg: error processing package debconf (--install):'; echo ' subprocess returned error exit status 127'; "
            "echo 'E: setup failed'; echo 'E: mmdebstrap failed to run'; exit 25",
            "(exit status 25): dpkg: error processing package debconf (--install): subprocess returned error exit status 127",
        ),
        (
            "echo 'sim.c:20:1: error: stray #'; echo '   20 | # x'; echo '      | ^'; exit 1",
            "(exit status 1): sim.c:20:1: error: stray #",
        ),
        ("exit 0", "wrote no tar"),
        ("kill -9 $$", "signal 9"),
        ("echo no tar > $1", "wrote no tar"),
    ):
        program.write_text(f"#!/bin/sh\n{script}\n")
        program.chmod(0o755)
        done = quick(project.root, "image", "build", "containers/sim")
        assert (done.returncode, done.stderr.count("\n")) == (3, 1), done.stderr
        assert words in done.stderr
    program.chmod(0o644)
    done = quick(project.root, "image", "build", "containers/sim")
    assert (done.returncode, done.stderr.count("\n")) == (2, 1), done.stderr
    assert "run: chmod +x containers/sim/rootfs" in done.stderr
    program.unlink()
    (folder / "Containerfile").write_text("FROM localhost/images-nothing:1\n")
    done = quick(project.root, "image", "build", "containers/sim")
    assert (done.returncode, done.stderr.count("\n")) == (3, 1), done.stderr
    assert list((tmp_path / "temporary").iterdir()) == []
    listed = subprocess.run(["podman", "images", "--all", "--quiet"], check=True, capture_output=True, text=True)
    assert listed.stdout == ""


@pytest.mark.nightly
def test_the_record_of_an_image_is_removed_with_its_last_run(busybox: Project) -> None:
    (busybox.root / "sim.sh").write_text('printf "t,v\\n1,2\\n" > "$1/swarm.csv"\n')
    config = projects.CONFIG.replace("python3 sim.py {input}", "sh {project}/sim.sh {output}")
    (busybox.root / "sierra.toml").write_text(f'{config}\n[container]\nimage = "{BUSYBOX}"\n')
    project = sierra.open(busybox.root)
    project.images.build()
    found = project.images.pin()
    batches = [project.run(f"population_size={size}", runs=1, figures=False) for size in (1, 2)]
    assert [one.failed for one in batches] == [0, 0]
    rows = project.sql("SELECT image, octet_length(content) AS size FROM images JOIN objects o ON files = o.sha256")
    assert [row["image"] for row in rows.to_pylist()] == [found.image.id]
    assert rows.to_pylist()[0]["size"] == len(found.listing)
    project.maintenance.collect()
    project.records.remove(batches[0].batch)
    assert project.sql("SELECT count(*) AS n FROM images JOIN objects o ON files = o.sha256").to_pylist() == [{"n": 1}]
    project.records.remove(batches[1].batch)
    assert project.sql("SELECT count(*) AS n FROM images").to_pylist() == [{"n": 0}]
    assert project.sql("SELECT count(*) AS n FROM objects").to_pylist() == [{"n": 0}]


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("rootfs", "containerfile"),
    [("setsid sleep {0}1 & sleep {0}2", "FROM scratch\n"), ("", "FROM localhost/sierra/busybox\nRUN sleep {0}1\n")],
    ids=["rootfs", "RUN"],
)
def test_an_interrupted_build_leaves_no_files_and_containers(
    busybox: Project, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, rootfs: str, containerfile: str
) -> None:
    (tmp_path / "temporary").mkdir()
    monkeypatch.setenv("TMPDIR", str(tmp_path / "temporary"))
    folder = busybox.root / "containers" / "sim"
    folder.mkdir()
    mark = f"864.{os.getpid()}"
    (folder / "Containerfile").write_text(containerfile.format(mark))
    if rootfs:
        (folder / "rootfs").write_text(f"#!/bin/sh\n{rootfs.format(mark)}\n")
        (folder / "rootfs").chmod(0o755)
    else:
        busybox.images.build(BUSYBOX)
    process = subprocess.Popen(
        [projects.SIERRA, "image", "build", "containers/sim"], cwd=busybox.root, stderr=subprocess.PIPE, text=True
    )
    until(lambda: any(sleepers(f"{mark}1")) or process.poll() is not None)
    process.send_signal(signal.SIGINT)
    assert "Traceback" not in process.communicate(timeout=PATIENCE_S)[1]
    assert process.returncode == 130
    assert not any(sleepers(f"{mark}1"))
    assert not any(sleepers(f"{mark}2"))
    assert [path for path in (tmp_path / "temporary").iterdir() if path.name.startswith("sierra-")] == []
    listed = subprocess.run(["podman", "ps", "--all", "--external", "--quiet"], check=True, capture_output=True, text=True)
    assert listed.stdout == ""


@pytest.mark.nightly
def test_a_build_that_is_interrupted_at_its_start_leaves_no_processes(busybox: Project) -> None:
    folder = busybox.root / "containers" / "sim"
    folder.mkdir()
    (folder / "Containerfile").write_text("FROM scratch\n")
    mark = f"864.{os.getpid()}"
    (folder / "rootfs").write_text(f"#!/bin/sh\nkill -INT $PPID\nsetsid sleep {mark}3 &\nsleep {mark}4\n")
    (folder / "rootfs").chmod(0o755)
    assert quick(busybox.root, "image", "build", "containers/sim").returncode == 130
    assert not any(sleepers(f"{mark}3"))
    assert not any(sleepers(f"{mark}4"))


@pytest.mark.nightly
def test_a_full_disk_during_a_build_is_reported(
    project: Project, storages: Storages, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, require: Callable[..., str]
) -> None:
    small = tmp_path / "small"
    small.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=1m", "none", str(small)]
    there = os.geteuid() == 0 and subprocess.run(mount, check=False, capture_output=True).returncode == 0
    require("the right to mount", there=there)
    try:
        monkeypatch.setattr("tempfile.tempdir", str(small))
        folder = project.root / "containers" / "sim"
        folder.mkdir(parents=True)
        (folder / "Containerfile").write_text("FROM scratch\nADD rootfs.tar /\n")
        (folder / "rootfs").write_text('#!/bin/sh\nhead -c 3000000 /dev/urandom > "$1" || { echo giving up; exit 1; }\n')
        (folder / "rootfs").chmod(0o755)
        done = quick(project.root, "image", "build", "containers/sim")
        assert (done.returncode, done.stderr.count("\n")) == (3, 1), done.stderr
        assert "No space left on device" in done.stderr
        assert list(small.iterdir()) == []
    finally:
        subprocess.run(["umount", "-l", str(small)], check=True)


@pytest.mark.nightly
def test_a_rebuilt_sif_of_apptainer_differs_and_is_detected(
    project: Project, tmp_path: Path, require: Callable[..., str]
) -> None:
    apptainer = require("apptainer")
    configured = made.config(LAYERS, config={"Env": ["PATH=/bin", "GREETING=hello there"]})
    path = made.docker_archive(tmp_path / "sim.tar", LAYERS, configured)
    command = [apptainer, "build", "--force", str(project.root / "sim.sif"), f"docker-archive:{path}"]
    subprocess.run(command, check=True, capture_output=True)
    found = project.images.pin("sim.sif")
    assert found.image.id.startswith("squashfs:")
    assert found.image.variables == {"PATH": "/bin", "GREETING": "hello there"}
    assert found.sha256("/bin/link") == made.sha256(b"1")
    assert "docker-archive" in found.recipe
    listed = json.loads(quick(project.root, "image", "show", "sim.sif", "--json").stdout)
    assert listed["architecture"] == images.machine()
    dumped = subprocess.run([apptainer, "sif", "dump", "4", project.root / "sim.sif"], check=True, capture_output=True).stdout
    assert found.image.id == "squashfs:" + made.sha256(dumped)
    images.verify(project.root, found.image)
    time.sleep(1.1)
    subprocess.run(command, check=True, capture_output=True)
    with pytest.raises(Missing, match=r"sim\.sif is not the pinned one"):
        images.verify(project.root, found.image)


@pytest.mark.nightly
def test_the_recipes_of_python_and_of_the_example_can_be_built(
    project: Project, storages: Storages, require: Callable[..., str]
) -> None:
    require("mmdebstrap")
    require("apt-get")
    for name in ("python", "swarm"):
        shutil.copytree(RECIPES / name, project.root / "containers" / name)
    done = quick(project.root, "image", "build", "containers/python", "containers/swarm")
    assert done.returncode == 0, done.stderr
    found = project.images.pin("containers/swarm")
    lock = (RECIPES.parent / "requirements.lock").read_text()
    for name in ("mujoco", "mujoco-core", "numpy"):
        [line] = [line for line in found.packages["python"] if line.startswith(f"{name}==")]
        assert f"\n{line} \\\n" in lock
    assert found.program("python3") == "/usr/bin/python3"


@pytest.mark.nightly
def test_the_image_of_the_example_has_the_locked_requirements() -> None:
    """The recipe must be updated together with `make lock`."""
    lock = set((RECIPES.parent / "requirements.lock").read_text().split())
    assert set((RECIPES / "swarm" / "requirements.txt").read_text().partition("\n")[2].split()) <= lock
