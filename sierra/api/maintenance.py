"""Maintenance of the store: checks, repairs, and removal of unneeded files."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from sierra.api.noun import Noun
from sierra.store.layout import StorePaths

if TYPE_CHECKING:
    from sierra.execution.observer import Observer
    from sierra.maintenance.fsck import Report
    from sierra.maintenance.gc import Collection
    from sierra.maintenance.repair import Repair


class Maintenance(Noun):
    """Checks, repairs and clean-up of the store: `project.maintenance`."""

    def fsck(self, *, tell: Callable[[str], None] = lambda text: None) -> Report:
        """Check all records and files: see `sierra.maintenance.fsck.Report`. `tell` receives the progress.

        >>> project.maintenance.fsck().findings
        ()
        """
        from sierra.maintenance import fsck

        return fsck.check(StorePaths(self._project.paths.store), self._project.root, tell).report

    def repair(self, *, dry_run: bool = False, tell: Callable[[str], None] = lambda text: None) -> Repair:
        """Repair the store and check it: see `sierra.maintenance.repair`. Nothing is deleted.

        >>> project.maintenance.repair(dry_run=True).done
        ()
        """
        from sierra.maintenance import repair

        return repair.repair(StorePaths(self._project.paths.store), self._project.root, dry_run=dry_run, tell=tell)

    def collection(self, *, damaged: bool = False, raw: bool = False) -> Collection:
        """Return what `collect` would remove: see `sierra.maintenance.gc.Collection`.

        >>> project.maintenance.collection().sessions
        0
        """
        from sierra.maintenance import gc

        return gc.plan(self._store, self._project.root, damaged=damaged, raw=raw)

    def collect(
        self,
        *,
        damaged: bool = False,
        raw: bool = False,
        agree: Callable[[Collection], bool] = lambda collection: True,
        observer: Observer | None = None,
    ) -> Collection | None:
        """Remove unneeded files and merge small segments, if `agree` returns true for the preview; otherwise return None.

        `damaged`: also remove segments that a repair put aside; `raw`: also remove the bytes of files that became tables.
        `observer` receives a notice about each session that cannot be recorded. Raises Missing if the disk is full; then
        nothing is lost.

        >>> project.maintenance.collect(agree=lambda collection: False) is None or project.maintenance.collection().nothing
        True
        """
        from sierra.maintenance import gc

        return gc.collect(self._store, self._project.root, damaged=damaged, raw=raw, agree=agree, observer=observer)
