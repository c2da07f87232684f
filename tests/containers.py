"""Images with programs of this machine, made quickly and without a registry, and projects whose runs use them."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from collections.abc import Iterator
from functools import cache
from pathlib import Path

from sierra.containers.images.image import architecture
from tests import images, projects

BUSYBOX = Path("/bin/busybox")
PYTHON = Path("/usr/bin/python3")
FOLDERS = ("tmp/", "run/", "proc/", "sys/", "dev/", "etc/", "home/")
LEFT_OUT = re.compile(r"/(__pycache__|test|idlelib|ensurepip|tkinter|lib2to3|dist-packages|pydoc_data|config-[^/]*)(/|$)")

SIMULATOR = """\
count=$(sed -n 's/.*count="\\([0-9]*\\)".*/\\1/p' "$1")
seed=$(sed -n 's/.*random seed="\\([0-9]*\\)".*/\\1/p' "$1")
echo tick,coverage > swarm.csv
for tick in 0 1 2; do echo $tick,$((count * tick + seed % 100)) >> swarm.csv; done
"""


def busybox(folder: Path, processor: str = "", **variables: str) -> Path:
    """Make an archive of an image with a shell and the usual tools; 2 MB. It says that it is for the processor.

    `variables` are those that the image sets.
    """
    applets = subprocess.run([BUSYBOX, "--list"], capture_output=True, text=True, check=True).stdout.split()
    links = [(f"bin/{name} -> busybox", "") for name in applets if name != "busybox"]
    layer = images.layer(*((name, "") for name in FOLDERS), ("bin/busybox", BUSYBOX.read_bytes()), *links)
    if not processor:
        return images.docker_archive(folder / "busybox.tar", [layer])
    sets = {"Env": [f"{name}={value}" for name, value in variables.items()]}
    configuration = images.config([layer], architecture=architecture(processor), config=sets)
    return images.docker_archive(folder / f"busybox-{processor}.tar", [layer], configuration)


def python(folder: Path) -> Path:
    """Make an archive of an image with the system's Python: its program and its libraries."""
    real = PYTHON.resolve()
    library = Path("/usr/lib") / real.name
    files = [path for path in library.rglob("*") if path.is_file() and not LEFT_OUT.search(str(path))]
    loaded = {path for one in (real, *(file for file in files if file.suffix == ".so")) for path in _loaded(one)}
    members = [(str(path).lstrip("/"), path.read_bytes()) for path in (real, *files, *sorted(loaded))]
    applets = ("sh", "id", "cp", "sleep", "sed", "cat", "env", "true", "setsid", "mv", "ln", "grep")
    shell = [("bin/busybox", BUSYBOX.read_bytes()), *((f"bin/{name} -> busybox", "") for name in applets)]
    return _archive(folder / "python.tar", *members, ("usr/bin/python3 -> " + real.name, ""), *shell)


def furnish(root: Path, *applets: str) -> None:
    """Make a folder the root of an image with these tools of busybox."""
    for name in (*FOLDERS, "bin"):
        (root / name).mkdir(parents=True, exist_ok=True)
    shutil.copy(BUSYBOX, root / "bin" / "busybox")
    for name in applets:
        (root / "bin" / name).symlink_to("busybox")


def host(folder: Path, *programs: Path) -> Path:
    """Make an image with only these programs of the machine, at the same paths, and their libraries."""
    loaded = {path for program in programs for path in _loaded(program.resolve())}
    members = [(str(path).lstrip("/"), path.resolve().read_bytes()) for path in (*programs, *sorted(loaded))]
    return _archive(folder / "host.tar", *members)


def _archive(path: Path, *members: images.Member) -> Path:
    folders = [(name, "") for name in FOLDERS]
    return images.docker_archive(path, [images.layer(*folders, *members)])


@cache
def _loaded(program: Path) -> tuple[Path, ...]:
    told = subprocess.run(["ldd", program], capture_output=True, text=True, check=False).stdout
    return tuple(Path(path) for path in re.findall(r"(/\S+) \(0x", told))


def make(folder: Path, image: Path | str, *more: str, command: str = "sh sim.sh {input}", simulator: str = SIMULATOR) -> Path:
    """Make a project whose runs use a pinned image; `more` are further lines of [container]. Return its folder."""
    config = projects.CONFIG.replace("python3 sim.py {input}", command)
    container = "\n".join(("[container]", f'image = "{image}"', *more))
    projects.make(folder, f"{config}{container}\n")
    (folder / "sim.py").unlink()
    (folder / "sim.sh").write_text(simulator)
    pinned = projects.quick(folder, "image", "pin")
    assert pinned.returncode == 0, pinned.stderr
    return folder


def left(folder: Path) -> list[str]:
    """Return the containers of podman for a project's runs, running or not."""
    listed = subprocess.run(["podman", "ps", "--all", "--quiet"], capture_output=True, text=True, check=True).stdout.split()
    told = subprocess.run(["podman", "container", "inspect", *listed], capture_output=True, text=True, check=False)
    known = json.loads(told.stdout or "[]") if listed else []
    return [one["Id"] for one in known if any(mount.get("Source") == str(folder) for mount in one["Mounts"])]


def sleepers(mark: str) -> Iterator[int]:
    """Yield the processes of this machine, inside and outside containers, with a given argument."""
    for process in Path("/proc").glob("[0-9]*"):
        try:
            if mark.encode() in (process / "cmdline").read_bytes().split(b"\0"):
                yield int(process.name)
        except OSError:
            continue
