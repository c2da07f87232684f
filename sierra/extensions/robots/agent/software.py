"""The installed software of a robot: packages of its system, Python distributions, and workspaces that its setup line sources.

This file needs only the standard library (Python 3.8 or newer), and works alone on a robot. It executes no program but git, and
git only in repositories of workspaces in which something has changed since the last look.

Packages are those that dpkg lists as installed. Distributions are those that a Python finds in its folders, and in PYTHONPATH.
Workspaces are the folders in PREFIXES, without those of the system (SYSTEM), whose files belong to packages. A workspace is
described by a SHA-256 over the paths, kinds and contents of its files and of those in `src` beside it, and by the commits of
its repositories. So two workspaces with the same description have the same files.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import re
import site
import stat
import subprocess
import sys
from typing import Dict, Iterator, Mapping, Optional, Tuple

Software = Dict[str, Optional[str]]
Stamp = Tuple[int, ...]

STATUS = "/var/lib/dpkg/status"
METADATA = re.compile(r"(?P<name>.+?)-(?P<version>[^-]+)(?:-py[0-9.]+)?\.(?:dist|egg)-info")
PREFIXES = ("AMENT_PREFIX_PATH", "COLCON_PREFIX_PATH", "CMAKE_PREFIX_PATH", "ROS_PACKAGE_PATH")
SYSTEM = ("/usr", "/opt/ros", "/lib", "/bin", "/sbin")
BUILT = ("devel", "install", "src")
"""The folders of a workspace that variables name."""
LEFT_OUT = (".git", "__pycache__")
MOST_FILES = 20_000
LARGE = 16 << 20  # a larger file counts by its size and time, because hashing it takes too long before a run
GIT_S = 10.0


class Looker:
    """Looks at the software of this host; each file is read again only if it has changed."""

    def __init__(self) -> None:
        self.hashes: dict[str, tuple[Stamp, str]] = {}
        self.packages: tuple[Stamp | None, str | None] = None, None
        self.repositories: dict[tuple[str, str, Stamp | None], str] = {}
        self.last: Software | None = None

    def news(self, environment: Mapping[str, str]) -> Software | None:
        """Return the software for programs with this environment; None if it is what the last call returned."""
        software: Software = {
            "python": "%d.%d.%d" % sys.version_info[:3],
            "distributions": "\n".join(sorted(set(distributions(environment)))),
            "packages": self.installed(),
            "workspaces": self.workspaces(environment),
        }
        if software == self.last:
            return None
        self.last = software
        return software

    def installed(self) -> str | None:
        """Return the packages of dpkg, one name==version a line; None without dpkg."""
        stamp = stamp_of(STATUS)
        if stamp is None:
            return None
        if stamp != self.packages[0]:
            self.packages = stamp, "\n".join(sorted(packages(read(STATUS))))
        return self.packages[1]

    def workspaces(self, environment: Mapping[str, str]) -> str | None:
        """Return the workspaces, one `folder: description` a line; None if there are none."""
        return "\n".join("%s: %s" % (folder, self.described(folder)) for folder in workspaces(environment)) or None

    def described(self, folder: str) -> str:
        """Return the description of a workspace."""
        parts = [folder] if os.path.basename(folder) not in BUILT else beside(folder)
        whole = hashlib.sha256()
        files = [(part, path) for part in parts for path in files_of(part)]
        if len(files) > MOST_FILES:
            return "more than %d files" % MOST_FILES
        for part, path in files:
            name = os.path.basename(part) + path[len(part) :]
            whole.update(os.fsencode("%s\0%s\n" % (name, self.content(path))))
        identity = whole.hexdigest()
        commits = (self.commit(repository, identity) for part in parts for repository in repositories(part))
        return "; ".join(["sha256 " + identity, *sorted(filter(None, commits))])

    def content(self, path: str) -> str:
        """Return the kind and the SHA-256 of a file, or where a link leads."""
        try:
            status = os.lstat(path)
            if stat.S_ISLNK(status.st_mode):
                return "link " + os.readlink(path)
            stamp = status.st_size, status.st_mtime_ns, status.st_ino, status.st_ctime_ns
            if not stat.S_ISREG(status.st_mode) or status.st_size > LARGE:
                return "other %d %d" % stamp[:2]
            known = self.hashes.get(path)
            if known is None or known[0] != stamp:
                known = self.hashes[path] = stamp, hashlib.sha256(read(path)).hexdigest()
        except OSError:
            return "unreadable"
        return ("program " if status.st_mode & 0o100 else "file ") + known[1]

    def commit(self, repository: str, identity: str) -> str:
        """Return the commit of a repository, and whether its files differ from it. `identity`: that of its workspace."""
        key = repository, identity, stamp_of(os.path.join(repository, ".git", "logs", "HEAD"))
        if key not in self.repositories:
            self.repositories[key] = state(repository)
        return self.repositories[key]


def distributions(environment: Mapping[str, str]) -> Iterator[str]:
    """Yield the distributions of Python that programs with this environment can import, as name==version."""
    seen = set()
    for folder in (*environment.get("PYTHONPATH", "").split(os.pathsep), *site.getsitepackages()):
        for name in entries(folder):
            match = METADATA.fullmatch(name)
            distribution = match and re.sub(r"[-_.]+", "-", match.group("name")).lower()
            if match and distribution not in seen:
                seen.add(distribution)
                yield "%s==%s" % (distribution, match.group("version"))


def packages(status: bytes) -> Iterator[str]:
    """Yield the installed packages in a list of dpkg, as name==version."""
    for paragraph in status.decode("utf-8", "replace").split("\n\n"):
        fields = dict(line.partition(": ")[::2] for line in paragraph.splitlines() if line[:1] not in (" ", "\t"))
        if "installed" in fields.get("Status", "").split() and "Version" in fields:
            yield "%s==%s" % (fields["Package"], fields["Version"])


def workspaces(environment: Mapping[str, str]) -> list[str]:
    """Return the folders of workspaces that an environment names, without those below others, and those of the system."""
    named = {os.path.realpath(folder) for name in PREFIXES for folder in environment.get(name, "").split(os.pathsep) if folder}
    own = sorted(folder for folder in named if os.path.isdir(folder) and not any(is_below(folder, other) for other in SYSTEM))
    roots = {os.path.dirname(folder) for folder in own if os.path.basename(folder) in BUILT[:2]}
    kept: list[str] = []
    for folder in own:
        covered = os.path.basename(folder) == BUILT[2] and os.path.dirname(folder) in roots
        if not covered and not any(is_below(folder, other) for other in kept):
            kept.append(folder)
    return kept


def is_below(path: str, folder: str) -> bool:
    return path == folder or path.startswith(folder.rstrip("/") + "/")


def beside(folder: str) -> list[str]:
    """Return a built folder of a workspace, and its sources."""
    sources = os.path.join(os.path.dirname(folder), BUILT[2])
    return sorted({folder, sources}) if os.path.isdir(sources) else [folder]


def files_of(folder: str) -> Iterator[str]:
    """Yield the files and links below a folder, at most one more than are hashed, in the order of their paths."""
    count = 0
    for above, folders, names in os.walk(folder):
        links = [name for name in folders if os.path.islink(os.path.join(above, name))]
        folders[:] = sorted(name for name in folders if name not in LEFT_OUT and name not in links)
        for name in sorted((*names, *links)):
            count += 1
            if count > MOST_FILES + 1:
                return
            if name not in LEFT_OUT and not name.endswith(".pyc"):
                yield os.path.join(above, name)


def repositories(folder: str) -> Iterator[str]:
    """Yield the repositories that contain a folder, or that are in it or in one of its folders."""
    above = folder
    while above != os.path.dirname(above):
        if os.path.lexists(os.path.join(above, ".git")):
            yield above
            break
        above = os.path.dirname(above)
    for name in sorted(entries(folder)):
        inner = os.path.join(folder, name)
        if os.path.lexists(os.path.join(inner, ".git")):
            yield inner


def state(repository: str) -> str:
    """Return the commit of a repository, and whether its files differ from it; empty if git does not tell."""
    commit = git(repository, "rev-parse", "HEAD")
    changes = git(repository, "status", "--porcelain")
    if commit is None or changes is None:
        return ""
    return "%s: commit %s%s" % (os.path.basename(repository), commit.strip(), ", changed" if changes.strip() else "")


def git(repository: str, *words: str) -> str | None:
    """Return the output of git; None if it fails, or if there is no git."""
    with contextlib.suppress(OSError, subprocess.TimeoutExpired):
        done = subprocess.run(
            ["git", "-c", "core.fsmonitor=false", "-C", repository, *words],
            stdin=subprocess.DEVNULL,
            capture_output=True,
            env={**os.environ, "GIT_OPTIONAL_LOCKS": "0"},
            timeout=GIT_S,
        )
        if done.returncode == 0:
            return done.stdout.decode("utf-8", "replace")
    return None


def stamp_of(path: str) -> Stamp | None:
    """Return size, number and both times of a file; None if there is none."""
    try:
        status = os.stat(path)
    except OSError:
        return None
    return status.st_size, status.st_mtime_ns, status.st_ino, status.st_ctime_ns


def read(path: str) -> bytes:
    with open(path, "rb") as file:
        return file.read()


def entries(folder: str) -> list[str]:
    """Return the names in a folder; none if it cannot be read."""
    try:
        return os.listdir(folder or "/nonexistent")
    except OSError:
        return []
