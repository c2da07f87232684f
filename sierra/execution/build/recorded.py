"""The recorded build of a batch's products, and its repetition in the restored source of a replay."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

from sierra.config.project_file import LoadedProject
from sierra.containers.engines.base import Engine
from sierra.containers.images.image import AnyImage
from sierra.containers.images.image import here as image_here
from sierra.execution import commands, row_queries
from sierra.execution.build.recipe import PLATFORM, Recipe, complete
from sierra.execution.build.state import BuildState
from sierra.execution.build_products import Product
from sierra.model import IN_PROJECT, Purpose, RunSpec
from sierra.provenance.dependency_model import Programs
from sierra.store.row_types import BuildProductRow, BuildRow
from sierra.store.store import Snapshot, Store
from sierra.util.lazy_definitions import dataclass, replace
from sierra.util.processors import here
from sierra.util.text import few

if TYPE_CHECKING:
    from sierra.execution.sessions import Session

SHOWN = 3


@dataclass(frozen=True, slots=True)
class RecordedBuild:
    """A build as it is recorded."""

    row: BuildRow
    products: tuple[Product, ...]
    programs: Programs

    @property
    def inputs(self) -> tuple[str, ...]:
        """Return the names of the project's files outside the source that the build used."""
        return tuple(one.name for one in self.programs.all if one.name.startswith(IN_PROJECT))

    def state(self, manifest: bytes) -> BuildState:
        """Return the state of the products if they are those of this build; `manifest` is that of its source."""
        return BuildState(replace(_recipe(self.row, manifest, None), programs=self.programs), self.products, None)


@dataclass(frozen=True, slots=True)
class Rebuilt:
    """The products that a replay built from the recorded source."""

    products: tuple[str, ...]
    different: tuple[str, ...]
    """Products whose bytes are not the recorded ones, or that only the record or only the replay has."""

    @property
    def text(self) -> str:
        """Return how the products differ from the record, in one line."""
        what = "products built from the recorded source differ from the record"
        return f"{what} (compilers may not be reproducible): {few(self.different, SHOWN)}"


FIND = """
SELECT b.* FROM builds b
WHERE b.source = $source AND b.purpose = 'run' AND b.result IS NOT NULL AND NOT EXISTS (
    SELECT 1 FROM build_products p WHERE p.build = b.build AND p.session = b.session AND NOT EXISTS (
        SELECT 1 FROM programs g WHERE g.programs = $programs AND g.name = '{project}/' || p.name AND g.sha256 = p.sha256
    )
)
ORDER BY b.lamport DESC LIMIT 1
"""
"""The last build of a source whose products are all among the programs of executions."""
PRODUCTS = "SELECT * FROM build_products WHERE build = $b AND session = $s ORDER BY name"


def find(snapshot: Snapshot, source: str | None, programs: str) -> RecordedBuild | None:
    """Return the build whose products executions used; None if none is recorded."""
    rows = snapshot.select(BuildRow, FIND, source=source, programs=programs) if source else []
    if not rows:
        return None
    made = snapshot.select(BuildProductRow, PRODUCTS, b=rows[0].build, s=rows[0].session)
    used = Programs(tuple(one.program() for one in row_queries.programs(snapshot, [rows[0].programs])))
    return RecordedBuild(rows[0], tuple(Product(row.name, row.size, row.sha256) for row in made), used)


def rebuild(
    recorded: RecordedBuild,
    manifest: bytes,
    project: LoadedProject,
    store: Store,
    session: Session,
    engine: Engine,
    image: AnyImage | None,
    *,
    on_robots: bool = False,
) -> Rebuilt:
    """Execute a recorded build in the restored source of a session, and record that. Raises SierraError if it fails.

    If it was for other processors, it is executed for this machine's too, unless runs are executed `on_robots`.
    """
    from sierra.execution.build.perform import Place, failure, perform, record

    table = project.config.build
    recipe = _recipe(recorded.row, manifest, table.wall if table else None)
    if recipe.processors and not on_robots:
        recipe = replace(recipe, processors=tuple(dict.fromkeys((*recipe.processors, here()))))
    inside = image_here(image)
    hosted = inside if engine.name == "none" else None
    if hosted is not None:
        variables = commands.within(hosted, recipe.spec.environment)
        recipe = replace(recipe, spec=replace(recipe.spec, environment=variables, image=None, host_access=()))
    root = session.paths.source
    recipe = complete(recipe, root, project.root, project.config.container if recipe.spec.image else None)
    location = Place(root, project, engine, None if hosted else inside)
    ended = perform(recipe, location, store, session)
    record(recipe, ended, location, store, session, batch=recorded.row.batch, purpose=Purpose.REPLAY)
    if ended.reason is not None:
        raise failure(ended, store, session)
    return _compared(recorded.products, ended.products)


def _recipe(row: BuildRow, manifest: bytes, wall: float | None) -> Recipe:
    spec = RunSpec(PLATFORM, tuple(row.command), json.loads(row.variables), row.source, row.image, tuple(row.host_access))
    return Recipe(spec, row.folder, tuple(row.produces), manifest, wall, tuple(row.processors or ()))


def _compared(recorded: tuple[Product, ...], made: tuple[Product, ...]) -> Rebuilt:
    was, now = ({one.name: one.sha256 for one in side} for side in (recorded, made))
    different = sorted(name for name in was.keys() | now.keys() if was.get(name) != now.get(name))
    return Rebuilt(tuple(now), tuple(different))
