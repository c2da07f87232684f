"""Images by content: archives, layers, SIFs, squashfs are read, checked and pinned; hostile or damaged ones are refused."""

from __future__ import annotations

import gzip
import json
import os
import re
import shutil
import subprocess
import tarfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

import sierra
from sierra.api import Project
from sierra.containers import images
from sierra.containers.images import merge_layers, oci, squashfs_tools
from sierra.containers.images.image_contents import Contents
from sierra.errors import Damaged, Missing, SierraError
from sierra.maintenance import fsck
from sierra.store.layout import StorePaths
from sierra.store.schema import RECORDED
from tests import images as made
from tests import projects
from tests.projects import quick

BASE = made.layer(
    ("bin/", ""),
    ("bin/busybox", "a program"),
    ("bin/sh -> busybox", ""),
    ("etc/", ""),
    ("etc/passwd", "root:x:0:0:root:/root:/bin/sh\n"),
    ("usr/lib/", ""),
    ("lib -> usr/lib", ""),
    ("data/old", "old"),
    ("data/kept", "kept"),
)
TOP = made.layer(("etc/motd", "hello\n"), ("data/.wh.old", ""), ("lib/libm.so", "arithmetic"))


@pytest.fixture
def project(tmp_path: Path) -> Project:
    return sierra.open(projects.make(tmp_path / "a project's"))


def paths(project: Project, name: str) -> dict[str, str]:
    """Return the content of an image: each path with its type."""
    return {path: entry.type for path, entry in project.images.contents(name).files.items()}


def assert_refused(project: Project, name: str, *words: str) -> str:
    """Assert that pinning fails with one line that names the file and the fault, and leaves nothing behind."""
    done = quick(project.root, "image", "pin", name)
    assert done.returncode in (1, 3)
    assert done.stderr.count("\n") == 1
    assert done.stderr.startswith("sierra: ")
    assert name in done.stderr
    for word in words:
        assert word in done.stderr
    assert not (project.root / "sierra.lock").exists()
    assert list((project.root / ".sierra").glob("images/*")) == []
    return done.stderr


# ---------------------------------------------------------------- one image in many forms


def test_image_has_the_same_id_and_content_in_every_archive_format(project: Project, require: Callable[..., str]) -> None:
    require("mksquashfs")
    root = project.root
    made.docker_archive(root / "docker.tar", [BASE, TOP])
    made.oci_archive(root / "oci.tar", [BASE, TOP])
    made.oci_archive(root / "plain.tar", [BASE, TOP], pack=lambda one: one)
    made.oci_archive(root / "pieces.tar", [BASE, TOP], pack=lambda one: gzip.compress(one[:700]) + gzip.compress(one[700:]))
    (root / "layout").mkdir()
    subprocess.run(["tar", "-xf", root / "oci.tar", "-C", root / "layout"], check=True)
    found = {}
    for name in ("docker.tar", "oci.tar", "plain.tar", "pieces.tar", "layout"):
        pinned = project.images.pin(name)
        assert images.pinned(root, name) == pinned.image
        shutil.rmtree(root / ".sierra" / "images")
        read = project.images.contents(name)
        system = images.rootfs(root, StorePaths(root / ".sierra"), read.image)
        found[name] = (read.image.id, read.image.layers, read.listing, made.sha256(system.read_bytes()))
    assert len(set(found.values())) == 1, found
    assert found["oci.tar"][0] == "sha256:" + made.sha256(made.config([BASE, TOP]))


def test_layers_are_merged_as_container_engines_do(project: Project) -> None:
    low = made.layer(
        ("keep", "1"), ("gone", "1"), ("folder/inner", "1"), ("folder/other", "1"), ("file", "1"), ("was/folder", "1"),
        ("links/a", "shared"), ("links/b => links/a", ""), ("links/c => links/b", ""), ("way -> folder", ""),
        made.device("dev/null"),
    )  # fmt: skip
    middle = made.layer(
        (".wh.gone", ""), ("folder/new", "2"), ("folder/.wh..wh..opq", ""), ("file/", ""), ("file/now", "2"), ("was", "2"),
        (".wh.never", ""), ("links/.wh..wh.plnk", ""), ("way/here", "2"), ("own -> folder", ""), ("own/there", "2"),
    )  # fmt: skip
    top = made.layer(("links/a", "another"), ("./gone", "again"))
    made.docker_archive(project.root / "sim.tar", [low, middle, top])
    project.images.pin("sim.tar")
    found = project.images.contents("sim.tar")
    assert {path for path, kind in paths(project, "sim.tar").items() if kind == "file"} == {
        "keep", "gone", "folder/new", "file/now", "was", "links/a", "links/b", "links/c",
        "way/here", "folder/there",
    }  # fmt: skip
    assert found.sha256("/links/a") == made.sha256(b"another")
    assert found.sha256("/links/b") == found.sha256("/links/c") == made.sha256(b"shared")
    assert found.sha256("/gone") == made.sha256(b"again")


@pytest.mark.parametrize("kind", [tarfile.CHRTYPE, tarfile.BLKTYPE])
def test_import_of_images_with_device_files_is_refused(project: Project, kind: bytes) -> None:
    node = made.device("dev/sda")
    node.type = kind
    made.docker_archive(project.root / "sim.tar", [BASE, made.layer(node), made.layer((".wh.dev", ""))])
    done = projects.quick(project.root, "image", "import", str(project.root / "sim.tar"))
    assert (done.returncode, done.stderr.count("\n")) == (1, 1)
    assert "'dev/sda' is a device" in done.stderr
    assert list((project.root / ".sierra").glob("images/*")) == []


def test_squashfs_contains_the_files_of_the_layers(project: Project, require: Callable[..., str]) -> None:
    require("mksquashfs")
    odd = made.layer(("a b/c\\d\"e'", "1"), ("ünï/名", "2"), ("hard => ünï/名", ""), ("x" * 150 + "/y", ""), ("null", ""))
    made.docker_archive(project.root / "sim.tar", [BASE, TOP, odd])
    image = project.images.pin("sim.tar").image
    system = images.rootfs(project.root, StorePaths(project.root / ".sierra"), image)
    entries, _ = squashfs_tools.listing(system)
    there, wanted = {entry.path: entry for entry in entries}, project.images.contents("sim.tar").files
    assert {path: there.get(path) for path in wanted} == wanted
    beyond = {path: there[path].type for path in there.keys() - wanted.keys()}
    assert beyond == dict.fromkeys(("dev", "proc", "run", "sys", "tmp", "var", "var/tmp"), "folder"), "what apptainer mounts on"


@pytest.mark.parametrize("odd", [("var", "a file"), ("var -> usr", ""), ("tmp -> var/tmp", "")], ids=str)
def test_apptainer_mount_points_may_be_files_or_links_in_the_image(
    project: Project, require: Callable[..., str], odd: tuple[str, str]
) -> None:
    require("mksquashfs")
    made.docker_archive(project.root / "sim.tar", [BASE, made.layer(odd)])
    image = project.images.pin("sim.tar").image
    entries, _ = squashfs_tools.listing(images.rootfs(project.root, StorePaths(project.root / ".sierra"), image))
    [kept] = [entry for entry in entries if entry.path == odd[0].partition(" ")[0]]
    assert kept == project.images.contents("sim.tar").files[kept.path]


def test_squashfs_and_sif_made_from_an_image_have_its_id(project: Project, require: Callable[..., str]) -> None:
    require("mksquashfs")
    root, store = project.root, StorePaths(project.root / ".sierra")
    made.docker_archive(root / "sim.tar", [BASE, TOP])
    image = project.images.pin("sim.tar").image
    shutil.copy(images.rootfs(root, store, image), root / "sim.sqfs")
    made.sif(root / "sim.sif", (root / "sim.sqfs").read_bytes())
    assert {project.images.pin(name).image.id for name in ("sim.sqfs", "sim.sif")} == {image.id}
    assert images.rootfs(root, store, images.pinned(root, "sim.sif")) == root / "sim.sif"


def test_damaged_or_missing_squashfs_is_rebuilt(project: Project, require: Callable[..., str]) -> None:
    require("mksquashfs")
    root, store = project.root, StorePaths(project.root / ".sierra")
    made.docker_archive(root / "sim.tar", [BASE])
    image = project.images.pin("sim.tar").image
    system = images.rootfs(root, store, image)
    good = system.read_bytes()
    system.write_bytes(good[:100] + b"x" + good[101:])
    assert images.rootfs(root, store, image).read_bytes() == good
    system.unlink()
    assert images.rootfs(root, store, image).read_bytes() == good


# ---------------------------------------------------------------- content of images


def test_programs_are_found_along_the_path_of_the_image(project: Project) -> None:
    top = made.layer(
        ("opt/bin/tool", "t"), ("opt/notes", "n"), ("bin/loop -> loop", ""), ("bin/up -> ../../../bin/busybox", ""),
        ("bin/away -> /nowhere", ""), ("bin/through -> ../lib/../bin/sh", ""),
    )  # fmt: skip
    configured = made.config([BASE, top], config={"Env": ["PATH=/opt/bin:/bin", "LANG=C", "X=a=b"]})
    made.docker_archive(project.root / "sim.tar", [BASE, top], configured)
    found = project.images.pin("sim.tar")
    assert found.image.variables == {"PATH": "/opt/bin:/bin", "LANG": "C", "X": "a=b"}
    assert found.program("tool") == "/opt/bin/tool"
    assert found.program("sh") == "/bin/sh"
    assert found.sha256("/bin/sh") == made.sha256(b"a program")
    assert found.real("/bin/up") == "/bin/busybox"
    assert found.real("/bin/through") is None, "lib is a link to usr/lib, and there is no usr/bin"
    assert found.program("/bin/up") == "/bin/up"
    assert [found.program(word) for word in ("notes", "loop", "away", "python3", "/opt/notes", "etc")] == [None] * 6
    done = quick(project.root, "image", "show", "sim.tar", "--program", "sh", "--program", "python3", "--json")
    programs = json.loads(done.stdout)["programs"]
    assert programs == {
        "sh": {"path": "/bin/sh", "real": "/bin/busybox", "sha256": made.sha256(b"a program")},
        "python3": None,
    }


def test_packages_of_dpkg_apk_and_python_are_listed(project: Project) -> None:
    installed = "Package: libc6\nStatus: install ok installed\nVersion: 2.36-9\n"
    removed = "Package: old\nStatus: deinstall ok config-files\nVersion: 1\n"
    metadata = "Metadata-Version: 2.1\nName: numpy\nVersion: 2.4.6\n\nName: x\n"
    top = made.layer(
        ("var/lib/dpkg/status", f"{installed}\n{removed}"),
        ("var/lib/dpkg/status.d/base", "Package: base-files\nVersion: 12.4\n"),
        ("var/lib/dpkg/status.d/base.md5sums", "Package: no\nVersion: no\n"),
        ("lib/apk/db/installed", "C:Q1\nP:musl\nV:1.2.4\n\nP:zlib\nV:1.3\n"),
        ("usr/lib/python3/dist-packages/numpy-2.4.6.dist-info/METADATA", metadata),
    )
    made.docker_archive(project.root / "sim.tar", [made.layer(("bin/sh", "")), top])
    assert project.images.pin("sim.tar").packages == {
        "apk": ("musl==1.2.4", "zlib==1.3"),
        "dpkg": ("base-files==12.4", "libc6==2.36-9"),
        "python": ("numpy==2.4.6",),
    }


def test_image_labels_are_shown_without_escape_sequences(project: Project) -> None:
    configured = made.config([BASE], config={"Labels": {"evil": "\x1b[2Jgone"}})
    made.docker_archive(project.root / "sim.tar", [BASE], configured)
    done = quick(project.root, "image", "show", "sim.tar")
    assert done.returncode == 0
    assert "\x1b" not in done.stdout
    assert "evil" in done.stdout


def test_image_survives_conversion_to_a_row_and_back(project: Project) -> None:
    configured = made.config([BASE], config={"Env": ["A=1"], "Labels": {"l": "1"}}, created="2023-11-14T22:13:20Z")
    made.docker_archive(project.root / "sim.tar", [BASE], configured)
    found = project.images.pin("sim.tar")
    row = found.row()
    again = Contents.of_row(row, found.listing)
    assert again.image == replace(found.image, file="", sha256="")
    assert (again.labels, again.packages, again.size, again.listing) == ({"l": "1"}, {}, found.size, found.listing)
    assert again.created == "2023-11-14T22:13:20+00:00"
    assert list(row._fields) == [column.name for column in RECORDED["images"].columns]
    assert row.files == made.sha256(found.listing)


def test_pinned_images_are_neither_stray_for_fsck_nor_garbage_for_gc(project: Project) -> None:
    made.docker_archive(project.root / "sim.tar", [BASE])
    project.images.pin("sim.tar")
    assert fsck.check(StorePaths(project.root / ".sierra"), project.root).report.sound
    assert project.maintenance.collection().nothing


# ---------------------------------------------------------------- hostile and damaged archives


def test_layer_paths_and_links_that_leave_the_image_are_refused(project: Project) -> None:
    for name in ("../../escape", "a/../../escape", "/../escape"):
        made.docker_archive(project.root / "sim.tar", [BASE, made.layer((name, "x"))])
        assert_refused(project, "sim.tar", "layer 2", "leads out of the image")
    for target, words in (("../../../etc/shadow", "leads out of the image"), ("/etc/passwd", "not a file of the same layer")):
        made.docker_archive(project.root / "sim.tar", [BASE, made.layer((f"etc/shadow => {target}", ""))])
        assert_refused(project, "sim.tar", words)


def test_link_loops_and_too_deep_folders_are_refused(project: Project) -> None:
    made.docker_archive(project.root / "sim.tar", [made.layer(("a -> b", ""), ("b -> a", ""), ("a/file", "x"))])
    assert_refused(project, "sim.tar", "more than 40 links")
    made.docker_archive(project.root / "sim.tar", [made.layer(("a/" * 2000 + "file", "x"))])
    assert_refused(project, "sim.tar", "256 folders")


def test_absolute_names_and_links_resolve_within_the_image(project: Project, tmp_path: Path) -> None:
    top = made.layer(
        ("/etc/absolute", "1"),
        ("out -> ../../../../..", ""),
        ("out/through", "2"),
        (f"host -> {tmp_path}", ""),
        ("host/file", "3"),
    )
    made.docker_archive(project.root / "sim.tar", [BASE, top])
    project.images.pin("sim.tar")
    found = paths(project, "sim.tar")
    assert {"etc/absolute", "through"} <= found.keys()
    assert not (tmp_path / "file").exists()


CUTS = (1, 511, 512, 700, 3000, 5000, -1600, -2000, -4000)


@pytest.mark.parametrize("form", ["docker", "oci"])
def test_truncated_archives_are_refused(project: Project, form: str) -> None:
    make: Callable[..., Path] = made.docker_archive if form == "docker" else made.oci_archive
    whole = make(project.root / "sim.tar", [BASE, TOP]).read_bytes()
    for cut in CUTS:
        (project.root / "sim.tar").write_bytes(whole[: cut if cut > 0 else len(whole.rstrip(b"\0")) + cut + 1500])
        assert_refused(project, "sim.tar")


@pytest.mark.parametrize("form", ["docker", "oci"])
def test_archives_with_a_changed_byte_are_refused(project: Project, form: str) -> None:
    make: Callable[..., Path] = made.docker_archive if form == "docker" else made.oci_archive
    plain = {"pack": lambda one: one} if form == "oci" else {}
    whole = make(project.root / "sim.tar", [BASE], **plain).read_bytes()
    for what in (b"a program", b'"architecture"', b"busybox"):
        place = whole.index(what)
        (project.root / "sim.tar").write_bytes(whole[:place] + b"X" + whole[place + 1 :])
        assert_refused(project, "sim.tar")


BAD: dict[str, tuple[Callable[[Path], object], tuple[str, ...]]] = {
    "a layer is not there": (lambda p: made.docker_archive(p, [BASE, TOP], layer1=None), ("layer 2", "is missing")),
    "a blob is not there": (lambda p: made.oci_archive(p, [BASE, TOP], layer0=None), ("layer 1", "is missing")),
    "another layer": (
        lambda p: made.docker_archive(p, [BASE, TOP], layer1=BASE),
        ("layer 2 of 2", "does not match the configuration"),
    ),
    "another blob": (lambda p: made.oci_archive(p, [BASE], layer0=gzip.compress(TOP)), ("layer 1",)),
    "another configuration": (lambda p: made.docker_archive(p, [BASE], config=made.config([TOP])), ("configuration",)),
    "other OCI configuration": (
        lambda p: made.oci_archive(p, [BASE], config=b"x" * len(made.config([BASE]))),
        ("configuration",),
    ),
    "too few layers": (lambda p: made.docker_archive(p, [BASE], made.config([BASE, TOP])), ("2 layers, the manifest 1",)),
    "no manifest": (lambda p: made.docker_archive(p, [BASE], manifest=None), ("not an image",)),
    "two images": (
        lambda p: made.docker_archive(p, [BASE], manifest=b'[{"RepoTags": ["a:1"]}, {"RepoTags": ["b:1"]}]'),
        ("2 images (a:1; b:1)",),
    ),
    "odd tags": (
        lambda p: made.docker_archive(p, [BASE], manifest=b'[{"RepoTags": 5}, {}]'),
        ("2 images (untagged; untagged)",),
    ),
    "no image": (lambda p: made.docker_archive(p, [BASE], manifest=b"[]"), ("contains no image",)),
    "no JSON": (lambda p: made.docker_archive(p, [BASE], manifest=b"[{"), ("manifest.json", "JSON")),
    "deep JSON": (lambda p: made.docker_archive(p, [BASE], manifest=b"[" * 100_000), ("JSON",)),
    "not a list": (lambda p: made.docker_archive(p, [BASE], manifest=b'{"a": 1}'), ("contains no image",)),
    "odd configuration": (lambda p: made.docker_archive(p, [BASE], b'{"rootfs": {"diff_ids": [1]}}'), ("configuration",)),
    "odd variables": (lambda p: made.docker_archive(p, [BASE], made.config([BASE], config={"Env": [1]})), ("configuration",)),
    "a wrong size": (lambda p: made.oci_archive(p, [BASE], said={"size": 1}), ("layer 1", "bytes")),
    "an odd digest": (
        lambda p: made.oci_archive(p, [BASE], said={"digest": "sha256:../../x"}),
        ("layer 1", "SHA-256"),
    ),
    "zstd": (lambda p: made.oci_archive(p, [BASE], pack=lambda one: b"\x28\xb5\x2f\xfd" + one), ("zstd", "gzip")),
    "half a gzip": (lambda p: made.oci_archive(p, [BASE], pack=lambda one: gzip.compress(one)[:-20]), ("layer 1",)),
    "a layer that is no tar": (lambda p: made.docker_archive(p, [b"no tar at all" * 99]), ("layer 1", "tar")),
    "a broken header": (lambda p: made.docker_archive(p, [TOP[:512] + TOP[512:1024] + b"x" * 512 + TOP]), ("broken header",)),
    "a whole gzip": (lambda p: p.write_bytes(gzip.compress(BASE)), ()),
    "no archive": (lambda p: p.write_bytes(b"x" * 5000), ("not an image",)),
    "nothing": (lambda p: p.write_bytes(b""), ("not an image",)),
    "an empty folder": (lambda p: p.mkdir(), ("not an image",)),
    "no file": (lambda p: None, ("image file", "does not exist")),
}


@pytest.mark.parametrize("what", BAD)
def test_malformed_images_are_refused(project: Project, what: str) -> None:
    make, words = BAD[what]
    make(project.root / "sim.tar")
    assert_refused(project, "sim.tar", *words)


@pytest.mark.integration
def test_decompression_bomb_is_refused(project: Project, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(oci, "MIN_BOUND", 1 << 20)
    made.oci_archive(project.root / "sim.tar", [made.layer(("zeros", bytes(64 << 20)))])
    assert_refused(project, "sim.tar", "layer 1", "expands to more than")


def test_oversized_tar_header_is_refused(project: Project) -> None:
    header = tarfile.TarInfo("a")
    header.pax_headers = {"comment": "x" * (20 << 20)}
    made.oci_archive(project.root / "sim.tar", [made.layer(header)])
    assert_refused(project, "sim.tar", "header of")


def test_image_with_too_many_files_is_refused(project: Project, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(merge_layers, "MAX_FILES", 5)
    made.docker_archive(project.root / "sim.tar", [BASE])
    assert_refused(project, "sim.tar", "more than 5 files")


def test_damaged_layers_are_noticed_even_if_the_image_is_already_known(project: Project) -> None:
    made.docker_archive(project.root / "good.tar", [BASE, TOP])
    project.images.pin("good.tar")
    made.docker_archive(project.root / "bad.tar", [BASE, TOP], layer1=BASE)
    with pytest.raises(Damaged, match="layer 2 of 2"):
        project.images.pin("bad.tar")
    assert list(images.all_pinned(project.root)) == ["good.tar"]


# ---------------------------------------------------------------- SIF and squashfs


@pytest.fixture
def system(tmp_path: Path, require: Callable[..., str]) -> bytes:
    """The bytes of a squashfs image."""
    require("mksquashfs")
    tree = tmp_path / "tree"
    (tree / "bin").mkdir(parents=True)
    (tree / "bin" / "tool").write_text("t")
    (tree / "bin" / "tool").chmod(0o755)
    (tree / ".singularity.d" / "env").mkdir(parents=True)
    lines = 'export PATH="${PATH:-"/opt/bin:/bin"}"\nexport A="1"\nexport B="$(id)"\n'
    (tree / ".singularity.d" / "env" / "10-docker2singularity.sh").write_text("#!/bin/sh\n" + lines)
    (tree / ".singularity.d" / "labels.json").write_text('{"maintainer": "a"}')
    subprocess.run(["mksquashfs", tree, tmp_path / "made.sqfs", "-quiet", "-no-progress", "-all-root"], check=True)
    return (tmp_path / "made.sqfs").read_bytes()


def test_sif_is_identified_by_its_file_system(project: Project, system: bytes) -> None:
    found = project.images.pin(made.sif(project.root / "a.sif", system).name)
    assert found.image.id == "squashfs:" + made.sha256(system)
    assert (found.image.architecture, found.image.file) == ("amd64", "a.sif")
    assert found.image.variables == {"PATH": "/opt/bin:/bin", "A": "1"}
    assert found.labels == {"maintainer": "a"}
    assert found.sha256("/bin/tool") == made.sha256(b"t")
    (project.root / "b.sqfs").write_bytes(system)
    assert project.images.pin("b.sqfs").image.id == found.image.id
    assert images.pinned(project.root, "b.sqfs").sha256 != images.pinned(project.root, "a.sif").sha256


def test_damaged_or_unsupported_sif_is_refused(project: Project, system: bytes) -> None:
    whole = made.sif(project.root / "a.sif", system).read_bytes()
    for cut in (40, 100, 200, 20_000, 33_000, -4096, -1):
        (project.root / "a.sif").write_bytes(whole[:cut])
        assert_refused(project, "a.sif")
    for more, words in (
        ({"kind": 5}, "an encrypted squashfs"),
        ({"kind": 2}, "ext3"),
        ({"partitions": 2}, "2 primary file systems"),
        ({"partitions": 0}, "0 primary file systems"),
        ({"overlays": 1}, "has an overlay"),
    ):
        made.sif(project.root / "a.sif", system, **more)
        assert_refused(project, "a.sif", words)
    made.sif(project.root / "a.sif", b"no file system" * 10)
    assert_refused(project, "a.sif", "no squashfs")
    (project.root / "a.sif").write_bytes(whole[:32868] + b"\xff" * 5000 + whole[37868:])
    assert_refused(project, "a.sif")


# ---------------------------------------------------------------- pinning


def test_unpinned_image_is_refused_with_the_command_that_pins_it(project: Project) -> None:
    with pytest.raises(Missing, match=r"^the image 'sim\.tar' is not pinned, .* run: sierra image pin sim\.tar$"):
        images.pinned(project.root, "sim.tar")


def test_unbuilt_recipe_is_refused_with_the_build_command_before_the_pin_command(
    project: Project, monkeypatch: pytest.MonkeyPatch
) -> None:
    recipe = project.root / "containers" / "sim"
    recipe.mkdir(parents=True)
    (recipe / "Containerfile").write_text("FROM scratch\n")
    monkeypatch.setattr("sierra.containers.images.podman_images.find", lambda name: None)
    with pytest.raises(Missing) as raised:
        images.pinned(project.root, "containers/sim")
    build, pin = (str(raised.value).index(f"run: sierra image {verb} containers/sim") for verb in ("build", "pin"))
    assert build < pin


def test_paths_within_the_project_are_pinned_relative_and_others_get_a_note(project: Project) -> None:
    made.docker_archive(project.root / "sim.tar", [BASE])
    for name in (str(project.root / "sim.tar"), "./sim.tar", f"{project.root}/./sim.tar"):
        assert quick(project.root, "image", "pin", name).returncode == 0
    assert list(images.all_pinned(project.root)) == ["sim.tar"]
    there = made.docker_archive(project.root.parent / "there.tar", [TOP])
    said = quick(project.root, "image", "pin", str(there))
    assert f"note: {there} exists only on this machine; " in said.stderr


def test_build_proposes_the_tag_for_recipes_outside_the_project(project: Project, monkeypatch: pytest.MonkeyPatch) -> None:
    for folder in (project.root / "sim", project.root.parent / "other"):
        folder.mkdir()
        (folder / "Containerfile").write_text("FROM scratch\n")
    made.docker_archive(project.root / "sim.tar", [BASE])
    image = images.named(project.root, "sim.tar")
    monkeypatch.setattr("sierra.containers.images.build.build", lambda root, name, network: replace(image, name=name))
    for given, proposed in ((project.root / "sim", "sim"), (project.root.parent / "other", "localhost/sierra/other")):
        said = quick(project.root, "image", "build", str(given)).stdout
        assert said.endswith(f"next: sierra image pin {proposed}\n")


def test_ignored_non_root_user_of_an_image_is_reported(project: Project) -> None:
    for user, told in (("sim", True), ("1000:1000", True), ("root", False), ("0:0", False), ("", False)):
        file = project.root / "sim.tar"
        made.docker_archive(file, [BASE], made.config([BASE], config={"User": user}))
        assert (f"the image's USER {user!r} is ignored" in quick(project.root, "image", "pin", "sim.tar").stderr) == told


def test_lock_file_does_not_depend_on_the_order_of_pins(project: Project) -> None:
    texts = set()
    made.docker_archive(project.root / "a.tar", [BASE])
    made.docker_archive(project.root / "b.tar", [TOP])
    for order in (("a.tar", "b.tar"), ("b.tar", "a.tar", "b.tar")):
        (project.root / "sierra.lock").unlink(missing_ok=True)
        for name in order:
            project.images.pin(name)
        texts.add((project.root / "sierra.lock").read_text())
    assert len(texts) == 1
    assert str(project.root) not in texts.pop()


@pytest.mark.parametrize(
    "text", ["", "{", "[]", '{"format": 2, "images": {}}', '{"format": 1}', '{"format": 1, "images": {"a": {"id": "x"}}}']
)
def test_broken_lock_file_is_reported_in_one_line(project: Project, text: str) -> None:
    (project.root / "sierra.lock").write_text(text)
    done = quick(project.root, "image", "ls")
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert "sierra.lock" in done.stderr


def test_lock_file_with_an_invalid_id_is_refused(project: Project) -> None:
    made.docker_archive(project.root / "a.tar", [BASE])
    project.images.pin("a.tar")
    lock = project.root / "sierra.lock"
    lock.write_text(re.sub(r"sha256:[0-9a-f]{64}", "sha256:../../escape", lock.read_text()))
    with pytest.raises(SierraError, match="broken"):
        images.all_pinned(project.root)


@pytest.mark.integration
def test_changed_image_file_fails_verification_even_with_the_same_time(project: Project) -> None:
    path = made.docker_archive(project.root / "sim.tar", [BASE])
    image = project.images.pin("sim.tar").image
    images.verify(project.root, image)
    before = path.stat()
    path.write_bytes(path.read_bytes().replace(b"a program", b"A PROGRAM"))
    os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))
    with pytest.raises(Missing) as said:
        images.verify(project.root, image)
    assert "sim.tar is not the pinned one" in str(said.value)
    assert image.sha256[:19] in str(said.value)
    assert made.sha256(path.read_bytes())[:19] in str(said.value)
    assert json.loads(quick(project.root, "image", "ls", "--json").stdout)[0]["state"] == "moved"
    path.unlink()
    with pytest.raises(Missing):
        images.verify(project.root, image)


def test_image_for_another_architecture_is_refused(project: Project, system: bytes) -> None:
    other = b"04" if images.machine() == "amd64" else b"02"
    configured = made.config([BASE], architecture="s390x")
    made.docker_archive(project.root / "sim.tar", [BASE], configured)
    made.sif(project.root / "sim.sif", system, architecture=other)
    for name in ("sim.tar", "sim.sif"):
        with pytest.raises(Missing, match=f"is for .*, but this machine is {images.machine()}"):
            images.verify(project.root, project.images.pin(name).image)


def bytes_read() -> int:
    """Return how many bytes this process has read so far, including from caches."""
    [line] = [line for line in Path("/proc/self/io").read_text().splitlines() if line.startswith("rchar:")]
    return int(line.split()[1])


@pytest.mark.nightly
def test_verification_does_not_read_unchanged_image_files_again(project: Project) -> None:
    path = made.docker_archive(project.root / "sim.tar", [made.layer(("big", os.urandom(30_000_000)))])
    os.utime(path)
    time.sleep(2.1)  # recently changed files are read again
    image = project.images.pin("sim.tar").image
    before = bytes_read()
    images.verify(project.root, images.pinned(project.root, "sim.tar"))
    assert bytes_read() - before < 10_000_000
    assert image.id.startswith("sha256:")


def test_tags_need_podman_but_archives_do_not(project: Project, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    done = quick(project.root, "image", "pin", "localhost/sim:1")
    assert (done.returncode, done.stderr.count("\n")) == (3, 1)
    assert "podman is not installed" in done.stderr
    made.docker_archive(project.root / "sim.tar", [BASE])
    assert quick(project.root, "image", "pin", "sim.tar").returncode == 0


def test_full_disk_is_reported_and_no_partial_files_remain(
    disk: Callable[[Path, str], Path], tmp_path: Path, require: Callable[..., str]
) -> None:
    require("mksquashfs")
    small = disk(tmp_path / "small", "1m")
    project = sierra.open(projects.make(small / "p"))
    path = made.docker_archive(tmp_path / "sim.tar", [made.layer(("noise", os.urandom(3_000_000)))])
    image = project.images.pin(str(path)).image
    with pytest.raises(Missing, match="No space left on device") as said:
        images.rootfs(project.root, StorePaths(project.root / ".sierra"), image)
    assert "\n" not in str(said.value)
    left = {one.name for one in (project.root / ".sierra" / "images").rglob("*") if one.is_file()}
    assert left == {"image.json", "files.jsonl"}
    done = quick(project.root, "image", "export", str(path), str(small / "out.tar"))
    assert (done.returncode, done.stderr.count("\n")) == (3, 1)
    assert "No space left on device" in done.stderr
    assert list(small.glob("*out.tar*")) == []


def test_exported_archive_is_verified_and_removed_if_damaged(project: Project, tmp_path: Path) -> None:
    made.docker_archive(project.root / "sim.tar", [BASE, TOP])
    image = project.images.pin("sim.tar").image
    done = quick(project.root, "image", "export", "sim.tar", str(tmp_path / "out.tar"), "--json")
    assert json.loads(done.stdout)["id"] == image.id
    assert oci.read(tmp_path / "out.tar").id == image.id
    made.docker_archive(project.root / "sim.tar", [BASE, TOP], layer0=TOP)
    done = quick(project.root, "image", "export", "sim.tar", str(tmp_path / "again.tar"))
    assert done.returncode == 1
    assert not (tmp_path / "again.tar").exists()


def test_export_to_a_missing_folder_is_refused(project: Project) -> None:
    done = quick(project.root, "image", "export", "localhost/sim:1", "nowhere/sim.tar")
    assert (done.returncode, done.stderr) == (2, "sierra: the folder nowhere for sim.tar does not exist\n")


def test_pin_without_a_name_is_refused_if_the_project_names_no_image(project: Project) -> None:
    done = quick(project.root, "image", "pin")
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert "names no image" in done.stderr
