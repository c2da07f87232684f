"""Podman's storage of images: the only place where SIERRA calls podman for an image's sake.

Nothing here ever asks a registry. What podman says of a name is remembered for as long as none of its lists of images has
changed, so that asking again costs no process: a list is replaced, never written over, so its inode and times tell.
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
import tempfile
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, BinaryIO, cast

from sierra.containers.images import oci
from sierra.containers.images.image import Image, Kind, short
from sierra.containers.images.oci import image_of
from sierra.errors import Damaged, Missing
from sierra.store.layout import user_images
from sierra.util.cache import Cache
from sierra.util.signals import noted
from sierra.worker import worker
from sierra.worker.processes import marked

MOST = 512
PATIENCE = 20.0
"""Seconds in which a program that was told to end may tidy up."""
MARK = "SIERRA_BUILD"
"""A variable of the environment by which what a build has started is known."""
RACY_NS = 2 * 10**9
CONFIGURATION = ("storage.conf", "containers.conf")
FOLDERS = ("/usr/share/containers", "/etc/containers")
VARIABLES = ("CONTAINERS_CONF", "CONTAINERS_STORAGE_CONF", "STORAGE_DRIVER", "STORAGE_OPTS", "XDG_DATA_HOME", "HOME")
"""What tells podman where its images are."""
UNKNOWN = ("image not known", "no such image", "no such object", "unable to find a name and tag match")
INSTALL = "podman is not installed (apt-get install podman, dnf install podman); or name the image as a file"


def program() -> str:
    """Podman's path. Raises Missing where it is not installed."""
    found = shutil.which("podman")
    if found is None:
        raise Missing(INSTALL)
    return found


def installed() -> bool:
    return shutil.which("podman") is not None


def driver() -> str:
    """Return what podman stores images by, as `overlay` or `vfs`; empty where it does not say."""
    with contextlib.suppress(Missing, OSError, ValueError):
        return Path(_lists(Cache(user_images(), MOST))[0]).parent.name.removesuffix("-images")
    return ""


def identify(name: str) -> str | None:
    """The id of what a name stands for now: see `look`."""
    found = look(name)
    return None if found is None else found.id


def look(name: str) -> Image | None:
    """What a name (or an id) stands for now; None where podman has no such image. Raises Missing without podman."""
    remembered = Cache(user_images(), MOST)
    state, key = _state(remembered), f"{_where()} {name}"
    known = remembered.get(key)
    if state is not None and isinstance(known, dict) and known.get("state") == state:
        with contextlib.suppress(TypeError, ValueError):
            image = known["image"]
            return None if image is None else Image(**(image | {"kind": Kind(image["kind"]), "layers": tuple(image["layers"])}))
    found = inspect(name)
    image = None if found is None else _image(name, found)
    if state is not None and _state(remembered) == state and not _recent(state):
        remembered.put(key, {"state": state, "image": None if image is None else asdict(image)})
    remembered.save()
    return image


def inspect(name: str) -> dict[str, Any] | None:
    """All that podman says of an image; None where it has none of that name."""
    done = _call(["image", "inspect", "--", name])
    if done.returncode == 0:
        found: dict[str, Any] = json.loads(done.stdout)[0]
        return found
    if any(words in done.stderr for words in UNKNOWN):
        return None
    raise Missing(f"podman cannot look at {name!r}: {complaint(done.stderr)}")


def config(found: Mapping[str, Any]) -> dict[str, Any]:
    """What `inspect` said, as the image's configuration has it."""
    return {
        "architecture": found.get("Architecture") or "",
        "created": found.get("Created"),
        "rootfs": {"diff_ids": list((found.get("RootFS") or {}).get("Layers") or ())},
        "config": found.get("Config") or {},
        "history": found.get("History") or [],
    }


def save(name: str, path: Path) -> None:
    """Write an image as a docker-archive, of which the same image always gives the same bytes."""
    done = _call(["save", "--quiet", "--format", "docker-archive", "--output", str(path), "--", name])
    if done.returncode:
        path.unlink(missing_ok=True)
        raise Missing(f"podman cannot save {name!r} to {path}: {complaint(done.stderr)}")


def load(path: Path, identity: str) -> None:
    """Take in the image of that id, of which an archive or an OCI layout is at `path`. Raises Missing, Damaged.

    Podman does not see the archive: it gets what was checked, and no tags, of which it would move those that it has.
    """
    if not path.exists() or not oci.is_archive(path):
        raise Missing(f"{path} is no archive that podman could load as {short(identity)}; is it for the engine apptainer?")
    read = oci.read(path)
    if read.id != identity:
        raise Damaged(f"{path} is the image {short(read.id)}, not {short(identity)}")
    with tempfile.TemporaryFile("w+") as said:
        process = subprocess.Popen([program(), "load", "--quiet"], stdin=subprocess.PIPE, stdout=said, stderr=said)
        try:
            assert process.stdin is not None  # noqa: S101 - it was asked for
            with contextlib.suppress(BrokenPipeError), process.stdin as pipe:
                read.write(cast("BinaryIO", pipe))
            status = process.wait()
        finally:
            process.kill()
            process.wait()
        said.seek(0)
        if status:
            raise Missing(f"podman cannot load {path}: {complaint(said.read())}")
    if not present(identity):
        raise Damaged(f"{path} is {short(identity)}, but podman made another image of it")


def tag(identity: str, name: str) -> None:
    done = _call(["tag", "--", _bare(identity), name])
    if done.returncode:
        raise Missing(f"podman cannot call {identity} {name!r}: {complaint(done.stderr)}")


def present(identity: str) -> bool:
    """Whether podman has the image of that id."""
    return identify(identity) is not None


def require(image: Image) -> None:
    """Raises Missing where podman does not have the image, as in a clone on another machine."""
    if not present(image.id):
        raise Missing(
            f"the image {image.name} ({short(image.id)}) is not in podman's storage; "
            "build its recipe, or bring it from where it is: sierra image export there, import here"
        )


def holds(identity: str) -> bool:
    """Whether podman is here, works, and has the image of that id."""
    try:
        return installed() and present(identity)
    except Missing:
        return False


def build(context: Path, name: str, *, epoch: int, labels: Mapping[str, str], network: bool = False) -> str:
    """Build a Containerfile, whose folder is the context; the image's id. Nothing is left of a build that fails.

    Times are `epoch`, no cache is used, and nothing says which version of podman it was: the same recipe gives the same id.
    """
    identity = context.with_name(f"{context.name}.id")
    words = [
        *("build", "--pull=never", "--no-cache", "--layers=false", "--force-rm", "--timestamp", str(epoch)),
        *("--identity-label=false", f"--network={'host' if network else 'none'}", *_limits()),
        *(part for label, text in sorted(labels.items()) for part in ("--label", f"{label}={text}")),
        *("--iidfile", str(identity), "--tag", name, "--file", str(context / "Containerfile"), str(context)),
    ]
    try:
        done = run([program(), *words], builds=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
        if done.returncode:
            raise Missing(f"podman cannot build {name}: {complaint(done.stderr)}")
        return "sha256:" + identity.read_text().strip().removeprefix("sha256:")
    finally:
        identity.unlink(missing_ok=True)


def complaint(said: str) -> str:
    """The line in which podman says why, without its prefixes."""
    lines = [line.strip() for line in said.splitlines() if line.strip()]
    errors = [line for line in lines if line.startswith("Error:")]
    why = (errors or lines or ["it said nothing"])[-1].removeprefix("Error:").strip()
    return f"{why} ({lines[-2]})" if why.endswith(("exit status 1", "exit status 2")) and len(lines) > 1 else why


def run(
    command: Sequence[str], *, builds: bool = False, env: Mapping[str, str] | None = None, **more: Any
) -> subprocess.CompletedProcess[str]:
    """Run a program in a process group of its own; all that it has started is ended where this process is interrupted.

    `builds`: it is podman, which would leave running what it builds with. Where that ends first, podman tidies up itself.
    """
    mark = secrets.token_hex(8)
    process = None
    try:
        with noted() as signals:
            process = subprocess.Popen(
                command,
                env={**(os.environ if env is None else env), MARK: mark},
                stdin=subprocess.DEVNULL,
                text=True,
                errors="replace",
                start_new_session=True,
                **more,
            )
        if signals:
            raise KeyboardInterrupt
        out, err = process.communicate()
    except BaseException:
        if process is not None:
            _stop(process, mark, builds=builds)
        raise
    return subprocess.CompletedProcess(command, process.returncode, out, err)


def _stop(process: subprocess.Popen[str], mark: str, *, builds: bool) -> None:
    """End a program and all that it has started: what has left its group or lost its parent is known by the mark."""
    started = _births(_below(process.pid))
    with process:
        if builds and _end(started, process.pid):
            _wait(process)
        _signal(process.pid, signal.SIGTERM)
        _wait(process)
        _signal(process.pid, signal.SIGKILL)
    give_up = time.monotonic() + PATIENCE
    while _end(started | _births(marked({f"{MARK}={mark}".encode()})), process.pid) and time.monotonic() < give_up:
        time.sleep(0.01)


def _wait(process: subprocess.Popen[str]) -> None:
    with contextlib.suppress(subprocess.TimeoutExpired):
        process.wait(PATIENCE)


def _signal(group: int, number: signal.Signals) -> None:
    with contextlib.suppress(ProcessLookupError):
        os.killpg(group, number)


def _end(started: Mapping[int, int | None], group: int) -> bool:
    """Kill those of these processes that are not of the group; whether there were any."""
    others = [pid for pid, born in started.items() if born is not None and _lives(pid, born) and _group(pid) != group]
    for pid in others:
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
    return bool(others)


def _births(pids: Iterable[int]) -> dict[int, int | None]:
    return {pid: worker.birth(pid) for pid in pids}


def _lives(pid: int, born: int) -> bool:
    return worker.birth(pid) == born and worker.stat_of(pid)[:1] not in ([], [b"Z"])


def _group(pid: int) -> int | None:
    try:
        return os.getpgid(pid)
    except ProcessLookupError:
        return None


def _below(pid: int) -> Iterator[int]:
    """All processes that a process has started, where the kernel tells."""
    for path in Path(f"/proc/{pid}/task").glob("*/children"):
        with contextlib.suppress(OSError):
            for child in map(int, path.read_text().split()):
                yield child
                yield from _below(child)


def _call(words: Sequence[str]) -> subprocess.CompletedProcess[str]:
    return run([program(), *words], stdout=subprocess.PIPE, stderr=subprocess.PIPE)


def _limits() -> Iterator[str]:
    """Limits that podman may give what it builds: as root without CAP_SYS_RESOURCE, none over this process's own."""
    for name, number, most in (("nofile", resource.RLIMIT_NOFILE, 1 << 20), ("nproc", resource.RLIMIT_NPROC, 1 << 15)):
        hard = resource.getrlimit(number)[1]
        limit = most if hard == resource.RLIM_INFINITY else min(hard, most)
        yield f"--ulimit={name}={limit}:{limit}"


def _bare(identity: str) -> str:
    return identity.removeprefix("sha256:")


def _image(name: str, found: Mapping[str, Any]) -> Image:
    return image_of(name, f"sha256:{_bare(found['Id'])}", config(found))


# ---------------------------------------------------------------- what podman said, remembered


def _where() -> str:
    """Whose storage it is: all that is asked of the environment for that."""
    return json.dumps([os.getuid(), *(os.environ.get(name, "") for name in VARIABLES)])


def _state(remembered: Cache) -> list[Any] | None:
    """How the lists of images are now; None where it cannot be told."""
    states = [_stat(path) for path in _lists(remembered)]
    return states if states and any(state is not None for state in states) else None


def _recent(state: list[Any]) -> bool:
    """Whether a list was changed so lately that a further change might not show."""
    return any(one is not None and max(one[-2:]) > time.time_ns() - RACY_NS for one in state)


def _lists(remembered: Cache) -> list[str]:
    """Podman's lists of images, its own and those of the stores beside it."""
    around = [program(), *_configuration()]
    state = [_stat(path) for path in around]
    known = remembered.get(_where())
    if isinstance(known, dict) and known.get("state") == state and isinstance(known.get("lists"), list):
        return [str(path) for path in known["lists"]]
    done = _call(["info", "--format", "json"])
    if done.returncode:
        raise Missing(f"podman does not work here: {complaint(done.stderr)}")
    lists = list(_said(json.loads(done.stdout).get("store") or {}))
    remembered.put(_where(), {"state": state, "lists": lists})
    remembered.save()
    return lists


def _said(store: Mapping[str, Any]) -> Iterator[str]:
    driver = store.get("graphDriverName", "overlay")
    others = [other for name, other in (store.get("graphOptions") or {}).items() if name.endswith("imagestore")]
    for root in (
        store.get("graphRoot", ""),
        *(one for other in others for one in ([other] if isinstance(other, str) else other)),
    ):
        yield f"{root}/{driver}-images/images.json"


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
