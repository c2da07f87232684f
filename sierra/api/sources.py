"""Recorded sources that are shared through git."""

from __future__ import annotations

from typing import TYPE_CHECKING

from sierra.api.noun import Noun
from sierra.errors import UsageError
from sierra.provenance import source

if TYPE_CHECKING:
    from sierra.provenance.source.share_refs import Shared


class Sources(Noun):
    """Recorded sources, shared through git: `project.sources`."""

    def push(self, remote: str | None = None) -> list[Shared]:
        """Push the recorded sources, including submodules, to a git remote: see `sierra.provenance.source.share_refs`."""
        self._check_git()
        return source.share(self._project.root, "push", remote)

    def fetch(self, remote: str | None = None) -> list[Shared]:
        """Fetch the sources that others have pushed, including submodules: see `sierra.provenance.source.share_refs`."""
        self._check_git()
        return source.share(self._project.root, "fetch", remote)

    def _check_git(self) -> None:
        """Raise UsageError if the project's source is identified without git."""
        if not self._project.config.source.git:
            raise UsageError("[source] git = false: the store has the code, and git has none to share; remove the setting")
