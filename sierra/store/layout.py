"""All names of files that SIERRA writes, in one place.

$XDG_CONFIG_HOME/sierra/config.toml a user's own defaults
$XDG_CACHE_HOME/sierra/             what can be found out again: digests.json, versions.json, images.json,
                                    engines.json, clusters.json, apptainer/
$XDG_STATE_HOME/sierra/             reports of faults; what was asked at the SQL prompt
PROJECT/sierra.toml
PROJECT/sierra.lock                 what the names of images stand for; committed with the project
PROJECT/figures/<batch>/            what is drawn, and in .drawn.json from what
PROJECT/.sierra/files               hashes of the project's files outside git; made again where it is gone
PROJECT/.sierra/format              the version of the store's format
PROJECT/.sierra/id                  the store's own id; see sierra.store.marks
PROJECT/.sierra/segments/<segment>/ what is recorded; see sierra.store.segments
PROJECT/.sierra/work/<session>/     what executes now; gone once it is recorded
    lock  owner.0  left.0  claims.json  context.json  journal.jsonl  segment/  elsewhere
    <number>/                       one run: input files, stdout, stderr, home/ tmp/ output/; or in the folder that
                                    `elsewhere` names
    anew/                           recorded files, while they are judged anew
    source/                         the code, where it is not executed from the project itself
    asking.json  submission.json  worker.py  array_task.py  machine.py  element.json  cancelled  engine/
    elements/<index>.{jobs,failed,alone}  results/<index>.<attempt>.pack
    results/probe.<attempt>.pack  logs/  sent/<number>.json
                                    on a cluster: what was submitted, and what came of it; see sierra.worker.array_task
PROJECT/.sierra/images/<id>/        what is in an image, and its files as apptainer runs them; made again from the image
    image.json  files.jsonl  rootfs.sqfs  rootfs.<user>/
PROJECT/.sierra/damaged/<segment>/  segments that `sierra fsck --repair` put aside
PROJECT/.sierra/kept/<replay>/      what `sierra replay --keep` leaves: source/, and the folder of each run by its id
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
    """The paths of one project, whose root is an absolute folder."""

    root: Path

    @property
    def store(self) -> Path:
        return self.root / STORE

    @property
    def lock(self) -> Path:
        """What the names of images stand for."""
        return self.root / LOCK

    @property
    def figures(self) -> Path:
        return self.root / FIGURES

    def drawn(self, batch: str) -> Path:
        """What the figures of a batch were drawn from: their names, each with a hash."""
        return inside(self.figures, batch) / DRAWN


@dataclass(frozen=True, slots=True)
class StorePaths:
    """The paths within one store."""

    MARK: ClassVar[str] = "mark"
    """The file by which a folder is known as one that SIERRA made; see `sierra.store.marks`."""
    NAMES: ClassVar[frozenset[str]] = frozenset(
        (".gitignore", "CACHEDIR.TAG", "damaged", "files", "format", "id", "images", "kept", "numbers", "segments", "work")
    )
    """All that lies in a store."""
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
        """What is remembered of the project's files outside git, so that not all are read again; nobody misses it."""
        return self.root / "files"

    @property
    def numbers(self) -> Path:
        """The highest Lamport number of the segments that were seen, so that not all are read again; nobody misses it."""
        return self.root / "numbers"

    @property
    def images(self) -> Path:
        """Where images are described and kept for apptainer; all of it can be made again."""
        return self.root / "images"

    def image(self, folder: str) -> ImagePaths:
        return ImagePaths(inside(self.images, folder))

    @property
    def identity(self) -> Path:
        """The file with the store's own id."""
        return self.root / "id"

    @property
    def work_mark(self) -> Path:
        return self.work / self.MARK

    @property
    def work_lock(self) -> Path:
        return self.work / "lock"

    @property
    def reading(self) -> Path:
        """The file whose lock readers share: it is always there, and never written."""
        return self.format

    @property
    def damaged(self) -> Path:
        """Where `sierra fsck --repair` puts damaged segments aside."""
        return self.root / "damaged"

    def kept(self, replay: str) -> Path:
        """What a replay leaves because it was asked to."""
        return inside(self.root / "kept", replay)

    def session(self, session: str) -> SessionPaths:
        return SessionPaths(self.work / session)


@dataclass(frozen=True, slots=True)
class ImagePaths:
    """The paths of what is known of one image."""

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
        """The image's files in a folder, for a user who can't mount a squashfs."""
        return self.root / f"rootfs.{user}"


@dataclass(frozen=True, slots=True)
class SessionPaths:
    """The paths of one session's work: one asking of one query by one process."""

    root: Path
    elsewhere: Path | None = None
    """The folder where its runs execute, if that is another."""

    @property
    def runs(self) -> Path:
        """The folder in which each run has one."""
        return self.elsewhere or self.root

    @property
    def elsewhere_file(self) -> Path:
        """Names the folder where runs execute, if that is another."""
        return self.root / "elsewhere"

    @property
    def lock(self) -> Path:
        return self.root / "lock"

    def owner(self, generation: int) -> Path:
        return self.root / f"owner.{generation}"

    def left(self, generation: int) -> Path:
        """Is there once that owner has left what it submitted to itself, on a file system without locks."""
        return self.root / f"left.{generation}"

    @property
    def number(self) -> Path:
        """The session's Lamport number."""
        return self.root / "number"

    @property
    def claims(self) -> Path:
        return self.root / "claims.json"

    @property
    def context(self) -> Path:
        return self.root / "context.json"

    @property
    def source(self) -> Path:
        """Where a replay puts the recorded source."""
        return self.root / "source"

    @property
    def segment(self) -> Path:
        return self.root / "segment"

    @property
    def anew(self) -> Path:
        """Where recorded files lie while executions are judged anew."""
        return self.root / "anew"

    @property
    def asking(self) -> Path:
        """What is to be recorded of an asking whose process may be gone when it is answered."""
        return self.root / "asking.json"

    @property
    def submission(self) -> Path:
        """What was submitted to a cluster. A session that has it lives without a process."""
        return self.root / "submission.json"

    @property
    def sent(self) -> Path:
        """A file for each job that was handed to a scheduler, written before that."""
        return self.root / "sent"

    @property
    def cancelled(self) -> Path:
        """Is there once the user has cancelled what was submitted."""
        return self.root / "cancelled"

    @property
    def worker(self) -> Path:
        """What executes runs, for hosts that do not have SIERRA."""
        return self.root / "worker.py"

    @property
    def engine(self) -> Path:
        """The folder of what an engine needs to start containers, for hosts that do not have SIERRA."""
        return self.root / "engine"

    @property
    def element_settings(self) -> Path:
        """What all elements have in common."""
        return self.root / "element.json"

    def jobs(self, element: int) -> Path:
        return self.root / "elements" / f"{element}.jobs"

    @property
    def rest(self) -> Path:
        """The jobs that are not dealt out to elements yet."""
        return self.root / "elements" / "rest.jobs"

    def given_up(self, element: int) -> Path:
        """Executions of an element that are not to be begun again, a line each."""
        return self.root / "elements" / f"{element}.failed"

    def alone(self, element: int) -> Path:
        """Executions of an element that are executed by themselves, before all others, a line each."""
        return self.root / "elements" / f"{element}.alone"

    @property
    def results(self) -> Path:
        """The folder of packs."""
        return self.root / "results"

    @property
    def logs(self) -> Path:
        """The folder of what elements print."""
        return self.root / "logs"

    @property
    def journal(self) -> Path:
        return self.root / "journal.jsonl"


def user_settings() -> Path:
    """The file of a user's own defaults; it need not be there."""
    return _user("XDG_CONFIG_HOME", ".config") / "config.toml"


def user_state() -> Path:
    """A folder of the user's for what outlives a command, and nobody misses; it need not be there."""
    return _user("XDG_STATE_HOME", ".local/state")


def user_digests() -> Path:
    """The file of hashes of files that have not changed since; it need not be there."""
    return _user("XDG_CACHE_HOME", ".cache") / "digests.json"


def user_versions() -> Path:
    """The file of what programs said of themselves; it need not be there."""
    return _user("XDG_CACHE_HOME", ".cache") / "versions.json"


def user_images() -> Path:
    """The file of what podman said of images; it need not be there."""
    return _user("XDG_CACHE_HOME", ".cache") / "images.json"


def user_engines() -> Path:
    """The file of what engines can do here; it need not be there."""
    return _user("XDG_CACHE_HOME", ".cache") / "engines.json"


def user_clusters() -> Path:
    """The file of clusters whose nodes were found to be fine; it need not be there."""
    return _user("XDG_CACHE_HOME", ".cache") / "clusters.json"


def user_apptainer() -> Path:
    """The folder of how apptainer is configured for runs; it need not be there."""
    return _user("XDG_CACHE_HOME", ".cache") / "apptainer"


def _user(variable: str, fallback: str) -> Path:
    """By the XDG Base Directory Specification: a path there that is not absolute is not heeded."""
    said = Path(os.environ.get(variable, ""))
    return (said if said.is_absolute() else Path.home() / fallback) / "sierra"
