"""Every file name that SIERRA gives, in one place.

    PROJECT/sierra.toml
    PROJECT/figures/<batch>/            what is drawn
    PROJECT/.sierra/format              the version of the store's format
    PROJECT/.sierra/segments/<segment>/ what is recorded; see sierra.store.segments
    PROJECT/.sierra/work/<session>/     what executes now; gone once it is recorded
        lock  claims.json  context.json  journal.jsonl  worker.log  segment/
        <number>/                       one run: input files, stdout, stderr, home/ tmp/ output/
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

CONFIG = "sierra.toml"
PYPROJECT = "pyproject.toml"
STORE = ".sierra"
FIGURES = "figures"

RUN_STDOUT = "stdout"
RUN_STDERR = "stderr"
RUN_HOME = "home"
RUN_TMP = "tmp"
RUN_OUTPUT = "output"
RUN_FOLDERS = (RUN_HOME, RUN_TMP, RUN_OUTPUT)


@dataclass(frozen=True, slots=True)
class ProjectPaths:
    """The paths of one project, whose root is an absolute folder."""

    root: Path

    @property
    def config(self) -> Path:
        return self.root / CONFIG

    @property
    def store(self) -> Path:
        return self.root / STORE

    @property
    def figures(self) -> Path:
        return self.root / FIGURES


@dataclass(frozen=True, slots=True)
class StorePaths:
    """The paths within one store."""

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
        return self.root / "work"

    @property
    def work_lock(self) -> Path:
        return self.work / "lock"

    def session(self, session: str) -> SessionPaths:
        return SessionPaths(self.work / session)


@dataclass(frozen=True, slots=True)
class SessionPaths:
    """The paths of one session's work: one asking of one query by one process."""

    root: Path

    @property
    def lock(self) -> Path:
        return self.root / "lock"

    @property
    def claims(self) -> Path:
        return self.root / "claims.json"

    @property
    def context(self) -> Path:
        return self.root / "context.json"

    @property
    def segment(self) -> Path:
        return self.root / "segment"

    @property
    def journal(self) -> Path:
        return self.root / "journal.jsonl"

    @property
    def worker_log(self) -> Path:
        return self.root / "worker.log"
