"""The part of engines that executes on the host of the containers: it needs Python 3.8 or newer and nothing else there.

On this host, these functions are called. On another one, `sierra.containers.engines.hosts` executes the text of this file: it
reads the line `[function, values…]` of JSON from standard input, and writes the line `{"value": …}` or `{"error": text}`.
"""

from __future__ import annotations

import glob
import hashlib
import json
import os
import pwd
import resource
import shutil
import subprocess
import sys
import tempfile

TYPE_CHECKING = False  # the host needs no types
if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence
    from typing import Any

SHARED = ("usr", "bin", "sbin", "lib", "lib32", "lib64")
"""The folders of the host that its shell needs in a container."""
OWN = ("dev", "etc", "proc", "run", "sys", "tmp", "var")
ROOTS_FOLDERS = "/usr/sbin:/sbin:/usr/local/sbin:/usr/libexec/podman"
"""Folders with programs that only root has on the PATH."""
CHUNK = 1 << 20
ROOT = "\0"
"""The mark that stands for the root of a container in the words of a command."""


def facts() -> dict[str, Any]:
    """Return the facts about this host and this user on which the start of a container depends."""
    return {
        "user": os.geteuid(),
        "machine": os.uname().machine,
        "environment": dict(os.environ),
        "home": os.getcwd(),
        "boot": "".join(text.strip() for _, text in texts(["/proc/sys/kernel/random/boot_id"])),
        "most": {name: most(name) for name in ("NOFILE", "NPROC")},
        "systemd": os.path.exists("/run/systemd/system"),
        "unified": os.path.exists("/sys/fs/cgroup/cgroup.controllers"),
        "mounts": shared(),
    }


def most(name: str) -> int | None:
    """Return the greatest limit that this user may set; None if there is none."""
    _, hard = resource.getrlimit(getattr(resource, "RLIMIT_" + name))
    return None if hard == resource.RLIM_INFINITY else hard


def shared() -> dict[str, str]:
    """Return the mounts with which the host's own shell works in a container: host paths by their path inside."""
    folders = ["/" + name for name in SHARED]
    return {path: path for path in folders if os.path.isdir(path) and not os.path.islink(path)}


def which(program: str) -> str | None:
    return shutil.which(program)


def states(programs: Sequence[str], files: Sequence[str]) -> list[list[Any]]:
    """Return the state of programs, also of those that only root has on the PATH, and of files."""
    found = (shutil.which(program) or shutil.which(program, path=ROOTS_FOLDERS) or program for program in programs)
    return [state(path) for path in (*found, *files)]


def state(path: str) -> list[Any]:
    """Return what the kernel says about a file; only its path if there is none."""
    try:
        status = os.stat(path)
    except OSError:
        return [path]
    return [path, status.st_ino, status.st_size, status.st_mode, status.st_ctime_ns]


def texts(patterns: Sequence[str]) -> list[list[str]]:
    """Return the paths and texts of the files that fit the patterns, in the order of the patterns."""
    contents = []
    for pattern in patterns:
        for path in sorted(glob.glob(pattern)):
            try:
                with open(path, encoding="utf-8", errors="surrogateescape") as file:
                    contents.append([path, file.read()])
            except OSError:
                continue
    return contents


def keep(folder: str, text: str, kind: str) -> str:
    """Return the path of a file with this text, named by the text's hash. Writes it if it does not exist."""
    data = text.encode("utf-8", "surrogateescape")
    path = os.path.join(folder, "%s.%s" % (hashlib.sha256(data).hexdigest()[:16], kind))
    if content(path) != data:
        os.makedirs(folder, mode=0o700, exist_ok=True)
        descriptor, unfinished = tempfile.mkstemp(dir=folder, prefix=".")
        with open(descriptor, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(descriptor)
        os.chmod(unfinished, 0o644)
        os.replace(unfinished, path)
    return path


def content(path: str) -> bytes | None:
    try:
        with open(path, "rb") as file:
            return file.read()
    except OSError:
        return None


def user_name(number: int) -> str:
    try:
        return pwd.getpwuid(number).pw_name
    except KeyError:
        return str(number)


def run(command: Sequence[str], environment: Mapping[str, str] | None, timeout: float | None) -> list[Any]:
    """Return the status, the output and the errors of a command; the status is None if it cannot be started.

    A command that does not end within `timeout` seconds has failed.
    """
    try:
        done = subprocess.run(
            command,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            timeout=timeout,
            env=environment,
            cwd="/",
        )
    except subprocess.TimeoutExpired as error:
        return [1, "", "it did not answer within %.0f s" % error.timeout]
    except OSError as error:
        return [None, "", str(error.strerror)]
    return [done.returncode, done.stdout.decode("utf-8", "replace"), done.stderr.decode("utf-8", "replace")]


def probe(command: Sequence[str], environment: Mapping[str, str] | None, timeout: float, squashed: bool) -> list[Any] | None:
    """Run a command that starts a container from an empty folder with mounts, or from a squashfs of it.

    `ROOT` in the command stands for the path of the folder or the squashfs. Return None if no squashfs can be made here.
    """
    if squashed and shutil.which("mksquashfs") is None:
        return None
    with tempfile.TemporaryDirectory(prefix="sierra-probe-") as folder:
        os.chmod(folder, 0o755)  # noqa: S103 - the user of the container must read it
        root, file = os.path.join(folder, "root"), os.path.join(folder, "root.sqfs")
        make_root(root)
        if squashed:
            run(("mksquashfs", root, file, "-quiet", "-no-progress", "-processors", "1"), None, timeout)
        return run([word.replace(ROOT, file if squashed else root) for word in command], environment, timeout)


def make_root(root: str) -> None:
    """Make the folder of a container's root."""
    os.mkdir(root)
    os.chmod(root, 0o755)  # noqa: S103 - as above
    for name in OWN:
        os.mkdir(os.path.join(root, name))
    for name in SHARED:
        path = "/" + name
        if os.path.islink(path):
            os.symlink(os.readlink(path), os.path.join(root, name))
        elif os.path.isdir(path):
            os.mkdir(os.path.join(root, name))


def hashed(path: str) -> list[Any] | None:
    """Return the SHA-256 of a file, then the values of `state` without the path; None if it cannot be read or is not there."""
    try:
        with open(path, "rb") as file:
            digest = hashlib.sha256()
            for data in iter(lambda: file.read(CHUNK), b""):
                digest.update(data)
        return [digest.hexdigest(), *state(path)[1:]]
    except OSError:
        return None


def unusable(devices: Sequence[str], groups: bool) -> list[str]:
    """Return in words why containers of this user cannot use devices. `groups`: they have the user's groups."""
    return [words for words in (trouble_with(path, groups) for path in devices) if words]


def trouble_with(device: str, groups: bool) -> str:
    """Return why containers of this user cannot use a device; empty if they can. A folder of devices is only looked for."""
    if not os.path.exists(device):
        return "%s does not exist there" % device
    user = os.geteuid()
    if user == 0 or os.path.isdir(device):
        return ""
    if not (os.access(device, os.R_OK) or os.access(device, os.W_OK)):
        return "%s can neither be read nor written there by %s" % (device, user_name(user))
    status = os.stat(device)
    if groups or user == status.st_uid or os.getegid() == status.st_gid or status.st_mode & 0o006:
        return ""
    return "%s is open there to %s only by a group, which containers of this engine do not have" % (device, user_name(user))


def remove(folder: str) -> None:
    """Remove a folder, even if parts of it are read-only."""
    if os.path.islink(folder) or not os.path.isdir(folder):
        return
    for path, _, _ in os.walk(folder):
        try:
            os.chmod(path, 0o700)
        except OSError:
            continue
    shutil.rmtree(folder, ignore_errors=True)


def unpack(squashfs: str, offset: int, folder: str) -> str:
    """Unpack a squashfs to a folder, in the place of what is there; return why that failed, or an empty text."""
    unfinished = os.path.join(os.path.dirname(folder), ".%s.%d" % (os.path.basename(folder), os.getpid()))
    where = ("-offset", str(offset)) if offset else ()
    command = ("unsquashfs", "-no-progress", "-no-xattrs", "-quiet", *where, "-dest", unfinished, squashfs)
    try:
        status, output, errors = run(command, None, None)
        if status is None:
            return "unsquashfs is not installed; it comes with squashfs-tools (apt-get install squashfs-tools)"
        if status:
            return "%s cannot be unpacked: %s" % (
                squashfs,
                ((errors + output).strip().splitlines() or ["it printed no error"])[0],
            )
        remove(folder)
        os.rename(unfinished, folder)
    finally:
        remove(unfinished)
    return ""


def tree_state(folder: str) -> str:
    """Return a hash of the kernel's data about each file below a folder; empty if there is no such folder."""
    if not os.path.isdir(folder):
        return ""
    digest = hashlib.sha256()
    for line in sorted(_lines(folder)):
        digest.update(line)
    return digest.hexdigest()


def _lines(top: str) -> Iterator[bytes]:
    pending = [top]
    while pending:
        folder = pending.pop()
        try:
            entries = os.scandir(folder)
        except PermissionError:
            continue
        with entries:
            for entry in entries:
                status = entry.stat(follow_symlinks=False)
                if entry.is_dir(follow_symlinks=False):
                    pending.append(entry.path)
                state = (status.st_mode, status.st_ino, status.st_size, status.st_mtime_ns, status.st_ctime_ns)
                yield os.fsencode(entry.path) + repr(state).encode() + b"\0"


def main() -> int:
    name, *values = json.loads(sys.stdin.buffer.readline())
    try:
        answer = {"value": globals()[name](*values)}
    except OSError as error:
        answer = {"error": "%s: %s" % (error.filename or name, error.strerror)}
    sys.stdout.write(json.dumps(answer) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
