"""Capabilities of engines: what works here, what doesn't, and what to do about it."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest

from sierra.containers.engines import apptainer
from sierra.containers.engines.base import Capabilities, ContainerSpec, Process, find
from sierra.containers.images.image import Image, Kind
from sierra.model import Result
from tests.projects import quick

ENDED = Result("", "", "", 0.0, 0.0, 0, None, None, None, None, None, "", 0, ())
LIMITED = frozenset(("memory",))


@dataclass
class Pretended:
    """A folder of fake programs; the PATH contains only them and basic shell tools."""

    folder: Path

    def program(self, name: str, script: str) -> None:
        file = self.folder / name
        file.unlink(missing_ok=True)
        file.write_text(f'#!/bin/sh\necho "{name} $*" >> "{self.folder}/asked"\n{script}\n')
        file.chmod(0o755)

    def asked(self) -> int:
        """Return how many container starts were requested since the last call."""
        log = self.folder / "asked"
        words = log.read_text() if log.exists() else ""
        log.unlink(missing_ok=True)
        return sum(" run " in line or " exec " in line for line in words.splitlines())


@pytest.fixture
def pretended(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Pretended:
    folder = tmp_path / "bin"
    folder.mkdir()
    for name in ("sh", "head", "tail", "cut", "cat", "id", "mkdir"):
        (folder / name).symlink_to(str(shutil.which(name)))
    monkeypatch.setenv("PATH", str(folder))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return Pretended(folder)


def podman(container: str, version: str = "4.9.0") -> str:
    """Return the script of a fake podman that runs the command `container` to start a container."""
    return f"""case "$*" in
--version) echo podman version {version} ;;
*info*) printf 'runc\\nrunc version 1.1\\n\\nconmon version 2.1, commit: x\\ncgroups v2\\n' ;;
*) {container} ;;
esac"""


STARTS = 'while test "$1" != /bin/sh; do shift; done; exec "$@"'
"""Run the command without a container."""


def doctor(folder: Path) -> dict[str, dict[str, str]]:
    return {check["name"]: check for check in json.loads(quick(folder, "doctor", "--json").stdout)}


def test_doctor_lists_missing_engines_with_a_remedy(pretended: Pretended, tmp_path: Path) -> None:
    said = doctor(tmp_path)
    for name in ("podman", "apptainer"):
        assert said[name]["state"] == "absent"
        assert "installed" in said[name]["found"]
        assert said[name]["remedy"]


@pytest.mark.parametrize(("stored", "slow"), [("vfs", True), ("overlay", False)])
def test_doctor_warns_that_podman_is_slow_with_the_vfs_driver(
    pretended: Pretended, tmp_path: Path, stored: str, slow: bool
) -> None:
    store = json.dumps({"store": {"graphDriverName": stored, "graphRoot": "/var/lib/containers"}})
    script = podman(STARTS).replace("*info*)", f"*info*json*) echo '{store}' ;;\n*info*)")
    pretended.program("podman", script)
    check = doctor(tmp_path)["podman"]
    assert check["state"] == "ok"
    assert ("vfs" in check["found"] and "fuse-overlayfs" in check["remedy"]) == slow


@pytest.mark.parametrize(
    ("complaint", "remedy"),
    [
        ("Error: crun: cgroups in hybrid mode not supported, drop all controllers", "install runc"),
        ("Error: crun: setrlimit RLIMIT_NOFILE: Operation not permitted: OCI permission denied", "default_ulimits"),
        ("cannot find UID/GID for user x: no subuid ranges found for user x in /etc/subuid", "usermod --add-subuids"),
        ('Error: exec: "newuidmap": executable file not found in $PATH', "install uidmap"),
        ("Error: netavark: No such file or directory", "install netavark"),
        ("Error: lookup init binary: stat /usr/libexec/podman/catatonit: no such file or directory", "install catatonit"),
        ("cannot clone: Operation not permitted", "kernel.unprivileged_userns_clone"),
        ("Error: write /var/lib/containers: no space left on device", "the disk is full"),
        ("Error: it is a Tuesday", "it is a Tuesday"),
    ],
)
def test_podman_failures_are_reported_in_one_line_with_a_remedy(
    complaint: str, remedy: str, pretended: Pretended, tmp_path: Path
) -> None:
    pretended.program("podman", podman(f"echo '{complaint}' >&2; exit 125"))
    trouble = find("podman").probe().trouble
    assert remedy in trouble
    assert "\n" not in trouble
    check = doctor(tmp_path)["podman"]
    assert check["state"] == "absent"
    assert remedy in check["found"] + check["remedy"]


@pytest.mark.parametrize(("name", "said"), [
    ("podman", "podman version 3.4.4"),
    ("apptainer", "apptainer version 1.0.3"),
    ("singularity", "singularity-ce version 3.8.4"),
    ("singularity", "singularity version 3.7.0"),
])  # fmt: skip
def test_engines_that_are_too_old_are_refused(name: str, said: str, pretended: Pretended) -> None:
    pretended.program(name, f"echo {said}")
    trouble = find("podman" if name == "podman" else "apptainer").probe().trouble
    assert "too old" in trouble
    assert "or newer is needed" in trouble


def test_limits_that_the_engine_ignores_are_not_listed_as_enforced(pretended: Pretended) -> None:
    pretended.program("podman", podman(STARTS))
    able = find("podman").probe()
    assert (able.trouble, able.enforced) == ("", frozenset())
    assert able.version == "podman 4.9.0, runc 1.1, conmon 2.1, cgroups v2"


def test_missing_network_isolation_is_detected_and_shown_by_doctor(pretended: Pretended, tmp_path: Path) -> None:
    if not any(":" in line and "lo:" not in line for line in Path("/proc/net/dev").read_text().splitlines()):
        pytest.skip("needs a network card")
    pretended.program("podman", podman(STARTS))
    assert not find("podman").probe().isolated
    assert "NOT ISOLATED" in doctor(tmp_path)["podman"]["found"]


def test_podman_falls_back_to_another_runtime_if_the_default_fails(pretended: Pretended) -> None:
    pretended.program("podman", podman(f'test "$1" = --runtime=runc || {{ echo "crun: it failed" >&2; exit 1; }}; {STARTS}'))
    assert "crun: it failed" in find("podman").probe().trouble
    pretended.program("runc", "exit 0")
    assert find("podman").probe().trouble == ""


def test_successful_probe_is_cached_until_the_engine_changes(pretended: Pretended, tmp_path: Path) -> None:
    pretended.program("podman", podman(STARTS))
    found = find("podman").probe()
    assert pretended.asked() == 1
    assert json.loads(quick(tmp_path, "doctor", "--json").stdout)
    assert find("podman").probe() == found
    assert pretended.asked() == 0
    pretended.program("podman", podman(STARTS, "4.9.1"))
    assert find("podman").probe().version.startswith("podman 4.9.1")
    assert pretended.asked() == 1


def test_failed_probe_is_not_cached(pretended: Pretended, tmp_path: Path) -> None:
    broken = tmp_path / "broken"
    broken.touch()
    pretended.program("podman", podman(f"test -e {broken} && {{ echo 'Error: not now' >&2; exit 125; }}; {STARTS}"))
    assert "not now" in find("podman").probe().trouble
    broken.unlink()
    assert find("podman").probe().trouble == ""


def test_singularity_ce_is_called_with_its_own_program_and_variable_names(pretended: Pretended) -> None:
    says = 'case "$1" in --version) echo singularity-ce version 4.1.2 ;; buildcfg) ;; *) ' + STARTS + " ;; esac"
    pretended.program("singularity", says)
    assert find("apptainer").probe().version.startswith("singularity-ce 4.1.2")
    box = ContainerSpec(Image("x", "sha256:0", Kind.OCI, "", (), {}), "/image", "session")
    client = find("apptainer").client(box, Process(("true",), {"VALUE": "1,2"}, (), "/"))
    assert client.argv[0] == "singularity"
    assert client.environment["SINGULARITYENV_SIERRA__VALUE"] == "1,2"
    assert not any(name.startswith("APPTAINER") for name in client.environment)


@pytest.mark.parametrize(
    ("complaint", "remedy"),
    [
        ("ERROR  : Could not write info to setgroups: user namespace not permitted", "install apptainer with setuid"),
        ("ERROR  : Requesting capability set 0x1ffffffffff while permitted capability set is 0x0", "default capabilities"),
        ("FATAL:   while starting: it rains", "it rains"),
    ],
)
def test_apptainer_failures_are_reported_in_one_line_with_a_remedy(complaint: str, remedy: str, pretended: Pretended) -> None:
    fails = (
        f"case \"$1\" in --version) echo apptainer version 1.4.5 ;; buildcfg) ;; *) echo '{complaint}' >&2; exit 255 ;; esac"
    )
    pretended.program("apptainer", fails)
    trouble = find("apptainer").probe().trouble
    assert remedy in trouble
    assert "\n" not in trouble


@pytest.mark.nightly
def test_apptainer_works_without_a_writable_cache(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, require: Callable[..., str]
) -> None:
    require("apptainer")
    (tmp_path / "cache").write_text("no folder")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    assert find("apptainer").probe().trouble == ""


def test_missing_temporary_folder_is_reported_by_the_probe(
    pretended: Pretended, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pretended.program("podman", podman(STARTS))
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "nowhere"))
    trouble = find("podman").probe().trouble
    assert "No such file or directory" in trouble
    assert str(tmp_path / "nowhere") in trouble


class TestApptainersEndings:
    """How the exit status of a client is interpreted."""

    @staticmethod
    def of(status: int | None, said: str = "", *, signal: int | None = None, stopped: str | None = None) -> Result:
        result = Result("", "", "", 0.0, 0.0, status, signal, stopped, None, None, None, "", 0, ())
        return find("apptainer").classify(result, said, LIMITED)

    def test_exit_code_255_without_an_engine_error_is_the_exit_code_of_the_program(self) -> None:
        assert self.of(255, "nothing of the engine's").exit_code == 255
        assert self.of(255, "FATAL:   it was\nand then this").error is None

    def test_exit_code_255_after_an_engine_error_is_an_error_of_the_engine(self) -> None:
        for said, told in (
            ('FATAL:   "nosuch": executable file not found in $PATH', "the command cannot be started"),
            ("FATAL:   stat /nosuch/x: no such file or directory", "the command cannot be started"),
            ("FATAL:   permission denied", "the command cannot be started"),
            (
                "FATAL:   While checking container encryption: could not open image /x: no such file",
                "the image cannot be opened",
            ),
            ("FATAL:   container creation failed: of something else", "container creation failed"),
        ):
            result = self.of(255, f"what the program said\n{said}\n")
            assert told in (result.error or "")
            assert result.exit_code is None

    def test_exit_codes_above_128_are_signals_of_the_program(self) -> None:
        assert (self.of(139).exit_code, self.of(139).signal) == (None, 11)
        assert self.of(137).stopped == "memory"
        assert self.of(137, stopped="timeout").stopped == "timeout"

    def test_killed_client_is_an_error_unless_sierra_stopped_it(self) -> None:
        assert "signal 15" in (self.of(None, signal=15).error or "")
        assert self.of(None, signal=9, stopped="timeout").error is None


@pytest.fixture
def squashfs(tmp_path: Path, require: Callable[..., str]) -> Path:
    program = require("mksquashfs")
    (tmp_path / "files" / "bin").mkdir(parents=True)
    (tmp_path / "files" / "bin" / "tool").write_text("right")
    file = tmp_path / "image.sqfs"
    subprocess.run([program, str(tmp_path / "files"), str(file), "-quiet", "-no-progress"], check=True, capture_output=True)
    return file


def test_image_files_are_unpacked_once(squashfs: Path, tmp_path: Path) -> None:
    folder = apptainer.prepare(squashfs, "sha256:1", tmp_path / "made" / "rootfs")
    before = (folder / "bin").stat()
    assert (folder / "bin" / "tool").read_text() == "right"
    assert apptainer.prepare(squashfs, "sha256:1", folder) == folder
    assert (folder / "bin").stat().st_ino == before.st_ino


@pytest.mark.parametrize("change", ["content", "added", "removed", "rights"])
def test_changed_image_files_are_unpacked_again(change: str, squashfs: Path, tmp_path: Path) -> None:
    folder = apptainer.prepare(squashfs, "sha256:1", tmp_path / "made" / "rootfs")
    tool = folder / "bin" / "tool"
    match change:
        case "content":
            times = tool.stat()
            tool.write_text("wrong")
            os.utime(tool, ns=(times.st_atime_ns, times.st_mtime_ns))
        case "added":
            (folder / "bin" / "more").write_text("wrong")
        case "removed":
            tool.unlink()
        case _:
            tool.chmod(0o4777)
    apptainer.prepare(squashfs, "sha256:1", folder)
    assert tool.read_text() == "right"
    assert tool.stat().st_mode & 0o7777 == 0o644
    assert [path.name for path in (folder / "bin").iterdir()] == ["tool"]
    assert sorted(path.name for path in folder.parent.iterdir()) == [".rootfs.lock", "rootfs"]


def test_image_with_another_id_replaces_the_unpacked_files(squashfs: Path, tmp_path: Path) -> None:
    folder = apptainer.prepare(squashfs, "sha256:1", tmp_path / "made" / "rootfs")
    inode = folder.stat().st_ino
    assert apptainer.prepare(squashfs, "sha256:2", folder).stat().st_ino != inode


def test_engine_none_has_no_capabilities() -> None:
    assert find("none").probe() == Capabilities("none")
