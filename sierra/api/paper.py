"""The folder of a paper, and tables for papers."""

from __future__ import annotations

from sierra.api.noun import Noun
from sierra.deliverables.claims import registration
from sierra.deliverables.paper import make
from sierra.deliverables.paper.folder import Written
from sierra.design.query.query_request import QueryRequest
from sierra.errors import Missing
from sierra.store.public_result import Result


class Paper(Noun):
    """The folder of a paper, and tables for papers: `project.paper`."""

    def queries(self) -> list[QueryRequest]:
        """Return the queries that figures, tables, comparisons and numbers of `sierra.toml` are bound to.

        `project.plans.resolve` plans them. Raises NotFound if there are none.

        >>> project.paper.queries()
        Traceback (most recent call last):
        sierra.errors.NotFound: ...
        """
        self._package()
        return make.requests(self._loaded)

    def _package(self) -> str:
        """Return the id of the package that `[paper]` names; "" if it names none. Raises Missing, Damaged."""
        from sierra.deliverables.paper.bound_files import named
        from sierra.packages import archive

        if not (name := self._project.config.paper.package):
            return ""
        if not (self._project.root / name).exists():
            raise Missing(f"[paper] package: {name} does not exist; make it by sierra package, or remove the key")
        with named("[paper]", "package"):
            return archive.identity(self._project.root / name)

    def write(self) -> Written:
        """Write the folder of the paper from the last batches of its queries: see `sierra.deliverables.paper`.

        Executes nothing. The result has the `changed`, `removed` and `edited` files; the latter are left as they are. Raises
        NotFound for a query that was not run, and SierraError for what cannot be made.

        >>> project.paper.write()
        Traceback (most recent call last):
        sierra.errors.NotFound: ...
        """
        if self._project.config.claims:
            registration.register(self._loaded, self._store)
        return make.make(self._loaded, self._store, self._package())

    def check(self) -> list[str]:
        """Return one line for each fault of the paper's folder, and for each query without a batch of the present code.

        Without a store, the files are compared with `provenance.json` alone. Raises NotFound if the paper was not made.

        >>> project.paper.check()
        Traceback (most recent call last):
        sierra.errors.NotFound: ...
        """
        stored = self._project.stored()
        try:
            return list(make.faults(self._loaded, stored, self._package() if stored else ""))
        except Missing as error:
            if (self._project.root / self._project.config.paper.package).exists():
                raise
            return [str(error), *make.faults(self._loaded, None, "")]

    def table(self, statistics: Result, format: str = "latex", *, caption: str = "", label: str = "") -> str:
        """Return statistics as the text of a table for papers: `latex` (with booktabs), `markdown` or `html`.

        `statistics` is the result of `project.statistics`, with chosen ones. Numbers are rounded to two significant digits of
        their uncertainty, as in `0.714 ± 0.021`. Headers have labels and units. Raises UsageError.

        >>> found = project.statistics(summary.batch, "swarm", "coverage", statistics=["mean"])
        >>> print(project.paper.table(found, "markdown").splitlines()[0])
        | population size | coverage |
        """
        from sierra.deliverables import paper_tables, run_statistics

        source = statistics.statistics if isinstance(statistics, run_statistics.StatisticsResult) else None
        return paper_tables.text(self._loaded, self._store, source, format, caption, label)
