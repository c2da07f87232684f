"""Deliverables: figures, tables, errors of models and reports."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from sierra.api.noun import Noun
from sierra.deliverables import comparison, overlay, render
from sierra.deliverables.figures.formats import named
from sierra.errors import UsageError
from sierra.execution import targets as of_query
from sierra.execution.batches_of_queries import BatchesOfQueries

if TYPE_CHECKING:
    from sierra.deliverables.check import Checked, ShownDeliverable
    from sierra.deliverables.errors_of_models import ModelErrors
    from sierra.deliverables.report.files import Written


class Deliverables(Noun):
    """Figures, tables, errors of models and reports: `project.deliverables`."""

    def find(self, file: str | os.PathLike[str]) -> ShownDeliverable:
        """Return the record of a figure's file: what it shows, from which data, and whether it still follows from the store.

        The file is found by its content, so that it may have another name or be in another folder. Raises NotFound.

        >>> project.deliverables.find(project.deliverables.figures(summary.batch)[0]).problem is None
        True
        """
        from sierra.deliverables import check

        return check.find(self._loaded, self._store, Path(file), self._project.comparisons.declared)

    def figures(self, prefix: str | None = None, name: str | None = None, *, formats: Sequence[str] = ()) -> list[Path]:
        """Draw a batch's figures again (all, or the one called `name`); return the files. Default: the batch requested last.

        `formats` are of `png`, `pdf`, `svg`, `html` and `pgf`; default: those that `sierra.toml` declares. Raises NotFound,
        and UsageError for an unknown format.

        >>> sorted({path.suffix for path in project.deliverables.figures(summary.batch)})
        ['.pdf', '.png', '.svg', '.tex', '.txt']
        """
        return self.draw(prefix, name, formats=formats)[0]

    def draw(
        self, prefix: str | None = None, name: str | None = None, *, formats: Sequence[str] = ()
    ) -> tuple[list[Path], list[str]]:
        """Draw as `figures` does; return the files, and notes on figures that could not be drawn.

        Without a prefix, a figure or table called `name` that is bound to queries (`query` in `sierra.toml`) shows the last
        batches of these.

        >>> drawn, notes = project.deliverables.draw(summary.batch, formats=["html"])
        """
        if prefix is None and name is not None and (words := self._queries_of(name)):
            return self._draw_bound(name, words, formats)
        return self._deliver(self._project.records.batch(prefix), name, formats=formats)

    def _queries_of(self, name: str) -> Sequence[str]:
        """Return the queries that a figure or table is bound to."""
        declared = self._project.config.figures.get(name) or self._project.config.paper_tables.get(name)
        return declared.query if declared else ()

    def _draw_bound(self, name: str, words: Sequence[str], formats: Sequence[str]) -> tuple[list[Path], list[str]]:
        batches = comparison.of_queries(BatchesOfQueries(self._loaded, self._store), words)
        if len(batches) == 1:
            [batch] = batches.values()
            return self._deliver(batch, name, formats=formats)
        return render.overlaid(self._loaded, self._store, batches, name, overlay.BATCH, formats=named(formats))

    def check(self, prefix: str | None = None) -> list[Checked]:
        """Return whether each figure that was drawn of a batch still follows from the store. Default: the batch requested last.

        A figure's `problem` is None if its files are those that were drawn and the store gives the same data; else the reason.
        Tables, comparisons, reports and other deliverables are checked, too.

        >>> {checked.problem for checked in project.deliverables.check(summary.batch)}
        {None}
        """
        from sierra.deliverables import check

        return check.check(self._loaded, self._store, self._project.records.batch(prefix), self._project.comparisons.declared)

    def draw_batches(self, *words: str, name: str | None = None, formats: Sequence[str] = ()) -> tuple[list[Path], list[str]]:
        """Draw several batches together: in figures with a line for each batch, and in tables with the batches side by side.

        `words` are batches as in `project.comparisons.make`: prefixes or names of queries, also as `LABEL=PREFIX`, in the order
        of the lines. `name`: the only figure or table. Return the files, and notes on what could not be drawn. Raises NotFound,
        UsageError.

        >>> project.deliverables.draw_batches(summary.batch)
        Traceback (most recent call last):
        sierra.errors.UsageError: ...
        """
        if len(words) < 2:
            raise UsageError("name two batches or more, to draw them together")
        groups = self._project.comparisons.groups(words)
        return render.overlaid(self._loaded, self._store, groups, name, overlay.BATCH, formats=named(formats))

    def model_errors(self, prefix: str | None = None, name: str | None = None) -> ModelErrors:
        """Return how far `[models.NAME]` are from the data of a batch: all, or the one called `name`.

        `prefix` is that of the batch; None: the batch requested last. Commands of models are executed.

        `table` is an Arrow table with a row for each model and experiment: the values of the variables, the number `n` of runs,
        the number of `compared` points (times, for a model over time), the means of `data` and `predicted` over them, `bias`
        (mean of predicted − data), `rmse`, the `largest` deviation and the time `at` which it is. `intervals` is the number of
        compared points whose mean has a confidence interval, and `inside` the number of these intervals that contain the
        predicted value. Values have the unit of the column. `failed` has models without a prediction.

        Raises NotFound, or SierraError if the model called `name` fails.

        >>> project.deliverables.model_errors(summary.batch)
        Traceback (most recent call last):
        sierra.errors.NotFound: sierra.toml declares no [models.NAME]
        """
        from sierra.deliverables import errors_of_models

        return errors_of_models.errors(self._loaded, self._store, self._project.records.batch(prefix), name)

    def draw_targets(
        self, targets: Sequence[str], prefix: str | None = None, name: str | None = None, *, formats: Sequence[str] = ()
    ) -> tuple[list[Path], list[str]]:
        """Draw the last batches of one query for several targets together, in figures that have a line for each target.

        The query is that of the batch with this prefix; by default, the last one that was requested for any of the targets.
        Return the files, and notes on figures that could not be drawn. Raises UsageError if the runs are no pairs.

        >>> project.targets
        ()
        """
        of_query.check_names(targets)
        for target in targets:
            self._loaded.for_target(target)  # raises an error for an unknown one
        batch = self._project.records.batch(prefix) if prefix else None
        batches = overlay.batches(self._store, targets, batch)
        return render.overlaid(self._loaded, self._store, batches, name, formats=named(formats))

    def report(
        self,
        *words: str,
        every: bool = False,
        to: str | os.PathLike[str] | None = None,
        tell: Callable[[str], None] = lambda text: None,
    ) -> Written:
        """Write a report of batches: one page of HTML that needs nothing but itself: see `sierra.deliverables.report`.

        `words` are prefixes of batches' ids or names of queries; without any, the batch requested last. `every`: all batches;
        of more than 50, only the list. `to` is the file (default: one in `figures/reports`); it is replaced only if it is a
        report. `tell` receives the progress. Raises NotFound, UsageError for a file that is no report, Missing.

        >>> written = project.deliverables.report(summary.batch)
        >>> written.file.suffix, written.notes
        ('.html', ())
        """
        from sierra.deliverables.report import files, make, recorded

        if every and words:
            raise UsageError("--all is about all batches; leave out the others")
        source = make.ReportSource(self._loaded, self._store, self._project.comparisons.declared)
        records = self._project.records
        named_batches = [records.labelled(word)[1] for word in words]
        batches = [batch.batch for batch in reversed(self._project.batches)] if every else named_batches
        batches = list(dict.fromkeys(batches)) or [records.batch()]
        if to is not None:
            files.check(Path(to))
        report = make.of_batches(source, batches, tell, f"All batches of {self._project.root.name}" if every else "")
        file = files.default(self._project.paths, batches, every=every) if to is None else Path(to)
        files.write(file, recorded.named(report))
        notes = (*report.notes, *recorded.record(self._store, self._project.root, file, report))
        return files.Written(file, tuple(report.batches), notes)

    def _deliver(
        self, batch: str, name: str | None = None, *, again: bool = True, formats: Sequence[str] = ()
    ) -> tuple[list[Path], list[str]]:
        return render.figures(self._loaded, self._store, batch, name, again=again, formats=named(formats))
