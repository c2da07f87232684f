"""Runs on robots in containers, over real sshd: one image, both engines, and nothing left there."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import tarfile
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from sierra.extensions.robots import results
from tests import containers, images, projects, robots
from tests.support.robot_fleet import SUB_IDS, USER, Fleet
from tests.waiting import until

pytestmark = [pytest.mark.integration, pytest.mark.real]

SIERRA = str(Path(sys.executable).with_name("sierra"))
ENGINES = ("apptainer", "podman")
ROBOT = """\
cat /proc/sys/kernel/hostname; test -e /home/robot && echo sees the host
echo tick,coverage > swarm.csv
for tick in 0 1 2 3; do echo $tick,$((tick * $2)) >> swarm.csv; done
"""
DEAF = """\
trap '' TERM
echo tick,coverage > swarm.csv
setsid sh -c 'trap "" TERM; sleep 300' &
sleep 300; sleep 300
"""
FOLDER = ".cache/sierra-robot"


@pytest.fixture
def root(fleet: Fleet, tmp_path: Path, require: Callable[..., str]) -> Path:
    """Return a project whose runs execute on the fleet in an image with a shell."""
    require("busybox-static, as /bin/busybox", there=containers.BUSYBOX.exists())
    for engine in ENGINES:
        require(engine)
    image = containers.busybox(tmp_path)
    fleets = "".join(f'{name} = {{ host = "{name}" }}\n' for name in fleet.names)
    options = f'stop = ["touch", "stopped"]\ndisk_min = 1000000\nlink_options = {{ ssh_config = "{fleet.ssh_config}" }}\n'
    limits = "grace = 0.5\nlease = 10.0\n"
    more = f'[runners.robots]\n{options}{limits}[runners.robots.fleet]\n{fleets}[targets.robots.container]\nimage = "{image}"\n'
    config = robots.CONFIG.replace('"pretend"', '"robots"').replace("{python} robot.py", "sh robot.sh")
    root = robots.project(tmp_path / "p", more, config)
    (root / "robot.sh").write_text(ROBOT)
    assert projects.quick(root, "image", "pin", str(image)).returncode == 0
    return root


def run(root: Path, engine: str, robots: int = 3) -> subprocess.CompletedProcess[str]:
    query = (f"population_size={robots}", "--runs", "1", "--target", "robots", "--no-figures")
    return projects.quick(root, "run", *query, "--engine", engine)


def left(fleet: Fleet) -> list[str]:
    """Return the processes of runs, of the agents and of engines on all robots; podman's own process for its user may stay."""
    listed = (line for name in fleet.names for line in fleet.commands(name))
    return [line for line in listed if line != "catatonit -P"]


def as_user(fleet: Fleet, name: str, *words: str) -> str:
    done = subprocess.run(["ssh", "-F", fleet.ssh_config, name, *words], capture_output=True, text=True, check=False)
    return done.stdout


def test_both_engines_give_the_same_runs_and_bytes_and_leave_nothing(
    root: Path, fleet: Fleet, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(results, "LATE_S", 1e9)  # how late depends on the machine; a container that was not ready is told too
    first = run(root, "apptainer")
    assert first.returncode == 0, first.stderr
    [image] = (fleet.robots["rb1"].home / FOLDER / "images").glob("*/*")
    again = run(root, "podman")
    assert "1 run: 0 executed, 1 reused" in again.stdout, again.stdout + again.stderr
    [batch] = {row["batch"] for row in projects.sql(root, "SELECT batch FROM sessions")}
    state = image.stat()
    damaged = next((fleet.robots["rb2"].home / FOLDER / "images").glob("*/*"))
    damaged.write_bytes(b"x" * damaged.stat().st_size)
    for engine in ENGINES:
        replayed = projects.quick(root, "replay", batch, "--on", "robots", "--engine", engine)
        assert replayed.returncode == 0, replayed.stdout + replayed.stderr
        damage = f"rb2: /home/robot/{FOLDER}/images/{damaged.parent.name}/{damaged.name} was damaged, and is copied again"
        assert (damage in replayed.stderr) == (engine == "apptainer"), replayed.stderr
    assert image.stat() == state, "it was copied once"
    found = projects.sql(root, 'SELECT engine, version, mode, network, "user" FROM isolations ORDER BY engine')
    assert [(row["engine"], row["version"].split()[0]) for row in found] == [(engine, engine) for engine in ENGINES]
    assert {(row["mode"], row["network"], row["user"]) for row in found} == {("run", "none", "robot")}
    used = projects.sql(
        root, "SELECT DISTINCT i.engine FROM executions JOIN isolations i USING (isolation) WHERE status = 'ok'"
    )
    assert {row["engine"] for row in used} == set(ENGINES)
    late = projects.sql(root, "SELECT reason FROM robots WHERE reason IS NOT NULL")
    assert late == [], "all programs began at the common start"
    shown = projects.quick(root, "show", batch).stdout
    assert "sees the host" not in shown
    assert left(fleet) == []
    for name in fleet.names:
        assert as_user(fleet, name, "podman", "ps", "--all", "--quiet") == ""
        assert list((fleet.robots[name].home / FOLDER / "runs").iterdir()) == []
    assert projects.quick(root, "fsck").returncode == 0
    assert projects.quick(root, "report", batch, "--to", "../report.html").returncode == 0
    page = " ".join(re.sub("<[^>]*>", " ", (root.parent / "report.html").read_text()).split())
    assert re.search(r"Robots of the executions that count .* rb1 .* rb2 .* rb3 .* Container name .* network none", page)
    assert f"apptainer {found[0]['version'].split()[1]}" in page


@pytest.mark.parametrize("engine", ENGINES)
def test_nothing_of_a_container_outlives_its_driver(root: Path, fleet: Fleet, engine: str) -> None:
    (root / "robot.sh").write_text(DEAF)
    query = ("run", "population_size=3", "--runs", "1", "--target", "robots", "--no-figures", "--engine", engine)
    driver = subprocess.Popen(
        [SIERRA, *query], cwd=root, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True
    )
    until(lambda: sum("sleep 300" in line for line in left(fleet)) >= 6, "all have begun")
    os.killpg(driver.pid, signal.SIGKILL)
    driver.wait()
    until(lambda: left(fleet) == [], "all processes are gone")
    for name in fleet.names:
        assert as_user(fleet, name, "podman", "ps", "--all", "--quiet") == ""
        assert (fleet.robots[name].home / "stopped").exists()
    (root / "robot.sh").write_text(ROBOT)
    done = run(root, engine)
    assert done.returncode == 0, done.stderr
    assert "rb1: removed what an earlier run had left" in done.stderr


@pytest.mark.nightly
def test_a_container_of_a_robot_that_was_switched_off_is_removed_by_the_next_run(root: Path, fleet: Fleet) -> None:
    (root / "robot.sh").write_text(DEAF)
    query = ("run", "population_size=1", "--runs", "1", "--target", "robots", "--no-figures", "--engine", "podman")
    with subprocess.Popen([SIERRA, *query], cwd=root, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as driver:
        until(lambda: sum("sleep 300" in line for line in left(fleet)) >= 2, "it has begun", 60)
        fleet.power_cut("rb1")
        driver.wait(60)
    assert driver.returncode == 1
    fleet.boot("rb1")
    assert as_user(fleet, "rb1", "podman", "ps", "--all", "--quiet") != ""
    (root / "robot.sh").write_text(ROBOT)
    done = run(root, "podman", 1)
    assert done.returncode == 0, done.stderr
    assert left(fleet) == []
    assert as_user(fleet, "rb1", "podman", "ps", "--all", "--quiet") == ""


def test_a_robot_without_the_engine_is_named_before_anything_is_copied(root: Path, fleet: Fleet) -> None:
    fleet.robots["rb2"].changed = True
    for program in ("apptainer", "singularity"):
        fleet.enter("rb2", "sh", "-c", f"touch /run/none; mount --bind /run/none $(readlink -f /usr/bin/{program})")
    refused = run(root, "apptainer")
    assert (refused.returncode, refused.stdout) == (3, "")
    assert refused.stderr.splitlines()[-1].startswith("sierra: rb2: neither apptainer nor singularity-ce is installed")
    assert not any((fleet.robots[name].home / FOLDER / "sources").exists() for name in fleet.names)


def test_files_of_several_users_in_an_image_need_a_range_of_ids_on_each_robot(root: Path, fleet: Fleet, tmp_path: Path) -> None:
    shadow = tarfile.TarInfo("etc/shadow")
    shadow.gid = 42
    image = images.docker_archive(tmp_path / "shadow.tar", [images.layer(("bin/", ""), ("bin/sh", "#!"), shadow)])
    config = root / "sierra.toml"
    config.write_text(config.read_text().replace("busybox.tar", "shadow.tar"))
    assert projects.quick(root, "image", "pin", str(image)).returncode == 0
    ranges = [fleet.folder / "etc" / name for name in SUB_IDS]
    before = [path.read_text() for path in ranges]
    try:
        for path in ranges:
            path.write_text("")
        refused = run(root, "podman", 1)
    finally:
        for path, text in zip(ranges, before, strict=True):
            path.write_text(text)
    assert (refused.returncode, refused.stdout) == (3, "")
    assert refused.stderr.splitlines()[-1].startswith(
        f"sierra: rb1: podman cannot load the image {image}: the user has no range of ids in /etc/subuid"
    )


@pytest.fixture
def devices(fleet: Fleet) -> Iterator[Path]:
    """Return a folder of devices that each robot has for itself; its user may use `tty` as a member of a group."""
    folder = Path(f"/dev/sierra-{os.getpid()}")
    group = fleet.folder / "etc" / "group"
    before = group.read_text()
    group.write_text(f"{before}dial:x:5077:{USER}\n")
    folder.mkdir()
    makes = "mknod -m 666 null c 1 3; mknod -m 600 disk c 1 3; mknod -m 660 tty c 1 3; chgrp 5077 tty"
    try:
        for name in fleet.names:
            fleet.robots[name].changed = True
            fleet.enter(name, "sh", "-c", f"mount -t tmpfs -o mode=755 none {folder}; cd {folder}; {makes}")
        yield folder
    finally:
        group.write_text(before)
        folder.rmdir()


def give(root: Path, **keys: object) -> None:
    """Add keys to the table of the robots' containers."""
    config = root / "sierra.toml"
    lines = "".join(f"{name} = {value}\n" for name, value in keys.items())
    config.write_text(config.read_text().replace("[targets.robots.container]\n", f"[targets.robots.container]\n{lines}"))


@pytest.mark.nightly
def test_a_device_that_the_user_cannot_use_is_named_before_anything_is_copied(root: Path, fleet: Fleet, devices: Path) -> None:
    fleet.enter("rb2", "rm", str(devices / "null"))
    before = (root / "sierra.toml").read_text()
    for engine, device, reason in (
        ("apptainer", "null", f"rb2: [container] devices: {devices}/null does not exist there"),
        ("apptainer", "disk", f"[container] devices: {devices}/disk can neither be read nor written there by robot"),
        ("podman", "tty", f"[container] devices: {devices}/tty is open there to robot only by a group, which containers of"),
    ):
        (root / "sierra.toml").write_text(before)
        give(root, devices=f'["{devices}/{device}"]')
        refused = run(root, engine)
        assert (refused.returncode, refused.stdout) == (3, "")
        assert reason in refused.stderr.splitlines()[-1]
    assert not any((fleet.robots[name].home / FOLDER / "sources").exists() for name in fleet.names)


@pytest.mark.nightly
@pytest.mark.parametrize(("engine", "device"), [("apptainer", "tty"), ("podman", "null")])
def test_programs_read_copies_of_mounts_and_use_devices(
    root: Path, fleet: Fleet, devices: Path, tmp_path: Path, engine: str, device: str
) -> None:
    (tmp_path / "maps" / "in").mkdir(parents=True)
    (tmp_path / "maps" / "in" / "a map").write_text("42\n")
    give(root, devices=f'["{devices}/{device}"]', mounts=f'{{ "/maps" = "{tmp_path}/maps" }}')
    write = f"echo 1 > {devices}/{device} && ! touch /maps/new && test $(cat '/maps/in/a map') = 42"
    (root / "robot.sh").write_text(f"{ROBOT}{write}\n")
    done = run(root, engine)
    assert done.returncode == 0, done.stdout + done.stderr
