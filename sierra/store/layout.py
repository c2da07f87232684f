"""The names of all files that SIERRA writes.

$XDG_CONFIG_HOME/sierra/config.toml user settings
$XDG_CACHE_HOME/sierra/             caches that can be rebuilt: digests.json, versions.json, images.json,
                                    engines.json, clusters.json, apptainer/, packages/<id>/, verified/
$XDG_STATE_HOME/sierra/             crash reports; the history of the SQL prompt
PROJECT/sierra.toml
PROJECT/sierra.lock                 the images that image names stand for; committed with the project
PROJECT/figures/<batch>/            figures, and the mark .drawn; what they show is recorded in the table deliverables
PROJECT/figures/comparisons/        figures of comparisons
PROJECT/figures/reports/            reports
PROJECT/.sierra/files               hashes of the project's files outside git; rebuilt if it is missing
PROJECT/.sierra/format              the version of the store's format
PROJECT/paper/sierra/               figures, captions, tables and texts of a paper, and provenance.json ([paper] folder)
PROJECT/.sierra/id                  the store's id; see sierra.store.ownership_marks
PROJECT/.sierra/segments/<segment>/ records; see sierra.store.segments
PROJECT/.sierra/index/              the records of many segments in one file; rebuilt if missing; see sierra.store.index_files
PROJECT/.sierra/work/<session>/     the work of a session; removed once it is recorded
    lock  owner.0  left.0  claims.json  context.json  journal.jsonl  segment/  elsewhere
    <number>/                       one run: input files, stdout, stderr, home/ tmp/ output/; or in the folder that
                                    `elsewhere` names
    anew/                           recorded files, while they are evaluated by changed rules
    source/                         the code, if it is not executed from the project itself
    worker.pyz                      the programs for nodes and containers; see sierra.worker.__main__
    asking.json  submission.json  element.json  cancelled  engine/
    elements/<index>.{jobs,failed,alone}  results/<index>.<attempt>.pack
    results/probe.<attempt>.pack  logs/  sent/<number>.json
                                    on a cluster: the submission and its results; see sierra.worker.array_task
PROJECT/.sierra/images/<id>/        the description of an image, and its files as apptainer runs them; rebuilt from the image
    image.json  files.jsonl  rootfs.sqfs  rootfs.<user>/  image.tar
PROJECT/.sierra/damaged/<segment>/  segments that `sierra fsck --repair` moved out of the way
PROJECT/.sierra/damaged/work-<session>/  the work of a session that cannot be recorded; `fault` says why
PROJECT/.sierra/logs/<session>.log  messages of a session, <session>.old: the earlier ones; see sierra.store.session_log_file
PROJECT/.sierra/build/              lock: held while products are built; aside/: older products meanwhile
PROJECT/.sierra/try/                mark  lock; run/: the folder of the run that `sierra try` executed last; store/: its records
                                    while it executes
PROJECT/.sierra/checkpoints/<run>.<programs>/  mark, files/: the checkpoint of a run that was cut off; see
                                    sierra.worker.checkpoints
PROJECT/.sierra/extracted/          recorded files, while a video of them is made
PROJECT/.sierra/kept/<replay>/      files that `sierra replay --keep` leaves: source/, and each run's folder by its id
"""

from __future__ import annotations

import dataclasses
import os
from functools import partial
from pathlib import Path
from typing import ClassVar, Protocol

from sierra.util.fs import inside
from sierra.util.hashing import sha256
from sierra.util.lazy_definitions import dataclass

CONFIG = "sierra.toml"
LOCK = "sierra.lock"
BASELINES = "sierra.baselines.json"
PYPROJECT = "pyproject.toml"
STORE = ".sierra"
WORK = "work"
FIGURES = "figures"
DRAWN = ".drawn"
"""The mark of a folder that SIERRA draws figures to, so that it does not count as source."""
PAPER = "paper/sierra"
"""The folder of a paper, unless `[paper] folder` names another one."""
PROVENANCE = "provenance.json"
"""The file in the folder of a paper that says what its files show; with it, the folder does not count as source."""
COMPARISONS = "comparisons"
REPORTS = "reports"

RUN_STDOUT = "stdout"
RUN_STDERR = "stderr"
RUN_HOME = "home"
RUN_TMP = "tmp"
RUN_OUTPUT = "output"
RUN_NAMES = (RUN_STDOUT, RUN_STDERR, RUN_HOME, RUN_TMP, RUN_OUTPUT)
"""Names in the folder of a run that are not inputs."""


class _Rooted(Protocol):
    @property
    def root(self) -> Path: ...


@dataclasses.dataclass(frozen=True)
class _Below:
    """A path below the attribute `root` of the class that has it as an attribute."""

    name: str

    def __get__(self, paths: _Rooted, owner: type) -> Path:
        return paths.root / self.name


@dataclass(frozen=True, slots=True)
class ProjectPaths:
    """The paths of one project; `root` is an absolute path."""

    root: Path

    store = _Below(STORE)
    lock = _Below(LOCK)
    """The file that pins image names to images."""
    baselines = _Below(BASELINES)
    """The results of claims that later ones are compared with."""
    figures = _Below(FIGURES)

    def drawn(self, batch: str) -> Path:
        """Return the mark in the folder of a batch's figures."""
        return inside(self.figures, batch) / DRAWN


@dataclass(frozen=True, slots=True)
class StorePaths:
    """The paths in one store."""

    root: Path

    MARK: ClassVar[str] = "mark"
    """The name of the file that shows that SIERRA made a folder; see `sierra.store.ownership_marks`."""
    format = _Below("format")
    gitignore = _Below(".gitignore")
    cachedir_tag = _Below("CACHEDIR.TAG")
    segments = _Below("segments")
    index = _Below("index")
    """The folder of indexes, each with the records of many segments; all of it can be built again."""
    work = _Below(WORK)
    files = _Below("files")
    """The cache of hashes of the project's files outside git, which avoids reading all of them again; may be deleted."""
    numbers = _Below("numbers")
    """The cache of the known segments' highest Lamport number, which avoids reading all of them again; may be deleted."""
    images = _Below("images")
    """The folder of image descriptions and of images for apptainer; all of it can be rebuilt."""
    identity = _Below("id")
    """The file with the store's id."""
    damaged = _Below("damaged")
    """The folder to which `sierra fsck --repair` moves damaged segments, and commands sessions that cannot be recorded."""
    logs = _Below("logs")
    """The folder of the sessions' log files; may be deleted."""
    kept_files = _Below("kept")
    """The folder of what `sierra replay --keep` leaves."""
    extracted = _Below("extracted")
    """The folder of recorded files that a process needs as files; each process has a folder of its own."""
    checkpoints = _Below("checkpoints")
    """The folder of checkpoints; each one is removed when its run has succeeded."""
    tries = _Below("try")
    """The folder of what `sierra try` leaves; the next one replaces it."""
    build = _Below("build")
    """The folder for builds of the products of `[build]`: the lock, and older products while new ones are built."""
    build_lock = _Below("build/lock")
    """The file that a process locks while it builds. It names the build, so that the next process can end what was left."""
    build_aside = _Below("build/aside")
    reading = format
    """The file that readers lock in shared mode. It always exists, and readers never write it."""
    NAMES: ClassVar[frozenset[str]] = frozenset(one.name for one in vars().values() if isinstance(one, _Below))
    """The names of all entries of a store."""
    work_mark = _Below(f"{WORK}/{MARK}")
    work_lock = _Below(f"{WORK}/lock")

    def image(self, folder: str) -> ImagePaths:
        return ImagePaths(inside(self.images, folder))

    def kept(self, replay: str) -> Path:
        """Return the folder of the files that `sierra replay --keep` leaves."""
        return inside(self.kept_files, replay)

    def checkpoint(self, run: str, programs: str) -> Path:
        """Return the checkpoint of a run that these programs execute: others may not understand its files."""
        return inside(self.checkpoints, f"{run}.{programs[:16]}")

    @property
    def trial(self) -> TrialPaths:
        return TrialPaths(self.tries)

    def log(self, session: str) -> Path:
        return self.logs / f"{session}.log"

    def session(self, session: str) -> SessionPaths:
        return SessionPaths(self.work / session)


@dataclass(frozen=True, slots=True)
class ImagePaths:
    """The paths of the description and the files of one image."""

    root: Path

    description = _Below("image.json")
    files = _Below("files.jsonl")
    """The list of the image's files."""
    rootfs = _Below("rootfs.sqfs")
    """The image's files as a squashfs."""
    archive = _Below("image.tar")
    """The image as an archive, for other hosts with podman."""

    def sandbox(self, user: int) -> Path:
        """Return the folder of the image's files for a user who can't mount a squashfs."""
        return self.root / f"rootfs.{user}"


@dataclass(frozen=True, slots=True)
class TrialPaths:
    """The paths of `sierra try`."""

    root: Path

    mark = _Below(StorePaths.MARK)
    lock = _Below("lock")
    """The file that a process locks while it tries a run."""
    store = _Below("store")
    """The store of the run that is tried; removed when it has ended."""
    new = _Below("new")
    """The folder to which the run's folder is moved first."""
    run = _Below("run")
    """The folder of the last run."""
    last = _Below("last.json")
    """The seed of the last run that succeeded, and the hashes of its tables."""


@dataclass(frozen=True, slots=True)
class SessionPaths:
    """The paths of the work of one session."""

    root: Path
    elsewhere: Path | None = None
    """The folder where the session's runs execute, if it is not `root`."""

    elsewhere_file = _Below("elsewhere")
    """The file that names the folder where runs execute, if it is not `root`."""
    lock = _Below("lock")
    number = _Below("number")
    """The file with the session's Lamport number."""
    claims = _Below("claims.json")
    context = _Below("context.json")
    source = _Below("source")
    """The folder of the restored source during a replay."""
    shared = _Below("shared")
    """The folder of the files that lie beside the inputs of runs."""
    segment = _Below("segment")
    reevaluation = _Below("anew")
    """The folder of recorded files while executions are evaluated by changed rules."""
    asking = _Below("asking.json")
    """The data to record about a session whose process may be gone when it ends."""
    submission = _Below("submission.json")
    """The cluster submission. A session with this file lives without a process."""
    sent = _Below("sent")
    """The folder with a file for each job, written before the job is submitted to a scheduler."""
    cancelled = _Below("cancelled")
    """The file that exists once the user has cancelled the submission."""
    worker = _Below("worker.pyz")
    """The programs that execute runs, for hosts without SIERRA and for containers."""
    engine = _Below("engine")
    """The folder of files that an engine needs to start containers, for hosts without SIERRA."""
    element_settings = _Below("element.json")
    """The settings that all array tasks share."""
    carried = _Below("carried.json")
    """The state of a scheduler that carries the session's files to hosts: which array task is where."""
    rest = _Below("elements/rest.jobs")
    """The jobs that are not assigned to array tasks yet."""
    results = _Below("results")
    """The folder of result logs (packs)."""
    logs = _Below("logs")
    """The folder of the array tasks' standard output and error."""
    journal = _Below("journal.jsonl")
    fault = _Below("fault")
    """The reason why the session cannot be recorded."""
    doubt = _Below("doubt")
    """The reason why results that are not recorded yet cannot be attributed to the session's code and programs."""
    building = _Below("building")
    """The folder of a build: `home` and `tmp` of its command, and what it prints."""

    @property
    def runs(self) -> Path:
        """The folder that contains a folder for each run."""
        return self.elsewhere or self.root

    def owner(self, generation: int) -> Path:
        return self.root / f"owner.{generation}"

    def left(self, generation: int) -> Path:
        """Return the file that exists once that owner has detached from its submission, on a file system without locks."""
        return self.root / f"left.{generation}"

    def jobs(self, array_task: int) -> Path:
        return self.root / "elements" / f"{array_task}.jobs"

    def given_up(self, array_task: int) -> Path:
        """Return the list of an array task's executions that must not be started again, one per line."""
        return self.root / "elements" / f"{array_task}.failed"

    def alone(self, array_task: int) -> Path:
        """Return the list of an array task's executions that execute one at a time, before all others, one per line."""
        return self.root / "elements" / f"{array_task}.alone"


def _user(variable: str, fallback: str, name: str = "") -> Path:
    """Return a path in SIERRA's folder by the XDG Base Directory Specification; it may be missing.

    The specification ignores a variable that is not an absolute path.
    """
    folder = Path(os.environ.get(variable, ""))
    return (folder if folder.is_absolute() else Path.home() / fallback) / "sierra" / name


_user_cache = partial(_user, "XDG_CACHE_HOME", ".cache")
user_settings = partial(_user, "XDG_CONFIG_HOME", ".config", "config.toml")
user_state = partial(_user, "XDG_STATE_HOME", ".local/state")
"""Return the user's folder for state that outlives a command and may be deleted."""
user_digests = partial(_user_cache, "digests.json")
"""Return the cache of hashes of unchanged files."""
user_versions = partial(_user_cache, "versions.json")
"""Return the cache of the versions that programs reported."""
user_images = partial(_user_cache, "images.json")
"""Return the cache of image descriptions from podman."""
user_engines = partial(_user_cache, "engines.json")
"""Return the cache of the engines' capabilities on this host."""
user_tracers = partial(_user_cache, "tracers.json")
"""Return the cache of the tracers that work on this host."""
user_clusters = partial(_user_cache, "clusters.json")
"""Return the cache of clusters whose nodes passed the checks."""
user_apptainer = partial(_user_cache, "apptainer")
"""Return the folder of apptainer's configuration for runs."""
_user_verified = partial(_user_cache, "verified")
user_packages = partial(_user_cache, "packages")
"""Return the folder of the stores of opened packages, each in a folder with the package's id."""


def user_verified(segments: str) -> Path:
    """Return the cache of the states of verified files in a store's folder of segments."""
    return _user_verified() / f"{sha256(os.fsencode(os.path.realpath(segments)))[:32]}.json"
