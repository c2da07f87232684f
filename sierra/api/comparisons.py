"""Comparisons of groups of runs."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from sierra.api.noun import Noun
from sierra.api.packages import IN_PACKAGE, batch_in_package
from sierra.config.deliverable_tables import Comparison
from sierra.config.validate import options
from sierra.deliverables import comparison, comparison_figure, comparison_text
from sierra.errors import NotFound, UsageError
from sierra.model import Measure
from sierra.store.store import Store


class Comparisons(Noun):
    """Comparisons of groups of runs: `project.comparisons`."""

    def make(
        self,
        *words: str,
        by: Sequence[str] = (),
        groups: Sequence[str] = (),
        column: str = "",
        table: str = "",
        measure: Measure | None = None,
        threshold: float | None = None,
        over_time: bool = False,
        method: str = "auto",
        paired: bool | Literal["auto"] = "auto",
        against: str | None = None,
        margin: float | None = None,
        alpha: float = 0.05,
    ) -> comparison.Compared:
        """Compare groups of runs: tests, effect sizes, intervals, and a paragraph of text with the conclusions.

        `words` are batches: prefixes of ids or names of queries in `sierra.toml`, also as `LABEL=PREFIX`. With one batch
        (default: the batch requested last), `by` is the variable whose values are compared; with several variables, the
        comparison is factorial. The other arguments are the keys of `[comparisons.NAME]`. Raises NotFound, UsageError, and
        SierraError if there is nothing to compare.

        >>> pair = project.comparisons.make(summary.batch, by=["population_size"]).pairs[0]
        >>> pair.first, pair.second, pair.verdict.value
        ('population_size=1', 'population_size=2', 'too few runs')
        """
        asked = requested(
            by=tuple(by),
            groups=tuple(groups),
            column=column,
            table=table,
            measure=measure,
            threshold=threshold,
            over_time=over_time,
            method=method,
            paired=paired,
            against=against,
            margin=margin,
            alpha=alpha,
        )
        return self._compared(words, asked)

    def declared(self, name: str, batch: str | None = None) -> comparison.Compared:
        """Make a comparison that `sierra.toml` declares in `[comparisons.NAME]`.

        `batch` is the batch within which values are compared; default: the last batch of the comparison's `query`, or else the
        batch requested last. Raises the errors of `make`, and NotFound for an unknown name.

        >>> project.comparisons.declared("noise")
        Traceback (most recent call last):
        sierra.errors.NotFound: ...
        """
        from sierra.util.text import like

        declared = self._project.config.comparisons
        if name not in declared:
            raise NotFound(f"sierra.toml has no [comparisons.{name}]; {like(name, list(declared))}")
        asked = declared[name]
        within = bool(asked.by) or not asked.groups
        if batch is not None and not within:
            raise UsageError(f"[comparisons.{name}] names its batches in groups; leave out the batch")
        if within and batch is None and asked.query:
            from sierra.execution.batches_of_queries import BatchesOfQueries

            batch = BatchesOfQueries(self._loaded, self._store).last(*asked.query)
        words = ((batch,) if batch else ()) if within else asked.groups
        return self._compared(words, requested(**asked.model_dump() | ({} if within else {"groups": ()})), name)

    def _compared(self, words: Sequence[str], asked: Comparison, name: str = "") -> comparison.Compared:
        groups, packaged = self._groups_with_packages(words)
        store = self._store if len(packaged) < len(groups) else next(iter(packaged.values()))
        return comparison.compare(self._loaded, store, name, groups, asked, packaged)

    def _groups_with_packages(self, words: Sequence[str]) -> tuple[dict[str, str], dict[str, Store]]:
        """Return the batches that words name, by group, and the stores of the groups that are in packages."""
        matches = {word: match for word in words if (match := IN_PACKAGE.fullmatch(word))}
        others = [word for word in words if word not in matches]
        own = self.groups(others) if others or not matches else {}
        rest, groups, packaged = iter(own.items()), dict[str, str](), dict[str, Store]()
        for word in words or own:
            if word in matches:
                label, path, prefix = matches[word].groups()
                group = label or Path(path).stem
                packaged[group], batch = batch_in_package(path, prefix, own.values())
            else:
                group, batch = next(rest)
            if group in groups:
                raise UsageError(f"two groups have the name {group!r}; give them different ones: LABEL=HASH")
            groups[group] = batch
        if len({(store.paths.root, groups[group]) for group, store in packaged.items()}) < len(packaged):
            raise UsageError("a batch cannot be compared with itself; name other batches, or one batch and --by VARIABLE")
        return groups, packaged

    def groups(self, words: Sequence[str]) -> dict[str, str]:
        """Return the batches that words name, by the names of their groups. Raises NotFound, UsageError.

        >>> len(project.comparisons.groups([summary.batch]))
        1
        """
        named = [self._project.records.labelled(word) for word in words] or [("", self._project.records.batch())]
        if len({batch for _, batch in named}) < len(named):
            raise UsageError("a batch cannot be compared with itself; name other batches, or one batch and --by VARIABLE")
        return comparison.labelled(self._loaded, self._store, named)

    def draw(self, compared: comparison.Compared) -> list[Path]:
        """Draw the figure of a comparison; return the files.

        >>> compared = project.comparisons.make(summary.batch, by=["population_size"])
        >>> sorted({path.suffix for path in project.comparisons.draw(compared)})
        ['.pdf', '.png', '.svg', '.tex', '.txt']
        """
        return comparison_figure.draw(compared, self._store, self._project.paths, self._project.config.figure_formats)

    def text(
        self,
        compared: comparison.Compared,
        format: str = "latex",
        *,
        figures: Sequence[str | os.PathLike[str]] = (),
        folder: str | os.PathLike[str] | None = None,
        caption: str = "",
        label: str = "",
    ) -> str:
        """Return a comparison as text for papers: `latex` (with booktabs), `markdown` or `html`.

        It has the table and the paragraph. With `figures`, the files of `draw`, it also has the figure, named
        relative to `folder` (default: the working directory). Raises UsageError.

        >>> compared = project.comparisons.make(summary.batch, by=["population_size"])
        >>> print(project.comparisons.text(compared, "markdown").splitlines()[0])
        | population size | difference | A12 | p | verdict |
        """
        relative_to = Path(folder) if folder is not None else None
        return comparison_text.text(compared, format, list(map(Path, figures)), relative_to, caption, label)


def requested(**keys: object) -> Comparison:
    """Return a comparison with these keys of `[comparisons.NAME]`; None leaves a key open. Raises UsageError."""
    return options(Comparison, {key: value for key, value in keys.items() if value is not None}, "the comparison")
