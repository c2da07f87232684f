"""The input files that a platform generates for a run, without the simulator."""

from __future__ import annotations

from pathlib import Path

from sierra.config import project_file
from sierra.design.factorial_design import design
from sierra.design.platforms import base as platforms
from sierra.design.query import grammar
from sierra.model import Query
from sierra.templates import several

SEED = 7


def inputs(root: Path, *words: str) -> dict[str, str]:
    """Return the generated files of a run of the first experiment of a query, for the seed `SEED`."""
    project = project_file.load(root).config
    template, platform = several.of_project(project, root), platforms.find(project.platform, project)
    designed = design(Query(criteria=grammar.parse_all(words), runs=1), project, platform, template)
    cell = designed.cells[0]
    rendered = template.changed(cell.changes, cell.values).per_run(designed.per_run)({**cell.values, "seed": SEED, "run": 0})
    files = platform.files(rendered) if isinstance(rendered, bytes) else rendered
    return {name: content.decode() for name, content in files}
