"""Runs in apptainer: same results and ends as in podman, from the same image."""

from __future__ import annotations

import os
import signal
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests import containers
from tests.integration.containers.test_podman import (
    CHECKPOINT,
    ENDED,
    ENDS,
    HANGS,
    RUN,
    SOCKETS,
    TOLD,
    check_sockets,
    continues,
    ends_after_marker,
    isolated,
    rows,
    says,
    what_is_told,
)
from tests.projects import SIERRA
from tests.waiting import PATIENCE_S, until

pytestmark = pytest.mark.real
ENGINE = 'engine = "apptainer"'


@pytest.fixture(autouse=True)
def apptainer(require: Callable[..., str]) -> str:
    require("busybox-static, as /bin/busybox", there=containers.BUSYBOX.exists())
    require("mksquashfs")
    return require("apptainer")


@pytest.fixture(scope="session")
def busybox(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return containers.busybox(tmp_path_factory.mktemp("busybox"))


@pytest.fixture(scope="session")
def python(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return containers.python(tmp_path_factory.mktemp("python"))


def test_a_batch_of_podman_is_reused_and_replays_identically_in_apptainer(
    tmp_path: Path, busybox: Path, require: Callable[..., str]
) -> None:
    require("podman")
    folder = containers.make(tmp_path / "a project, with 'blanks' and: colons", busybox)
    assert "4 executed" in says(folder, *RUN)
    assert "0 executed, 4 reused" in says(folder, *RUN, "--engine", "apptainer")
    [batch] = rows(folder, "SELECT batch FROM batches")
    assert "identical" in says(folder, "replay", batch["batch"], "--engine", "apptainer")
    engines = rows(folder, "SELECT DISTINCT engine, network FROM isolations ORDER BY engine")
    assert engines == [{"engine": "apptainer", "network": "none"}, {"engine": "podman", "network": "none"}]


@pytest.mark.nightly
def test_a_run_that_was_cut_off_continues_in_apptainer(tmp_path: Path, python: Path) -> None:
    continues(containers.make(tmp_path / "a project, with 'blanks' and: colons", python, ENGINE, command=CHECKPOINT))


@pytest.mark.parametrize("isolation", ["run", pytest.param("worker", marks=pytest.mark.nightly)])
def test_runs_are_isolated_as_in_podman(tmp_path: Path, python: Path, isolation: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SECRET", "s3cret")
    monkeypatch.setenv("APPTAINERENV_SECRET", "s3cret")
    monkeypatch.setenv("APPTAINER_BIND", "/home")
    folder = containers.make(tmp_path / "project", python, ENGINE, f'isolation = "{isolation}"', simulator=TOLD)
    told = what_is_told(folder)
    assert told.pop("folders") in ("2", "3")
    assert told == isolated(isolation)


@pytest.mark.parametrize("isolation", ["run", "worker"])
def test_sockets_can_be_made_in_tmpdir_in_a_project_with_a_long_path(tmp_path: Path, python: Path, isolation: str) -> None:
    check_sockets(containers.make(tmp_path / ("x" * 120), python, ENGINE, f'isolation = "{isolation}"', simulator=SOCKETS))


@pytest.mark.nightly
@pytest.mark.parametrize("isolation", ["run", "worker"])
@pytest.mark.parametrize("memory", ["120 MB", "{120 + population_size} MB"])
def test_all_kinds_of_ends_of_runs_are_distinguished(tmp_path: Path, python: Path, isolation: str, memory: str) -> None:
    mark = f"61.{os.getpid()}"
    simulator = ENDS.replace("{mark}", mark)
    folder = containers.make(tmp_path / "project", python, ENGINE, f'isolation = "{isolation}"', simulator=simulator)
    with (folder / "sierra.toml").open("a") as file:
        file.write(f'[limits]\nwall = 3.0\ngrace = 1.0\nmemory = "{memory}"\n')
    says(folder, "run", "population_size=1,2,3,4,5,6,7,8,9", "--runs", "1", "--no-figures", code=1)
    ended = rows(
        folder, 'SELECT population_size AS n, status, exit_code, "signal" FROM executions JOIN points USING (run) ORDER BY n'
    )
    found = {row["n"]: (row["status"], row["exit_code"], row["signal"]) for row in ended}
    assert found.pop(8)[0] == "memory"
    assert found == ENDED
    assert list(containers.sleepers(mark)) == []


@pytest.fixture
def sleeping(tmp_path: Path, busybox: Path) -> Iterator[tuple[Path, subprocess.Popen[str], str]]:
    """Yield a batch whose two runs sleep in containers, and the mark of their processes."""
    mark = f"63.{os.getpid()}"
    folder = containers.make(tmp_path / "project", busybox, ENGINE, simulator=f"{containers.SIMULATOR}sleep {mark}\n")
    words = [str(SIERRA), "run", "population_size=1", "--no-figures", "-j2"]
    asking = subprocess.Popen(words, cwd=folder, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
    until(lambda: len(list(containers.sleepers(mark))) >= 2 or asking.poll() is not None, "two runs sleep")
    assert asking.poll() is None
    yield folder, asking, mark
    asking.kill()
    asking.communicate()


def of(folder: Path, what: str) -> list[int]:
    """Return the processes of a batch on the host: its worker, or the parents of its containers."""
    found = []
    for process in Path("/proc").glob("[0-9]*"):
        try:
            name, around = (process / "cmdline").read_bytes(), (process / "environ").read_bytes()
        except OSError:
            continue
        parent = name.startswith(b"Apptainer runtime parent") and os.fsencode(folder) in around
        worker = b"worker/__main__.py" in name and os.fsencode(folder) in name
        if parent if what == "clients" else worker:
            found.append(int(process.name))
    return found


@pytest.mark.parametrize(
    "killed", ["sierra", *(pytest.param(one, marks=pytest.mark.nightly) for one in ("clients", "worker", "interrupted"))]
)
def test_no_container_survives_a_kill_of_any_process(sleeping: tuple[Path, subprocess.Popen[str], str], killed: str) -> None:
    folder, asking, mark = sleeping
    if killed in ("sierra", "interrupted"):
        asking.send_signal(signal.SIGKILL if killed == "sierra" else signal.SIGINT)
    else:
        assert of(folder, killed)
        for pid in of(folder, killed):
            os.kill(pid, signal.SIGKILL)
    said, _ = asking.communicate(timeout=PATIENCE_S)
    assert asking.returncode == {"sierra": -9, "worker": 3, "clients": 1, "interrupted": 130}[killed], said
    until(lambda: not list(containers.sleepers(mark)), "nothing is left", PATIENCE_S / 2)
    (folder / "sim.sh").write_text(containers.SIMULATOR)
    assert "2 executed" in says(folder, "run", "population_size=1", "--no-figures")


@pytest.mark.nightly
def test_the_next_run_command_ends_orphaned_containers(sleeping: tuple[Path, subprocess.Popen[str], str]) -> None:
    folder, asking, mark = sleeping
    lost = (asking.pid, *of(folder, "worker"))
    for number in (signal.SIGSTOP, signal.SIGKILL):  # neither process sees the end of the other
        for pid in lost:
            os.kill(pid, number)
    asking.wait()
    assert len(list(containers.sleepers(mark))) >= 2
    (folder / "sim.sh").write_text(containers.SIMULATOR)
    assert "2 executed" in says(folder, "run", "population_size=1", "--no-figures")
    assert list(containers.sleepers(mark)) == []


def test_a_changed_squashfs_is_never_executed(tmp_path: Path, busybox: Path) -> None:
    folder = containers.make(tmp_path / "project", busybox, ENGINE)
    assert "4 executed" in says(folder, *RUN)
    [made] = folder.glob(".sierra/images/*/rootfs.sqfs")
    good = made.read_bytes()
    made.write_bytes(good[:200] + bytes(reversed(good[200:300])) + good[300:])
    (folder / "sim.sh").write_text(containers.SIMULATOR + "true\n")
    assert "4 executed" in says(folder, *RUN)
    assert made.read_bytes() == good


def test_a_sif_is_executed_unchanged_and_refused_after_a_change(tmp_path: Path, busybox: Path) -> None:
    folder = tmp_path / "project"
    folder.mkdir()
    built = ["apptainer", "--silent", "build", str(folder / "sim.sif"), f"docker-archive:{busybox}"]
    done = subprocess.run(built, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    containers.make(folder, "sim.sif", ENGINE)
    assert "4 executed" in says(folder, *RUN)
    [row] = rows(
        folder, "SELECT DISTINCT i.image LIKE 'squashfs:%' AS own, m.kind FROM isolations i JOIN images m USING (image)"
    )
    assert row == {"own": True, "kind": "squashfs"}
    content = bytearray((folder / "sim.sif").read_bytes())
    content[-5000] ^= 1
    (folder / "sim.sif").write_bytes(content)
    assert "sim.sif is not the pinned one" in says(folder, "run", "population_size=3", "--no-figures", code=3)


def test_runs_fail_if_the_file_of_their_image_is_replaced_meanwhile(tmp_path: Path) -> None:
    for word in ("pinned", "other"):
        containers.furnish(tmp_path / word, "sh", "sleep", "cat", "test")
        (tmp_path / word / "etc" / "word").write_text(word)
        subprocess.run(["mksquashfs", tmp_path / word, tmp_path / f"{word}.sqfs", "-quiet", "-no-progress"], check=True)
    image = tmp_path / "pinned.sqfs"
    waits = "while test ! -e /run/sierra/project/go; do sleep 0.05; done; cat /etc/word > word.txt\n"
    folder = containers.make(tmp_path / "project", image, ENGINE, simulator=waits)
    asking = subprocess.Popen([SIERRA, "run", "population_size=1,2", "-j1"], cwd=folder, stdout=subprocess.PIPE, text=True)
    until(lambda: any(one.read_text() for one in folder.glob(".sierra/work/*/journal.jsonl")), "a run has begun")
    (tmp_path / "other.sqfs").rename(image)
    (folder / "go").touch()
    said, _ = asking.communicate(timeout=PATIENCE_S)
    assert asking.returncode == 1, said
    ended = rows(folder, "SELECT status, reason FROM executions")
    assert ended
    assert all(row["status"] == "failed" and "has changed since the runs began" in row["reason"] for row in ended)


@pytest.mark.nightly
def test_variables_of_a_squashfs_come_from_the_image_and_not_from_the_lock(tmp_path: Path) -> None:
    containers.furnish(tmp_path / "root", "sh")
    sets = tmp_path / "root" / ".singularity.d" / "env" / "10-docker2singularity.sh"
    sets.parent.mkdir(parents=True)
    sets.write_text('#!/bin/sh\nexport PATH="/bin"\nexport GRAVITY="9.81"\n')
    subprocess.run(["mksquashfs", tmp_path / "root", tmp_path / "sim.sqfs", "-quiet", "-no-progress"], check=True)
    writes = 'echo tick,gravity > swarm.csv; echo "0,$GRAVITY" >> swarm.csv\n'
    folder = containers.make(tmp_path / "project", tmp_path / "sim.sqfs", ENGINE, simulator=writes)
    lock = folder / "sierra.lock"
    lock.write_text(lock.read_text().replace("9.81", "1.62"))
    for _ in range(2):  # also on the first inspection of the image
        assert "the variables of" in says(folder, *RUN, code=3)
    says(folder, "image", "pin")
    says(folder, *RUN)
    assert rows(folder, "SELECT DISTINCT gravity FROM swarm") == [{"gravity": 9.81}]


@pytest.mark.nightly
def test_mounts_that_an_administrator_configured_are_not_in_the_container(
    tmp_path: Path, busybox: Path, apptainer: str, require: Callable[..., str], monkeypatch: pytest.MonkeyPatch
) -> None:
    require("root", there=os.geteuid() == 0)
    told = subprocess.run([apptainer, "buildcfg"], capture_output=True, text=True, check=True).stdout
    [theirs] = [line.partition("=")[2] for line in told.splitlines() if line.startswith("APPTAINER_CONF_FILE=")]
    ours = tmp_path / "apptainer.conf"
    ours.write_text(Path(theirs).read_text().replace("mount hostfs = no", "mount hostfs = yes"))
    wrapper = tmp_path / "bin" / "apptainer"
    wrapper.parent.mkdir()
    wrapper.write_text(f'#!/bin/sh\ntest "$1" = buildcfg && exec echo "APPTAINER_CONF_FILE={ours}"\nexec {apptainer} "$@"\n')
    wrapper.chmod(0o755)
    monkeypatch.setenv("PATH", f"{wrapper.parent}:{os.environ['PATH']}")
    there = tmp_path / "of-the-host"
    there.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "none", there], check=True)
    try:
        looks = "grep of-the-host /proc/mounts && exit 9\n" + containers.SIMULATOR
        assert "4 executed" in says(containers.make(tmp_path / "project", busybox, ENGINE, simulator=looks), *RUN)
    finally:
        subprocess.run(["umount", there], check=True)


@pytest.mark.nightly
def test_requested_and_enforced_limits_are_recorded(tmp_path: Path, busybox: Path) -> None:
    folder = containers.make(tmp_path / "project", busybox, ENGINE, "cpus = 1.0", "pids = 60")
    said = says(folder, *RUN)
    [row] = rows(folder, "SELECT limits_asked, limits_enforced, rootless FROM isolations")
    assert row["limits_asked"] == '{"cpus": 1.0, "pids": 60}'
    assert ("LIMIT IGNORED" in said) == (row["limits_enforced"] != row["limits_asked"])
    assert row["rootless"] == (os.geteuid() != 0)


@pytest.mark.nightly
@pytest.mark.parametrize("isolation", ["run", pytest.param("worker", marks=pytest.mark.nightly)])
def test_a_run_is_tried_in_its_image(tmp_path: Path, python: Path, isolation: str) -> None:
    talking = "echo hello\n" + containers.SIMULATOR
    folder = containers.make(tmp_path / "project", python, ENGINE, f'isolation = "{isolation}"', simulator=talking)
    said = says(folder, "try", "population_size=2")
    assert said.startswith("hello\n--\nresult  ok\n")
    assert "not observed" in said
    assert rows(folder, "SELECT count(*) AS n FROM executions") == [{"n": 0}]
    assert not (folder / ".sierra" / "try" / "store").exists()


@pytest.mark.each_case
@pytest.mark.parametrize("isolation", ["run", "worker"])
def test_runs_that_hang_after_their_marker_are_ended_and_count(tmp_path: Path, python: Path, isolation: str) -> None:
    ends_after_marker(containers.make(tmp_path / "project", python, ENGINE, f'isolation = "{isolation}"', simulator=HANGS))
