"""Podman's storage of images. Everything that SIERRA does with images in podman goes through this module.

No registry is ever contacted. Podman's answer about a name is cached until one of its lists of images changes, so that a
repeated question starts no process. Podman replaces a list and never overwrites it, so its inode and times show a change.
"""

from __future__ import annotations

import contextlib
import json
import os
import resource
import secrets
import shutil
import signal
import subprocess
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path

from sierra.containers.images import oci
from sierra.containers.images.image import Image, of_fields, short
from sierra.containers.images.oci import image_of
from sierra.containers.images.streams import fed
from sierra.errors import Damaged, Missing
from sierra.store.layout import user_images
from sierra.util.cache import Cache
from sierra.util.json_types import Json, JsonView, as_object, as_texts
from sierra.util.lazy_definitions import regex
from sierra.util.lazy_logger import Log
from sierra.util.signals import noted
from sierra.worker.processes import birth, marked, signal_group, stat_of

log = Log(__name__)

MAX_ENTRIES = 512
TIMEOUT_S = 20.0
"""The seconds that a program has to clean up after it was told to end."""
MARK = "SIERRA_BUILD"
"""An environment variable that marks the processes that a build has started."""
RACY_NS = 2 * 10**9
CONFIGURATION = ("storage.conf", "containers.conf")
FOLDERS = ("/usr/share/containers", "/etc/containers")
VARIABLES = ("CONTAINERS_CONF", "CONTAINERS_STORAGE_CONF", "STORAGE_DRIVER", "STORAGE_OPTS", "XDG_DATA_HOME", "HOME")
"""The environment variables that decide where podman stores images."""
ARCHIVE = regex(r"\* (docker|oci)-archive: (?!loading index)")
"""The beginning of the line in which podman says why an archive cannot be loaded, after `payload does not match`.

It tries all formats, and has a line for each of them. That of an archive of another kind says that it has no index.
"""
UNKNOWN = ("image not known", "no such image", "no such object", "unable to find a name and tag match")
INSTALL = "podman is not installed (apt-get install podman, dnf install podman); or name the image as a file"


def program() -> str:
    """Return podman's path. Raises Missing if it is not installed."""
    found = shutil.which("podman")
    if found is None:
        raise Missing(INSTALL)
    return found


def installed() -> bool:
    return shutil.which("podman") is not None


def driver() -> str:
    """Return the name of podman's storage driver, for example `overlay` or `vfs`; empty if it is unknown."""
    with contextlib.suppress(Missing, OSError, ValueError):
        return Path(_lists(Cache(user_images(), MAX_ENTRIES))[0]).parent.name.removesuffix("-images")
    return ""


def identify(name: str) -> str | None:
    """Return the id of the image that a name stands for now, or None: see `find`."""
    found = find(name)
    return None if found is None else found.id


def find(name: str) -> Image | None:
    """Return the image that a name or an id stands for now; None if podman has none. Raises Missing without podman."""
    cache = Cache(user_images(), MAX_ENTRIES)
    state, key = _state(cache), f"{_where()} {name}"
    known = as_object(cache.get(key))
    if state is not None and known.get("state") == state:
        with contextlib.suppress(TypeError, ValueError, LookupError):
            recorded = as_object(known["image"])
            return of_fields(str(recorded["name"]), recorded) if known["image"] is not None else None
    image = _inspect(name)
    if state is not None and _state(cache) == state and not _recent(state):
        cache.put(key, {"state": state, "image": None if image is None else asdict(image)})
    cache.save()
    return image


def _inspect(name: str) -> Image | None:
    """Return the image of that name as podman describes it, or None if there is none."""
    done = _call(["image", "inspect", "--", name])
    if done.returncode == 0:
        described = json.loads(done.stdout)[0]
        config: dict[str, Json] = {
            "architecture": described.get("Architecture"),
            "rootfs": {"diff_ids": (described.get("RootFS") or {}).get("Layers")},
            "config": described.get("Config"),
        }
        return image_of(name, "sha256:" + described["Id"].removeprefix("sha256:"), config)
    if any(words in done.stderr for words in UNKNOWN):
        return None
    raise Missing(f"podman cannot inspect {name!r}: {complaint(done.stderr)}")


def save(name: str, path: Path) -> None:
    """Write an image as a docker-archive. The same image always gives the same bytes."""
    done = _call(["save", "--quiet", "--format", "docker-archive", "--output", str(path), "--", name])
    if done.returncode:
        path.unlink(missing_ok=True)
        raise Missing(f"podman cannot save {name!r} to {path}: {complaint(done.stderr)}")


def load(path: Path, identity: str) -> None:
    """Load the image with this id from an archive or an OCI layout at `path`. Raises Missing, Damaged.

    Podman does not get the archive itself, but only the checked data, and no tags, which would move tags that podman has
    already.
    """
    if not path.exists() or not oci.is_archive(path):
        raise Missing(f"{path} is not an archive that podman can load as {short(identity)}; it may be for the engine apptainer")
    read = oci.read(path)
    if read.id != identity:
        raise Damaged(f"{path} is the image {short(read.id)}, not {short(identity)}")
    status, output = fed([program(), "load", "--quiet"], read.write)
    if status:
        raise Missing(f"podman cannot load {path}: {complaint(output)}")
    if not present(identity):
        raise Damaged(f"{path} is {short(identity)}, but podman loaded a different image from it")


def tag(identity: str, name: str) -> None:
    done = _call(["tag", "--", identity.removeprefix("sha256:"), name])
    if done.returncode:
        raise Missing(f"podman cannot tag {identity} as {name!r}: {complaint(done.stderr)}")


def present(identity: str) -> bool:
    """Return whether podman has the image with this id."""
    return identify(identity) is not None


def require(image: Image) -> None:
    """Check that podman has the image. Raises Missing if not, for example in a clone on another machine."""
    if not present(image.id):
        raise Missing(
            f"the image {image.name} ({short(image.id)}) is not in podman's storage; "
            "build it, or run sierra image export where it is and sierra image import here"
        )


def holds(identity: str) -> bool:
    """Return whether podman is installed, works, and has the image with this id."""
    try:
        return installed() and present(identity)
    except Missing:
        return False


def build(context: Path, name: str, *, epoch: int, labels: Mapping[str, str], network: bool = False) -> str:
    """Build a Containerfile, whose folder is the context, and return the image's id. A failed build leaves nothing behind.

    All times are `epoch`, no cache is used, and podman's version is not recorded, so the same folder gives the same id.
    """
    identity = context.with_name(f"{context.name}.id")
    words = [
        *("build", "--pull=never", "--no-cache", "--layers=false", "--force-rm", "--timestamp", str(epoch)),
        *("--identity-label=false", f"--network={'host' if network else 'none'}", *_limits()),
        *(part for label, text in sorted(labels.items()) for part in ("--label", f"{label}={text}")),
        *("--iidfile", str(identity), "--tag", name, "--file", str(context / "Containerfile"), str(context)),
    ]
    try:
        done = run([program(), *words], builds=True)
        if done.returncode:
            raise Missing(f"podman cannot build {name}: {complaint(done.stderr)}")
        return "sha256:" + identity.read_text().strip().removeprefix("sha256:")
    finally:
        identity.unlink(missing_ok=True)


def complaint(output: str) -> str:
    """Return the line in which podman gives the reason of a failure, without its prefixes."""
    lines = [line.strip() for line in output.splitlines() if line.strip()]
    if of_formats := [line for line in lines if ARCHIVE.match(line)]:
        return ARCHIVE.sub("", of_formats[-1])
    errors = [line for line in lines if line.startswith("Error:")]
    why = (errors or lines or ["it printed no error"])[-1].removeprefix("Error:").strip()
    return f"{why} ({lines[-2]})" if why.endswith(("exit status 1", "exit status 2")) and len(lines) > 1 else why


def run(
    command: Sequence[str],
    *,
    builds: bool = False,
    env: Mapping[str, str] | None = None,
    cwd: Path | None = None,
    stderr: int = subprocess.PIPE,
    umask: int = -1,
) -> subprocess.CompletedProcess[str]:
    """Run a program in a process group of its own. If this process is interrupted, all processes that it started are ended.

    `builds`: the program is podman, which leaves its build processes running. If those end first, podman cleans up itself.
    """
    mark = secrets.token_hex(8)
    process = None
    try:
        with noted() as signals:
            process = subprocess.Popen(
                command,
                env={**(os.environ if env is None else env), MARK: mark},
                cwd=cwd,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=stderr,
                text=True,
                errors="replace",
                start_new_session=True,
                umask=umask,
            )
        if signals:
            raise KeyboardInterrupt
        out, err = process.communicate()
    except BaseException:
        if process is not None:
            _stop(process, mark, builds=builds)
        raise
    log.command(command, process.returncode, err or "")
    return subprocess.CompletedProcess(command, process.returncode, out, err)


def _stop(process: subprocess.Popen[str], mark: str, *, builds: bool) -> None:
    """End a program and all processes that it started. The mark identifies those that left its group or lost their parent."""
    started = _births(_below(process.pid))
    with process:
        if builds and _end(started, process.pid):
            _wait(process)
        signal_group(process.pid, signal.SIGTERM)
        _wait(process)
        signal_group(process.pid, signal.SIGKILL)
    give_up = time.monotonic() + TIMEOUT_S
    while _end(started | _births(marked({f"{MARK}={mark}".encode()})), process.pid) and time.monotonic() < give_up:
        time.sleep(0.01)


def _wait(process: subprocess.Popen[str]) -> None:
    with contextlib.suppress(subprocess.TimeoutExpired):
        process.wait(TIMEOUT_S)


def _end(started: Mapping[int, int | None], group: int) -> bool:
    """Kill the processes that are not in the group, and return whether there were any."""
    any_left = False
    for pid, born in started.items():
        with contextlib.suppress(ProcessLookupError):
            lives = born is not None and birth(pid) == born and stat_of(pid)[:1] not in ([], [b"Z"])
            if lives and os.getpgid(pid) != group:
                any_left = True
                os.kill(pid, signal.SIGKILL)
    return any_left


def _births(pids: Iterable[int]) -> dict[int, int | None]:
    return {pid: birth(pid) for pid in pids}


def _below(pid: int) -> Iterator[int]:
    """Yield the ids of all descendants of a process, if the kernel lists them."""
    for path in Path(f"/proc/{pid}/task").glob("*/children"):
        with contextlib.suppress(OSError):
            for child in map(int, path.read_text().split()):
                yield child
                yield from _below(child)


def _call(words: Sequence[str]) -> subprocess.CompletedProcess[str]:
    return run([program(), *words])


def _limits() -> Iterator[str]:
    """Yield the resource limits for a build: not above the limits of this process, since root may lack CAP_SYS_RESOURCE."""
    for name, number, most in (("nofile", resource.RLIMIT_NOFILE, 1 << 20), ("nproc", resource.RLIMIT_NPROC, 1 << 15)):
        hard = resource.getrlimit(number)[1]
        limit = most if hard == resource.RLIM_INFINITY else min(hard, most)
        yield f"--ulimit={name}={limit}:{limit}"


# ---------------------------------------------------------------- the cache of podman's answers


def _where() -> str:
    """Return a key for the storage: the user, and the environment variables that decide where it is."""
    return json.dumps([os.getuid(), *(os.environ.get(name, "") for name in VARIABLES)])


def _state(cache: Cache) -> list[list[int] | None] | None:
    """Return the current state of the lists of images, or None if it is unknown."""
    states = [_stat(path) for path in _lists(cache)]
    return states if any(states) else None


def _recent(state: list[list[int] | None]) -> bool:
    """Return whether a list was changed so recently that a further change might be invisible."""
    return any(one is not None and max(one[-2:]) > time.time_ns() - RACY_NS for one in state)


def _lists(cache: Cache) -> tuple[str, ...]:
    """Return the paths of podman's lists of images: its own, and those of additional stores."""
    state = [_stat(path) for path in (program(), *_configuration())]
    known = as_object(cache.get(_where()))
    if known.get("state") == state and isinstance(known.get("lists"), list):
        return as_texts(known["lists"])
    done = _call(["info", "--format", "json"])
    if done.returncode:
        raise Missing(f"podman does not work here: {complaint(done.stderr)}")
    lists = tuple(_described_lists(as_object(json.loads(done.stdout).get("store"))))
    cache.put(_where(), {"state": state, "lists": lists})
    cache.save()
    return lists


def _described_lists(store: Mapping[str, JsonView]) -> Iterator[str]:
    """Yield the paths of the lists of a storage, which `podman info` describes."""
    driver = store.get("graphDriverName", "overlay")
    others = [other for name, other in as_object(store.get("graphOptions")).items() if name.endswith("imagestore")]
    for folders in (store.get("graphRoot", ""), *others):
        for folder in [folders] if isinstance(folders, str) else as_texts(folders):
            yield f"{folder}/{driver}-images/images.json"


def _configuration() -> Iterator[str]:
    own = os.environ.get("XDG_CONFIG_HOME") or str(Path.home() / ".config")
    yield from (f"{folder}/{name}" for folder in (*FOLDERS, f"{own}/containers") for name in CONFIGURATION)
    yield from filter(None, (os.environ.get("CONTAINERS_CONF"), os.environ.get("CONTAINERS_STORAGE_CONF")))


def _stat(path: str) -> list[int] | None:
    try:
        status = os.stat(path)  # noqa: PTH116 - as quick as can be
    except OSError:
        return None
    return [status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns, status.st_ctime_ns]
