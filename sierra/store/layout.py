"""The names of all files that SIERRA writes.

$XDG_CONFIG_HOME/sierra/config.toml user settings
$XDG_CACHE_HOME/sierra/             caches that can be rebuilt: digests.json, versions.json, images.json,
                                    engines.json, clusters.json, apptainer/
$XDG_STATE_HOME/sierra/             crash reports; the history of the SQL prompt
PROJECT/sierra.toml
PROJECT/sierra.lock                 the images that image names stand for; committed with the project
PROJECT/figures/<batch>/            figures, and in .drawn.json the data that they were drawn from
PROJECT/.sierra/files               hashes of the project's files outside git; rebuilt if it is missing
PROJECT/.sierra/format              the version of the store's format
PROJECT/.sierra/id                  the store's id; see sierra.store.ownership_marks
PROJECT/.sierra/segments/<segment>/ records; see sierra.store.segments
PROJECT/.sierra/work/<session>/     the work of a session; removed once it is recorded
    lock  owner.0  left.0  claims.json  context.json  journal.jsonl  segment/  elsewhere
    <number>/                       one run: input files, stdout, stderr, home/ tmp/ output/; or in the folder that
                                    `elsewhere` names
    anew/                           recorded files, while they are evaluated by changed rules
    source/                         the code, if it is not executed from the project itself
    asking.json  submission.json  worker.py  array_task.py  machine.py  element.json  cancelled  engine/
    elements/<index>.{jobs,failed,alone}  results/<index>.<attempt>.pack
    results/probe.<attempt>.pack  logs/  sent/<number>.json
                                    on a cluster: the submission and its results; see sierra.worker.array_task
PROJECT/.sierra/images/<id>/        the description of an image, and its files as apptainer runs them; rebuilt from the image
    image.json  files.jsonl  rootfs.sqfs  rootfs.<user>/
PROJECT/.sierra/damaged/<segment>/  segments that `sierra fsck --repair` moved out of the way
PROJECT/.sierra/logs/<session>.log  the messages of a session, and <session>.old the earlier ones; see sierra.store.session_log
PROJECT/.sierra/kept/<replay>/      files that `sierra replay --keep` leaves: source/, and each run's folder by its id
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from sierra.util.fs import inside

CONFIG = "sierra.toml"
LOCK = "sierra.lock"
PYPROJECT = "pyproject.toml"
STORE = ".sierra"
WORK = "work"
FIGURES = "figures"
DRAWN = ".drawn.json"

RUN_STDOUT = "stdout"
RUN_STDERR = "stderr"
RUN_HOME = "home"
RUN_TMP = "tmp"
RUN_OUTPUT = "output"


@dataclass(frozen=True, slots=True)
class ProjectPaths:
    """The paths of one project; `root` is an absolute path."""

    root: Path

    @property
    def store(self) -> Path:
        return self.root / STORE

    @property
    def lock(self) -> Path:
        """The file that pins image names to images."""
        return self.root / LOCK

    @property
    def figures(self) -> Path:
        return self.root / FIGURES

    def drawn(self, batch: str) -> Path:
        """Return the file that lists the data of a batch's figures: their names, each with a hash."""
        return inside(self.figures, batch) / DRAWN


@dataclass(frozen=True, slots=True)
class StorePaths:
    """The paths in one store."""

    MARK: ClassVar[str] = "mark"
    """The name of the file that shows that SIERRA made a folder; see `sierra.store.ownership_marks`."""
    NAMES: ClassVar[frozenset[str]] = frozenset(
        (
            ".gitignore",
            "CACHEDIR.TAG",
            "damaged",
            "files",
            "format",
            "id",
            "images",
            "kept",
            "logs",
            "numbers",
            "segments",
            "work",
        )
    )
    """The names of all entries of a store."""
    root: Path

    @property
    def format(self) -> Path:
        return self.root / "format"

    @property
    def gitignore(self) -> Path:
        return self.root / ".gitignore"

    @property
    def cachedir_tag(self) -> Path:
        return self.root / "CACHEDIR.TAG"

    @property
    def segments(self) -> Path:
        return self.root / "segments"

    @property
    def work(self) -> Path:
        return self.root / WORK

    @property
    def files(self) -> Path:
        """The cache of hashes of the project's files outside git, which avoids reading all of them again; may be deleted."""
        return self.root / "files"

    @property
    def numbers(self) -> Path:
        """The cache of the known segments' highest Lamport number, which avoids reading all of them again; may be deleted."""
        return self.root / "numbers"

    @property
    def images(self) -> Path:
        """The folder of image descriptions and of images for apptainer; all of it can be rebuilt."""
        return self.root / "images"

    def image(self, folder: str) -> ImagePaths:
        return ImagePaths(inside(self.images, folder))

    @property
    def identity(self) -> Path:
        """The file with the store's id."""
        return self.root / "id"

    @property
    def work_mark(self) -> Path:
        return self.work / self.MARK

    @property
    def work_lock(self) -> Path:
        return self.work / "lock"

    @property
    def reading(self) -> Path:
        """The file that readers lock in shared mode. It always exists, and readers never write it."""
        return self.format

    @property
    def damaged(self) -> Path:
        """The folder to which `sierra fsck --repair` moves damaged segments."""
        return self.root / "damaged"

    def kept(self, replay: str) -> Path:
        """Return the folder of the files that `sierra replay --keep` leaves."""
        return inside(self.root / "kept", replay)

    @property
    def logs(self) -> Path:
        """The folder of the sessions' log files; may be deleted."""
        return self.root / "logs"

    def log(self, session: str) -> Path:
        return self.logs / f"{session}.log"

    def session(self, session: str) -> SessionPaths:
        return SessionPaths(self.work / session)


@dataclass(frozen=True, slots=True)
class ImagePaths:
    """The paths of the description and the files of one image."""

    root: Path

    @property
    def description(self) -> Path:
        return self.root / "image.json"

    @property
    def files(self) -> Path:
        """The list of the image's files."""
        return self.root / "files.jsonl"

    @property
    def rootfs(self) -> Path:
        """The image's files as a squashfs."""
        return self.root / "rootfs.sqfs"

    def sandbox(self, user: int) -> Path:
        """Return the folder of the image's files for a user who can't mount a squashfs."""
        return self.root / f"rootfs.{user}"


@dataclass(frozen=True, slots=True)
class SessionPaths:
    """The paths of the work of one session."""

    root: Path
    elsewhere: Path | None = None
    """The folder where the session's runs execute, if it is not `root`."""

    @property
    def runs(self) -> Path:
        """The folder that contains a folder for each run."""
        return self.elsewhere or self.root

    @property
    def elsewhere_file(self) -> Path:
        """The file that names the folder where runs execute, if it is not `root`."""
        return self.root / "elsewhere"

    @property
    def lock(self) -> Path:
        return self.root / "lock"

    def owner(self, generation: int) -> Path:
        return self.root / f"owner.{generation}"

    def left(self, generation: int) -> Path:
        """Return the file that exists once that owner has detached from its submission, on a file system without locks."""
        return self.root / f"left.{generation}"

    @property
    def number(self) -> Path:
        """The file with the session's Lamport number."""
        return self.root / "number"

    @property
    def claims(self) -> Path:
        return self.root / "claims.json"

    @property
    def context(self) -> Path:
        return self.root / "context.json"

    @property
    def source(self) -> Path:
        """The folder of the restored source during a replay."""
        return self.root / "source"

    @property
    def segment(self) -> Path:
        return self.root / "segment"

    @property
    def anew(self) -> Path:
        """The folder of recorded files while executions are evaluated by changed rules."""
        return self.root / "anew"

    @property
    def asking(self) -> Path:
        """The data to record about a session whose process may be gone when it ends."""
        return self.root / "asking.json"

    @property
    def submission(self) -> Path:
        """The cluster submission. A session with this file lives without a process."""
        return self.root / "submission.json"

    @property
    def sent(self) -> Path:
        """The folder with a file for each job, written before the job is submitted to a scheduler."""
        return self.root / "sent"

    @property
    def cancelled(self) -> Path:
        """The file that exists once the user has cancelled the submission."""
        return self.root / "cancelled"

    @property
    def worker(self) -> Path:
        """The program that executes runs, for hosts without SIERRA."""
        return self.root / "worker.py"

    @property
    def engine(self) -> Path:
        """The folder of files that an engine needs to start containers, for hosts without SIERRA."""
        return self.root / "engine"

    @property
    def element_settings(self) -> Path:
        """The settings that all elements share."""
        return self.root / "element.json"

    def jobs(self, element: int) -> Path:
        return self.root / "elements" / f"{element}.jobs"

    @property
    def rest(self) -> Path:
        """The jobs that are not assigned to elements yet."""
        return self.root / "elements" / "rest.jobs"

    def given_up(self, element: int) -> Path:
        """Return the list of an element's executions that must not be started again, one per line."""
        return self.root / "elements" / f"{element}.failed"

    def alone(self, element: int) -> Path:
        """Return the list of an element's executions that execute one at a time, before all others, one per line."""
        return self.root / "elements" / f"{element}.alone"

    @property
    def results(self) -> Path:
        """The folder of result logs (packs)."""
        return self.root / "results"

    @property
    def logs(self) -> Path:
        """The folder of the elements' standard output and error."""
        return self.root / "logs"

    @property
    def journal(self) -> Path:
        return self.root / "journal.jsonl"


def user_settings() -> Path:
    """Return the file of the user's settings; it may be missing."""
    return _user("XDG_CONFIG_HOME", ".config") / "config.toml"


def user_state() -> Path:
    """Return the user's folder for state that outlives a command and may be deleted; it may be missing."""
    return _user("XDG_STATE_HOME", ".local/state")


def user_digests() -> Path:
    """Return the cache of hashes of unchanged files; it may be missing."""
    return _user("XDG_CACHE_HOME", ".cache") / "digests.json"


def user_versions() -> Path:
    """Return the cache of the versions that programs reported; it may be missing."""
    return _user("XDG_CACHE_HOME", ".cache") / "versions.json"


def user_images() -> Path:
    """Return the cache of image descriptions from podman; it may be missing."""
    return _user("XDG_CACHE_HOME", ".cache") / "images.json"


def user_engines() -> Path:
    """Return the cache of the engines' capabilities on this host; it may be missing."""
    return _user("XDG_CACHE_HOME", ".cache") / "engines.json"


def user_clusters() -> Path:
    """Return the cache of clusters whose nodes passed the checks; it may be missing."""
    return _user("XDG_CACHE_HOME", ".cache") / "clusters.json"


def user_apptainer() -> Path:
    """Return the folder of apptainer's configuration for runs; it may be missing."""
    return _user("XDG_CACHE_HOME", ".cache") / "apptainer"


def _user(variable: str, fallback: str) -> Path:
    """Return SIERRA's folder by the XDG Base Directory Specification, which ignores a variable that is not an absolute path."""
    said = Path(os.environ.get(variable, ""))
    return (said if said.is_absolute() else Path.home() / fallback) / "sierra"
