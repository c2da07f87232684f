"""The program git, executed in one folder.

It never prompts and runs no hooks. It changes no index except one that the caller passes. It reports errors in one line.

Variables that control git are removed, except those with its configuration (GIT_CONFIG_*). Inside a hook, or with GIT_DIR
set, git would otherwise use another repository than the one that contains the project.
"""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path

from sierra.errors import Missing
from sierra.util.lazy_logger import Log

log = Log(__name__)

ALWAYS = (
    *("-c", "core.hooksPath=/dev/null"),  # updating a ref and writing an index run hooks
    *("-c", "core.fsmonitor=false"),  # which may be a program
    *("-c", "core.splitIndex=false"),
    *("-c", "index.skipHash=false"),  # git 2.55 loses files of an index that is split and has no hash
    *("-c", "core.ignoreStat=false"),  # would treat files as unchanged without checking them
    *("-c", "core.safecrlf=false"),  # would refuse files whose line endings git converts
    *("-c", "gc.auto=0"),
    "--no-pager",
)

PLACES = ("--show-prefix", "--show-toplevel", "--absolute-git-dir", "--git-common-dir", "--git-path index")
"""The options of `git rev-parse` for the paths of a repository."""
NETWORK = ("GIT_SSH", "GIT_SSH_COMMAND", "GIT_SSH_VARIANT", "GIT_ASKPASS", "GIT_SSL_CAINFO", "GIT_SSL_CAPATH", "GIT_SSL_CERT")
"""Variables that control how git reaches other machines."""
OFFLINE = {"GIT_ALLOW_PROTOCOL": "none", "GIT_NO_LAZY_FETCH": "1"}
"""Variables that forbid git to fetch what a partial clone lacks, which may start any program."""


class Git:
    """Git in one folder; a call returns git's output as bytes. Raises Missing if git fails."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self._known: dict[str, bytes] = {}
        self._program = shutil.which("git")
        if self._program is None:
            raise Missing(f"{root} is in a git repository, but git is not installed; install git")

    def __call__(
        self,
        *arguments: str,
        index: Path | None = None,
        given: bytes = b"",
        optional: bool = False,
        none: int = 0,
        at_top: bool = False,
        into: Path | None = None,
        network: bool = False,
        offline: bool = False,
    ) -> bytes:
        """Run git and return its output.

        With `index`, git uses that file instead of the user's index. With `into`, that folder is the working tree. With
        `network`, the user's settings for reaching other machines apply too; with `offline`, git reaches none. If `optional` is
        true, a failure is not an error and returns no output. The same applies to the exit status `none`.
        """
        variables = environment() | ({name: os.environ[name] for name in NETWORK if name in os.environ} if network else {})
        variables |= OFFLINE if offline else {}
        if index is not None:
            variables["GIT_INDEX_FILE"] = str(index)
        cwd = self.top if at_top else self.root
        if into is not None:
            variables |= {"GIT_DIR": str(self.folder), "GIT_WORK_TREE": str(into)}
            cwd = into
        try:
            done = subprocess.run(
                [str(self._program), *ALWAYS, *arguments],
                cwd=cwd,
                env=variables,
                input=given,
                capture_output=True,
                check=False,
            )
        except OSError as error:
            raise Missing(f"git cannot be run in {cwd}: {error.strerror}") from error
        log.command(("git", *arguments), done.returncode, "" if optional else done.stderr.decode("utf-8", "replace"))
        if done.returncode not in (0, none) and not optional:
            raise Missing(self._complaint(_command(arguments), done.stderr.decode("utf-8", "replace")))
        return b"" if done.returncode else done.stdout

    def pipe(self, *arguments: str) -> subprocess.Popen[bytes]:
        """Start git with an open standard input; its output is discarded."""
        return subprocess.Popen(
            [str(self._program), *ALWAYS, *arguments],
            cwd=self.root,
            env=environment(),
            bufsize=1 << 18,
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )

    @property
    def top(self) -> Path:
        """The top folder of the repository's working tree."""
        return Path(os.fsdecode(self._place("--show-toplevel")))

    @property
    def folder(self) -> Path:
        """The repository's git directory; a linked worktree has its own."""
        return Path(os.fsdecode(self._place("--absolute-git-dir")))

    @property
    def common_folder(self) -> Path:
        """The git directory that all worktrees of the repository share."""
        return self.root / os.fsdecode(self._place("--git-common-dir"))

    @property
    def index(self) -> Path:
        """The path of the user's index."""
        return self.root / os.fsdecode(self._place("--git-path index"))

    @property
    def prefix(self) -> bytes:
        """The project's folder relative to the top of the repository, with a slash at its end; empty at the top."""
        return self._place("--show-prefix")

    def _place(self, option: str) -> bytes:
        """Return what `git rev-parse` says for one of PLACES."""
        if option in self._places:
            return self._places[option]
        return self._known.setdefault(option, self("rev-parse", *option.split()).removesuffix(b"\n"))

    @cached_property
    def _places(self) -> dict[str, bytes]:
        """The answers of git for all of PLACES, from one call; none if it refuses one, or if a name has several lines."""
        words = [word for option in PLACES for word in option.split()]
        answers = self("rev-parse", *words, optional=True).split(b"\n")[:-1]
        return dict(zip(PLACES, answers, strict=True)) if len(answers) == len(PLACES) else {}

    @cached_property
    def settings(self) -> tuple[bytes, ...]:
        """All settings that apply in the folder, each as its name and, after the end of a line, its value."""
        return tuple(self("config", "--list", "-z").split(b"\0")[:-1])

    def has(self, thing: str) -> bool:
        """Return True if the repository has this tree or commit."""
        return bool(self("rev-parse", "--verify", "--quiet", f"{thing}^{{tree}}", optional=True))

    def head(self) -> str | None:
        """Return the commit that is checked out, or None."""
        return self("rev-parse", "--verify", "--quiet", "HEAD^{commit}", optional=True).decode().strip() or None

    def _complaint(self, command: str, output: str) -> str:
        """Return git's error message in one line, with a remedy if git's first line does not name one."""
        lines = [line.strip() for line in output.splitlines() if line.strip()] or ["git gave no reason"]
        if "dubious ownership" in output:
            add = next((line for line in lines if line.startswith("git config")), "git config --global --add safe.directory …")
            return f"git refuses {self.root}: dubious ownership, it belongs to another user; if you trust it: {add}"
        if "git-lfs" in output:
            return f"git in {self.root} needs git-lfs, which does not work ({lines[0]}); install git-lfs, then: git lfs pull"
        if "insufficient permission" in output or "Read-only file system" in output:
            return f"git cannot write to {self.folder}, where SIERRA stores the source: {lines[0]}; make it writable"
        if "must be run in a work tree" in output:
            return f"the repository of {self.root} is bare (core.bare), so git sees no files there; make a worktree of it"
        if "not a git repository" in output:
            return f"{self.root} or a folder above it has a .git that is not a repository; repair it, or remove .git"
        wrong = next((line for line in lines if line.startswith(("fatal: ", "error: "))), lines[0])
        return f"git {command} in {self.root}: {wrong.removeprefix('fatal: ').removeprefix('error: ')}"


def in_repository(root: Path) -> bool:
    """Return True if a folder lies in a repository."""
    return any((folder / ".git").exists() for folder in (root, *root.parents))


def _command(arguments: Sequence[str]) -> str:
    """Return git's subcommand, without the settings before it."""
    return next(word for word, before in zip(arguments, ("", *arguments), strict=False) if "-c" not in (word, before))


def foreign() -> list[str]:
    """Return the names of variables that would make git use another repository or other settings than those of the folder."""
    return [name for name in os.environ if name.startswith("GIT_") and not name.startswith("GIT_CONFIG_")]


def environment() -> dict[str, str]:
    """Return the environment in which git runs. Without MALLOC_TRIM_THRESHOLD_, `git fast-import` is slow with glibc."""
    dropped = set(foreign())
    kept = {name: value for name, value in os.environ.items() if name not in dropped}
    return kept | {"GIT_OPTIONAL_LOCKS": "0", "GIT_TERMINAL_PROMPT": "0", "LC_ALL": "C", "MALLOC_TRIM_THRESHOLD_": "100000000"}
