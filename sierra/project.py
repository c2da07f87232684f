"""SIERRA from Python: what the command line does, as functions that return values.

project = sierra.open(".")
summary = project.run("population_size.Log8", runs=10)
frame = project.sql("SELECT * FROM swarm WHERE clock = 60", within=summary.batch).to_pandas()
table = project.statistics(summary.batch, "swarm", "coverage").to_pandas()
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sierra.config import project_file, user
from sierra.errors import Missing, NotFound, UsageError
from sierra.store.layout import ProjectPaths, StorePaths
from sierra.store.store import Store

if TYPE_CHECKING:
    import pyarrow as pa

    from sierra.containers.images import Contents, Image
    from sierra.containers.images.listing import Known
    from sierra.design.experiments import Heed
    from sierra.execution.execute import Summary
    from sierra.execution.executor import RunOptions, Watch
    from sierra.execution.plans import Plan
    from sierra.execution.status import Standing
    from sierra.execution.takeover import Cancelled
    from sierra.explain.diff.compare import Comparison
    from sierra.explain.why import Why
    from sierra.maintenance.fsck import Report
    from sierra.maintenance.gc import Collection
    from sierra.maintenance.remove import Removal
    from sierra.maintenance.repair import Repair
    from sierra.provenance.source.sharing import Shared
    from sierra.replay.verdicts import Replay, Tolerances
    from sierra.runners.cluster.estimate import Estimate
    from sierra.store.export import Listing, Outcome


class Project:
    """One project: its `sierra.toml`, and the store beside it."""

    def __init__(self, path: str | os.PathLike[str] = ".") -> None:
        """Open the project that the folder `path` lies in, or only the store there. Raises Missing where there is neither."""
        self._found = project_file.load_store(Path(path))
        self.paths = ProjectPaths(self._found.root)

    @cached_property
    def _loaded(self) -> project_file.LoadedProject:
        """The project; where only a store is, its outputs are as they were last recorded."""
        if self._found.written:
            return self._found
        from sierra.execution import stored_plan

        outputs = stored_plan.last_outputs(self.store)
        return replace(self._found, config=self._found.config.model_copy(update={"outputs": outputs}))

    @property
    def root(self) -> Path:
        """The project's folder, absolute."""
        return self._found.root

    @property
    def config(self) -> project_file.Project:
        """What `sierra.toml` says; where there is none, what follows from the store."""
        return self._loaded.config

    @property
    def store(self) -> Store:
        """The project's store. Raises Missing where nothing has been run yet."""
        return Store(self.paths.store)

    def stored(self) -> Store | None:
        """The project's store, if there is one yet."""
        return self.store if StorePaths(self.paths.store).format.exists() else None

    def plan(
        self,
        *query: str,
        runs: int | None = None,
        controller: str | None = None,
        scenario: str | None = None,
        sets: Sequence[tuple[str, str]] = (),
        engine: str | None = None,
        heed: Heed | None = None,
    ) -> Plan:
        """What a query would execute: the batch with all ids. `sets` are pairs of XPath and value,
        `engine` is what is to contain runs, instead of what the project says. `heed` hears how far planning has come: see
        `sierra.design.experiments.Heed`.

        The beginning of a recorded batch's id instead of a query is that batch, with the code and the inputs of then.
        """
        from sierra.design.experiments import deaf
        from sierra.execution import plans, stored_plan
        from sierra.explain.changes import respelled
        from sierra.store.store import PREFIX

        [word] = query if len(query) == 1 else ("",)
        if PREFIX.fullmatch(word.lower()) and word not in self.config.queries and self.stored():
            if runs or controller or scenario or sets:
                raise UsageError(
                    f"batch {word} is executed as it was recorded; without --runs, --controller, --scenario, --set"
                )
            return stored_plan.plan(self._loaded, self.store, word, contained=engine)
        asked = plans.ask(self._loaded, query, runs=runs, controller=controller, scenario=scenario, sets=sets)
        plan = plans.plan(self._loaded, asked, engine=engine, heed=heed or deaf)
        store = self.stored()
        return replace(plan, notes=(*plan.notes, *respelled(plan, store))) if store else plan

    def run(
        self,
        *query: str,
        runs: int | None = None,
        controller: str | None = None,
        scenario: str | None = None,
        sets: Sequence[tuple[str, str]] = (),
        jobs: int | None = None,
        fail_fast: bool = False,
        figures: bool = True,
        watch: Watch | None = None,
        engine: str | None = None,
        runner: str = "local",
        detach: bool = False,
    ) -> Summary:
        """Answer a query: execute what is missing, record it, draw the figures.

        `jobs` is how many runs execute at a time (default: the user's setting, or usable cores). `watch` hears of the progress.
        `runner` is where runs execute: `local`, or a cluster by its name; with `detach`, it is left to itself at once.
        """
        plan = self.plan(*query, runs=runs, controller=controller, scenario=scenario, sets=sets, engine=engine)
        return self.execute(plan, jobs=jobs, fail_fast=fail_fast, figures=figures, watch=watch, runner=runner, detach=detach)

    def execute(
        self,
        plan: Plan,
        *,
        jobs: int | None = None,
        fail_fast: bool = False,
        figures: bool = True,
        watch: Watch | None = None,
        runner: str = "local",
        detach: bool = False,
        say: Callable[[str], None] | None = None,
        leave: Callable[[], bool] | None = None,
    ) -> Summary:
        """Execute a plan. `say` gets what the user should know at once; see `sierra.execution.executor.RunOptions`."""
        from sierra import runners
        from sierra.execution import execute
        from sierra.execution.executor import RunOptions

        stays = runners.find(runner, self.config.runners)(1).stays
        if detach and not stays:
            raise UsageError(
                f"what {runner!r} executes ends with this process: only what is on a cluster can be left to itself"
            )
        options = RunOptions(
            _slots(jobs),
            runner,
            fail_fast,
            watch=watch or (lambda progress: None),
            say=say or (lambda text: None),
            leave=leave if leave and not detach else lambda: True,
            detach=detach,
        )
        store = Store.create(self.paths.store)
        probed = self._probe(plan, store, options) if self.config.determinism.probe else ()
        summary = execute.run(plan, store, options)
        summary = replace(summary, notes=(*probed, *summary.notes))
        return self._drawn(summary) if figures else summary

    def sql(self, text: str, *, within: str | None = None, **parameters: Any) -> pa.Table:
        """The answer to one SQL statement as an Arrow table (`.to_pandas()` makes it a data frame).

        `$name` in the statement takes its value from the keyword. With `within`, the beginning of a batch's id, members,
        runs and outputs are those of that batch; else of all, whatever code they were made from. Where a column holds numbers
        in some runs and texts in others, the texts of v are in v_text, and the schema's metadata say so, `sierra:note`.
        Raises SqlError.
        """
        return self.store.sql(text, within=None if within is None else self.batch(within), **parameters)

    @property
    def batches(self) -> list[dict[str, Any]]:
        """All batches, the last asked for last; see `sierra.execution.listing.batches`."""
        from sierra.execution import listing

        return listing.batches(self.store)

    def show(self, prefix: str) -> dict[str, Any]:
        """What is recorded of a batch, an experiment, a run or an execution, by a beginning of its id."""
        from sierra.execution import listing

        return listing.show(self.store, prefix)

    def replay(
        self,
        prefix: str,
        *,
        runs: int | None = None,
        jobs: int | None = None,
        runner: str = "local",
        engine: str | None = None,
        tolerances: Tolerances | None = None,
        keep: bool = False,
        record: bool = True,
        watch: Watch | None = None,
        say: Callable[[str], None] | None = None,
    ) -> Replay:
        """Execute again, from the record alone, what an id names, and compare: see `sierra.replay.verdicts.Replay`.

        `runs`: the first so many of each experiment. `tolerances`: by output and column (`*`: all), instead of what
        `sierra.toml` declares. `keep`: leave the restored source and the folders of the runs. Without `record`,
        nothing is written to the store, which may be read-only. `say` hears what is
        other than it was recorded, before anything executes. Raises NotFound, and Missing for what is needed and gone.
        """
        from sierra.replay import replay

        options = replay.ReplayOptions(_slots(jobs), runs, runner, engine, tolerances or {}, keep)
        execute = replay.replay if record else replay.unrecorded
        return execute(self._loaded, self.store, prefix, options, watch or (lambda progress: None), say or (lambda text: None))

    def proposal(self, plan: Plan, runner: str, *, detach: bool = False) -> Estimate | None:
        """What answering a plan would ask of a cluster: see `sierra.runners.cluster.estimate`. None where nothing would."""
        from sierra.execution import estimate

        return estimate.proposal(plan, self.stored(), runner, detach=detach)

    def status(self, prefix: str | None = None, *, say: Callable[[str], None] = lambda text: None) -> list[Standing]:
        """Return the state of cluster jobs, of all batches or of one. First, runs that have finished there are recorded."""
        from sierra.execution import status

        store = self.stored()
        return status.standing(store, prefix, say) if store else []

    def left(self, summary: Summary) -> list[Standing]:
        """What an asking has left to itself on clusters."""
        from sierra.execution import status

        found = (status.submitted(self.store.paths.session(session)) for session in summary.left)
        return [one for one in found if one is not None]

    def attach(
        self,
        prefix: str,
        *,
        figures: bool = True,
        watch: Watch | None = None,
        say: Callable[[str], None] | None = None,
        leave: Callable[[], bool] | None = None,
    ) -> Summary:
        """Reattach to a detached batch and wait for it; see `sierra.execution.takeover.follow`."""
        from sierra.execution import takeover

        summary = takeover.follow(
            self.store,
            prefix,
            watch or (lambda progress: None),
            say or (lambda text: None),
            leave or (lambda: True),
        )
        return self._drawn(summary) if figures else summary

    def cancel(self, prefix: str, *, say: Callable[[str], None] = lambda text: None) -> list[Cancelled]:
        """Cancel what is on a cluster of a batch; what had finished is kept. Raises NotFound where nothing is there."""
        from sierra.execution import takeover

        return takeover.cancel(self.store, prefix, say)

    def diff(self, before: str, after: str) -> Comparison:
        """What differs between two batches, experiments, runs or executions, by beginnings of their ids.

        What is likely to matter for results stands first: see `sierra.explain.diff.compare.Comparison`.
        Raises NotFound, UsageError.
        """
        from sierra.explain import diff

        return diff.compare(self._loaded, self.store, before, after)

    def why(self, prefix: str) -> Why:
        """Explain why runs were executed or not, which executions count, and what the query would execute now."""
        from sierra.explain import why

        return why.why(self._loaded, self.store, prefix)

    def pin(self, name: str | None = None) -> Contents:
        """Pin what an image's name stands for now (default: that of `[container] image`), in `sierra.lock`; what is in it.

        Raises Missing where there is none of that name, Damaged where it is not what it says to be; nothing is pinned then.
        """
        from sierra.containers import images

        return images.take(self.root, Store.create(self.paths.store).paths, self._image(name))

    def build_image(self, name: str | None = None, *, network: bool = False) -> Image:
        """Build an image from a folder of the project, its recipe, and return it. This does not pin it."""
        from sierra.containers.images import build

        return build.build(self.root, self._image(name), network=network)

    def import_image(self, file: str | os.PathLike[str], name: str = "") -> Contents:
        """Take an image's archive in, checked: into podman's storage, tagged `name`, where podman is; what is in it."""
        from sierra.containers.images import transfer

        return transfer.take_in(self.root, Store.create(self.paths.store).paths, Path(file), name)

    def export_image(self, name: str | None, file: str | os.PathLike[str]) -> Image:
        """Write an image, as it is pinned, to a file that loads elsewhere as the same image."""
        from sierra.containers.images import transfer

        return transfer.export(self.root, self._image(name), Path(file))

    def image(self, name: str | None = None) -> Contents:
        """What is in an image: as it is pinned, else as its name stands for it now."""
        from sierra.containers import images

        name = self._image(name)
        image = images.pins(self.root).get(name) or images.named(self.root, name)
        return images.examine(self.root, Store.create(self.paths.store).paths, image)

    def images(self) -> list[Known]:
        """The images that the project knows, and where they are: see `sierra.containers.images.listing.Known`."""
        from sierra.containers.images import listing

        named = [self.config.container.image] if self.config.container else []
        return listing.listing(self.root, StorePaths(self.paths.store), named)

    def _image(self, name: str | None) -> str:
        """Return an image's name as the project writes what was given, else the project's."""
        from sierra.containers.images import resolve

        own = self.config.container.image if self.config.container else ""
        if name is None and not own:
            raise UsageError(f'{self._loaded.file} names no image; name one here, or there: [container] image = "…"')
        return resolve.spelled(self.root, name, own) if name else own

    def push_sources(self, remote: str | None = None) -> list[Shared]:
        """Push the recorded sources, of submodules too, to a remote of git's: see `sierra.provenance.source.sharing`."""
        from sierra.provenance import source

        return source.share(self.root, "push", remote)

    def fetch_sources(self, remote: str | None = None) -> list[Shared]:
        """Fetch the sources that others have pushed, of submodules too: see `sierra.provenance.source.sharing`."""
        from sierra.provenance import source

        return source.share(self.root, "fetch", remote)

    def fsck(self, *, tell: Callable[[str], None] = lambda text: None) -> Report:
        """Check all that is recorded: see `sierra.maintenance.fsck.Report`. `tell` hears how far it has come."""
        from sierra.maintenance import fsck

        return fsck.check(StorePaths(self.paths.store), self.root, tell).report

    def repair(self, *, dry_run: bool = False, tell: Callable[[str], None] = lambda text: None) -> Repair:
        """Repair the store, and check it: see `sierra.maintenance.repair`. Nothing is deleted."""
        from sierra.maintenance import repair

        return repair.repair(StorePaths(self.paths.store), self.root, dry_run=dry_run, tell=tell)

    def removal(self, *prefixes: str) -> Removal:
        """What `remove` would delete of what these ids name: batches, experiments, runs, executions. Raises NotFound."""
        from sierra.maintenance import remove

        return remove.plan(self.store, prefixes)

    def remove(self, *prefixes: str, agree: Callable[[Removal], bool] = lambda removal: True) -> Removal | None:
        """Remove what these ids name, if `agree` says so of what that deletes; None where it does not.

        Runs that other batches have keep their executions. Raises NotFound, Missing where the disk is full, and SierraError
        while one of the batches is executing; nothing has changed then.
        """
        from sierra.maintenance import remove

        return remove.remove(self.store, prefixes, agree)

    def collection(self, *, damaged: bool = False, raw: bool = False) -> Collection:
        """What `collect` would remove: see `sierra.maintenance.gc.Collection`."""
        from sierra.maintenance import gc

        return gc.plan(self.store, damaged=damaged, raw=raw)

    def collect(
        self,
        *,
        damaged: bool = False,
        raw: bool = False,
        agree: Callable[[Collection], bool] = lambda collection: True,
    ) -> Collection | None:
        """Remove what nothing needs, and merge small segments, if `agree` says so of that; None where it does not.

        `damaged`: also what a repair put aside; `raw`: also the bytes of files that became tables. Raises Missing where the
        disk is full; nothing is lost then.
        """
        from sierra.maintenance import gc

        return gc.collect(self.store, damaged=damaged, raw=raw, agree=agree)

    def files(self, prefix: str, *paths: str, to: str | os.PathLike[str] | None = None) -> Listing | list[Outcome]:
        """The recorded files of what an id names; with `to`, written into that folder: what became of each.

        `paths` are those of the listing, or globs; all files without any. Raises NotFound for one that matches nothing.
        """
        from sierra.store import export

        listed = export.listing(self.store, prefix, paths)
        return listed if to is None else list(export.extract(self.store, listed, Path(to)))

    def figures(self, prefix: str | None = None, name: str | None = None) -> list[Path]:
        """Draw a batch's figures again (all, or the one called `name`); the files. Default: the batch last asked for."""
        return self.draw(prefix, name)[0]

    def draw(self, prefix: str | None = None, name: str | None = None) -> tuple[list[Path], list[str]]:
        """As `figures`; and what could not be drawn, and why."""
        return self._deliver(self.batch(prefix), name)

    def statistics(
        self,
        prefix: str | None,
        output: str,
        column: str,
        *,
        measure: str | None = "final",
        threshold: float | None = None,
        times: str | None = None,
    ) -> pa.Table:
        """All statistics of a column over the runs of each experiment of a batch: n, mean, sd, interval, median, ….

        Each run is reduced by `measure` (`final`, `mean`, or `time_to` a `threshold`) first; with `measure=None` there is
        a row for each experiment and time instead: the runs' `own` times, or common ones (`carry`: last values carried
        forward, `linear`: interpolated). `experiment` is its place in the batch; the values of the axes follow it. The
        schema's metadata say what was done, `sierra:sql`, and what is not in the numbers, `sierra:note`.
        """
        from sierra.deliverables import render

        return render.statistics(self._loaded, self.store, self.batch(prefix), output, column, measure, threshold, times)

    def batch(self, prefix: str | None = None) -> str:
        """The id of a batch, by a beginning of it; that of the batch last asked for without. Raises NotFound, Missing."""
        if prefix is not None:
            found = self.store.resolve(prefix)
            if found.kind != "batch":
                raise NotFound(f"{prefix!r} is a {found.kind}; only a batch will do here")
            return found.id
        known = self.batches
        if not known:
            raise Missing("no batch is recorded yet; sierra run makes one")
        batch: str = known[-1]["batch"]
        return batch

    def _probe(self, plan: Plan, store: Store, options: RunOptions) -> tuple[str, ...]:
        from sierra.replay import determinism  # and with it all that a replay needs

        return determinism.probe(plan, store, options)

    def _drawn(self, summary: Summary) -> Summary:
        """The same with figures, where there is something to draw."""
        if summary.interrupted or summary.left or summary.missing + summary.failed == summary.runs:
            return summary
        try:
            drawn, notes = self._deliver(summary.batch, again=False)
        except Missing as error:
            return replace(summary, undrawn=str(error))
        return replace(summary, figures=tuple(map(str, drawn)), notes=(*summary.notes, *notes))

    def _deliver(self, batch: str, name: str | None = None, *, again: bool = True) -> tuple[list[Path], list[str]]:
        from sierra.deliverables import render

        return render.figures(self._loaded, self.store, batch, name, again=again)


def _slots(jobs: int | None) -> int:
    """Runs at a time: as asked, as the user's settings say, or as many as there are usable cores."""
    from sierra.provenance.environment import usable_cores

    slots = (user.load().jobs or usable_cores()) if jobs is None else jobs
    if slots < 1:
        raise UsageError(f"{slots} runs at a time; ask for 1 or more")
    return slots
