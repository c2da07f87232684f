"""Nouns about the store: records by their ids, sources that are shared through git, and maintenance."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from sierra.api.noun import Noun
from sierra.errors import ConfigError, Damaged, Missing, NotFound, UsageError
from sierra.store.layout import StorePaths

if TYPE_CHECKING:
    from sierra.config.output_tables import Key
    from sierra.deliverables.studies.study import Outcome as StudyOutcome
    from sierra.execution.observer import Observer
    from sierra.execution.outputs_taken import TakenOutputs
    from sierra.execution.shown_records import Shown, ShownClaim, ShownSession
    from sierra.explain.diff.compare import Comparison
    from sierra.explain.why_executed import Why
    from sierra.maintenance.fsck import Report
    from sierra.maintenance.gc import Collection
    from sierra.maintenance.remove import Removal
    from sierra.maintenance.repair import Repair
    from sierra.provenance.commits_between import Known as CommitInRepository
    from sierra.provenance.source.share_refs import Shared
    from sierra.store.export_recorded_files import Listing, Outcome
    from sierra.store.row_types import SourceRow


class Records(Noun):
    """Records of the store, by their ids: `project.records`."""

    def show(self, prefix: str) -> Shown | ShownClaim | StudyOutcome:
        """Return the record of a batch, experiment, run, execution, session, study or registered claim, by a prefix of its id.

        Each kind has a class in `sierra.execution.shown_records`, a study in `sierra.deliverables.studies.study`; its `as_dict`
        returns what `sierra show --json` prints. Raises NotFound.

        >>> project.records.show(summary.batch).kind
        'batch'
        """
        from sierra.execution.show_record import show
        from sierra.execution.shown_records import ShownBatch, ShownExecution

        prefix = self.id(prefix)
        if (outcome := self._shown_other(prefix)) is not None:
            return outcome
        try:
            shown = show(self._store, prefix)
        except NotFound:
            if (session := self._session(prefix)) is None:
                raise
            return session
        match shown:
            case ShownBatch():
                last = next((self._log_file(session.session) for session in reversed(shown.sessions)), None)
                return replace(shown, history=self._history(shown.source), log_file=last)
            case ShownExecution():
                return replace(shown, log_file=self._log_file(shown.row.session))
            case _:
                return shown

    def _shown_other(self, prefix: str) -> StudyOutcome | ShownClaim | None:
        """Return the study or the registered claim with this id; None if the id is that of another object."""
        try:
            record = self._store.identify(prefix)
        except NotFound:
            return None
        if record.kind == "claim":
            return self._shown_claim(record.id)
        if record.kind != "study":
            return None
        from sierra.deliverables.studies import study

        outcome = study.find(self._store, record.id)
        return outcome and study.checked(self._loaded, self._store, outcome)

    def _shown_claim(self, claim: str) -> ShownClaim:
        import json

        from sierra.execution.shown_records import ShownClaim
        from sierra.store.row_types import RegisteredClaimRow
        from sierra.util.json_types import as_object

        text = "SELECT * FROM registered_claims WHERE claim = $claim ORDER BY lamport, name"
        rows = self._store.select(RegisteredClaimRow, text, claim=claim)
        try:
            form = as_object(json.loads(rows[0].text))
        except (ValueError, RecursionError) as error:
            raise Damaged(f"the record of claim {claim[:10]} is not JSON; sierra fsck names what is damaged") from error
        return ShownClaim(claim, form, rows)

    def _session(self, prefix: str) -> ShownSession | None:
        """Return the record of a session, or only its log file if it is not recorded; None if there is not exactly one."""
        from sierra.execution.shown_records import ShownSession
        from sierra.store import session_log_file
        from sierra.store.row_types import SessionRow
        from sierra.store.store import PREFIX

        start = prefix.lower()
        if not PREFIX.fullmatch(start):
            return None
        recorded = self._store.select(SessionRow, "SELECT * FROM sessions WHERE starts_with(session, $p)", p=start)
        logged = (path.stem for path in session_log_file.logs(self._store.paths) if path.stem.startswith(start))
        rows: dict[str, SessionRow | None] = {**dict.fromkeys(logged), **{row.session: row for row in recorded}}
        if len(rows) != 1:
            return None
        [(session, row)] = rows.items()
        return ShownSession(session, row, self._log_file(session))

    def _log_file(self, session: str) -> str | None:
        """Return the path of a session's log file; None if it has none any more."""
        from sierra.store import session_log_file

        path = session_log_file.find(self._store.paths, session)
        return str(path) if path else None

    def _history(self, source: SourceRow | None) -> CommitInRepository | None:
        """Return the recorded commit of a source as the repository has it now; None if the repository does not have it."""
        if not (source and source.commit):
            return None
        from sierra.provenance import commits_between

        return commits_between.known(self._project.root, source.commit)

    def diff(self, before: str, after: str) -> Comparison:
        """Return the differences between two batches, experiments, runs or executions, by prefixes of their ids.

        Differences that probably affect results come first: see `sierra.explain.diff.compare.Comparison`.
        Raises NotFound, UsageError.

        >>> other = project.run("population_size=1,2", runs=1, figures=False)
        >>> [one.name for one in project.records.diff(summary.batch, other.batch).differences]
        ['runs']
        """
        from sierra.explain.diff.compare import compare

        return compare(self._loaded, self._store, self.id(before), self.id(after))

    def why(self, prefix: str) -> Why:
        """Explain why runs were executed or not, which executions are effective, and what the query would execute now.

        >>> project.records.why(summary.batch).found.kind
        'batch'
        """
        from sierra.explain import why_executed as why

        return why.why(self._loaded, self._store, self.id(prefix))

    def removal(self, *prefixes: str) -> Removal:
        """Return what `remove` would delete for these ids of batches, experiments, runs or executions. Raises NotFound.

        >>> type(project.records.removal(summary.batch)).__name__
        'Removal'
        """
        from sierra.maintenance import remove

        return remove.plan(self._store, tuple(map(self.id, prefixes)))

    def remove(
        self, *prefixes: str, agree: Callable[[Removal], bool] = lambda removal: True, observer: Observer | None = None
    ) -> Removal | None:
        """Remove the records of these ids, if `agree` returns true for the preview; return None if it returns false.

        Runs that other batches have keep their executions. `observer` receives a notice about each session that died and cannot
        be recorded. Raises NotFound for an unknown id, Missing if the disk is full, and SierraError while one of the batches is
        executing. If it raises, nothing changes.

        >>> print(project.records.remove(summary.batch, agree=lambda removal: False))
        None
        """
        from sierra.maintenance import remove

        return remove.remove(self._store, tuple(map(self.id, prefixes)), agree, observer)

    def files(self, prefix: str, *paths: str, to: str | os.PathLike[str] | None = None) -> Listing | list[Outcome]:
        """Return a list of the recorded files of an id; with `to`, write them to that folder and return the outcomes.

        `paths` are paths in the listing, or globs; without any, all files. Raises NotFound for a path that matches nothing.

        >>> len(project.records.files(summary.batch, "swarm.csv").files)
        4
        """
        from sierra.store import export_recorded_files

        listed = export_recorded_files.listing(self._store, prefix, paths)
        return listed if to is None else list(export_recorded_files.extract(self._store, listed, Path(to)))

    def batch(self, prefix: str | None = None, *, target: str | None = None) -> str:
        """Return the id of a batch from a prefix or the name of a query; without one, that of the batch requested last.

        With `target`, that of the batch requested last for it.

        Raises NotFound, Missing, and UsageError for an unknown target, or for a prefix together with a target.

        >>> project.records.batch(summary.batch[:10]) == summary.batch
        True
        """
        if target is not None:
            self._loaded.for_target(target)  # raises an error for an unknown one
            if prefix is not None:
                raise UsageError(f"batch {prefix} is one of a target already; leave out --target")
        if prefix is not None:
            return self._store.batch_id(self.id(prefix))
        known = [batch for batch in self._project.batches if target is None or target in batch.targets]
        if not known:
            of = f" for target {target!r}" if target else ""
            raise Missing(f"no batch is recorded{of} yet; record one with sierra run")
        return known[-1].batch

    def id(self, word: str) -> str:
        """Return the id of the batch of a query in `sierra.toml`, if this is its name; else the word, a prefix of any id.

        Raises NotFound for a query that has not been run with the project as it is, UsageError for a name that begins an id.

        >>> project.records.id("4fc1")
        '4fc1'
        """
        from sierra.store.store import PREFIX

        may_be_id = PREFIX.fullmatch(word.lower()) is not None
        try:
            if self._project.received or word not in self._project.config.queries:
                return word
        except ConfigError:
            if not may_be_id:
                raise
            return word  # records can be read whatever the file says
        batch = self._asked((word,), None)
        with contextlib.suppress(NotFound):
            if may_be_id and self._store.resolve(word).id != batch:
                raise UsageError(
                    f"{word!r} is the name of a query, and an id begins with it; write more digits, or {batch[:10]}"
                )
        return batch

    def labelled(self, word: str) -> tuple[str, str]:
        """Return the label ("" for none) and the batch of a word: `LABEL=PREFIX`, `PREFIX`, or the same with a query's name.

        >>> project.records.labelled(f"before={summary.batch}") == ("before", summary.batch)
        True
        """
        label, equals, rest = word.rpartition("=")
        if equals and not label:
            raise UsageError(f"{word!r} has no label before =; write LABEL=HASH")
        batch = self.batch(rest)
        return label or ("" if batch.startswith(rest.lower()) else rest), batch

    def outputs(self, *query: str, target: str | None = None) -> TakenOutputs:
        """Return how a batch's outputs were read: its tables, and the files that became no table, with the reasons.

        `query` is a prefix of the batch's id, or its criteria; without any, it is the batch requested last (for `target`).
        Raises NotFound, Missing, QueryError.

        >>> [(table.name, table.rows) for table in project.records.outputs(summary.batch).tables]
        [('swarm', '5 rows')]
        """
        from sierra.api.execution import taken

        return taken(self._project, self._asked(query, target), inside=True)

    def declare_outputs(self, *query: str, target: str | None = None) -> dict[str, dict[str, Key]]:
        """Write the undeclared tables of a batch into `sierra.toml`, as `[outputs.NAME]`; return what was written.

        If the batch is for a target, the tables are written into the table of this target. Tables that exist stay the same.
        Files that a reader can take but that made no table, such as CSV in a subfolder, become tables with the next run of the
        query. Nothing is executed again. Raises UsageError if the file cannot be changed without changing anything else in it.

        >>> project.records.declare_outputs(summary.batch)
        {'swarm': {'file': 'swarm.csv'}}
        """
        from sierra.execution.outputs_taken import comments, proposed
        from sierra.setup import declare_outputs

        taken = self.outputs(*query, target=target)
        tables = proposed(taken)
        target = taken.target if taken.target in self._project.targets else None
        declare_outputs.write(self._project.folder, tables, comments(taken), target)
        return tables

    def _asked(self, query: Sequence[str], target: str | None) -> str:
        """Return the id of the batch that a prefix or a query names; without either, that of the batch requested last."""
        from sierra.store.store import PREFIX

        store, queries = self._store, self._project.config.queries
        if not query or (len(query) == 1 and PREFIX.fullmatch(query[0].lower()) and query[0] not in queries):
            return self.batch(*query, target=target)
        batch = self._project.plan(*query, target=target).batch.id
        if not store.values(str, "SELECT batch FROM batches WHERE batch = $b", b=batch):
            raise NotFound(f"the query {' '.join(query)!r} has not been run with this project as it is; see sierra ls")
        return batch


class Sources(Noun):
    """Recorded sources, shared through git: `project.sources`."""

    def push(self, remote: str | None = None) -> list[Shared]:
        """Push the recorded sources, including submodules, to a git remote: see `sierra.provenance.source.share_refs`."""
        return self._share("push", remote)

    def fetch(self, remote: str | None = None) -> list[Shared]:
        """Fetch the sources that others have pushed, including submodules: see `sierra.provenance.source.share_refs`."""
        return self._share("fetch", remote)

    def _share(self, direction: Literal["push", "fetch"], remote: str | None) -> list[Shared]:
        """Push or fetch the sources. Raises UsageError if the project's source is identified without git."""
        from sierra.provenance import source

        if not self._project.config.source.git:
            raise UsageError("[source] git = false: the store has the code, and git has none to share; remove the setting")
        return source.share(self._project.root, direction, remote)


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
