"""Pages that explore batches in the browser. `explorer` is the function for Python."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from sierra.api import Project
    from sierra.extensions.explorer.server import Server
    from sierra.packages.reading.received import Received


def explorer(project: Project, *, port: int = 0, write: bool = False, package: Received | None = None) -> Server:
    """Return a server on 127.0.0.1 for a page that explores batches; `url` is its address, `serve` answers until `close`.

    `port`: 0 takes a free one. With `write`, the page may add figures to `sierra.toml`. `package`: the package that this
    project belongs to; nothing of it is executed. Raises Missing for a port that is taken.
    """
    from sierra.api import Project
    from sierra.deliverables.report import make
    from sierra.extensions.explorer.answers import Answers
    from sierra.extensions.explorer.server import Server

    def source() -> make.ReportSource:
        """Return the batches with the project's file as it is now."""
        if package is None:
            return make.ReportSource(Project(project.root).loaded, project.store, project.comparisons.declared)
        from sierra.packages.reading import report

        return make.received(report.source(package))

    title = package.path.name if package else project.root.name
    return Server(Answers(source, project.store, writes=write), title, port)
