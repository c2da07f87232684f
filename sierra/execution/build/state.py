"""The state of a build: whether the products on disk are those that a recorded build made from the same inputs."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from pathlib import Path

from sierra.errors import NotFound
from sierra.execution import build_products, row_queries
from sierra.execution.build.recipe import Recipe
from sierra.execution.build_products import Product
from sierra.provenance import source
from sierra.provenance.dependency_model import Programs
from sierra.store.row_types import BuildProductRow, BuildRow
from sierra.store.store import Snapshot, Store
from sierra.util.lazy_definitions import dataclass
from sierra.util.text import few

SHOWN = 3


@dataclass(frozen=True, slots=True)
class BuildState:
    """A recipe, and whether its products are up to date."""

    recipe: Recipe
    products: tuple[Product, ...]
    """The files on disk that the patterns match."""
    reason: str | None
    """Why the products must be built, in one line; None if they are up to date."""


BUILDS = "SELECT * FROM builds WHERE purpose = 'run' ORDER BY lamport DESC"
OF_BUILD = "SELECT * FROM build_products WHERE build = $b AND session = $s ORDER BY name"
FILES = "SELECT files FROM sources WHERE tree = $t LIMIT 1"


def compare_products(recipe: Recipe, root: Path, store: Store | None) -> BuildState:
    """Compare the products on disk with the last build from the same inputs. Nothing is executed."""
    products = build_products.hashed(root, recipe.patterns)
    if store is None:
        return BuildState(recipe, products, "nothing has been built yet")
    with store.snapshot() as snapshot:
        builds = snapshot.select(BuildRow, BUILDS)
        same = [row for row in builds if row.build == recipe.id]
        if same and same[0].result is not None:
            built = snapshot.select(BuildProductRow, OF_BUILD, b=same[0].build, s=same[0].session)
            return BuildState(recipe, products, _difference(built, products))
        if same:
            return BuildState(recipe, products, "the last build failed")
        if not builds:
            return BuildState(recipe, products, "nothing has been built yet")
        return BuildState(recipe, products, few(list(_changes(recipe, builds[0], store, snapshot)), SHOWN))


def _difference(built: Sequence[BuildProductRow], products: Sequence[Product]) -> str | None:
    """Return how the products on disk differ from those of a build, in one line; None if they do not."""
    now = {product.name: product.sha256 for product in products}
    was = {row.name: row.sha256 for row in built}
    missing = [name for name in was if name not in now]
    changed = [name for name, digest in was.items() if name in now and now[name] != digest]
    additional = [name for name in now if name not in was]
    parts = (
        f"{few(names, SHOWN)} {singular if len(names) == 1 else plural}"
        for names, singular, plural in (
            (missing, "is missing", "are missing"),
            (changed, "is not the file that was built", "are not the files that were built"),
            (additional, "was not built, but matches produces", "were not built, but match produces"),
        )
        if names
    )
    return "; ".join(parts) or None


def _changes(recipe: Recipe, before: BuildRow, store: Store, snapshot: Snapshot) -> Iterator[str]:
    """Yield the inputs that differ from those of the last build."""
    spec = recipe.spec
    if before.source != spec.source:
        yield f"the source has changed{_files(recipe, before, store, snapshot)}"
    declared = (spec.command, recipe.folder, recipe.produces)
    if (tuple(before.command), before.folder, tuple(before.produces)) != declared:
        yield "[build] has changed"
    if tuple(before.processors or ()) != recipe.processors:
        yield f"products are needed for {', '.join(recipe.processors) or 'no processor in particular'}"
    if json.loads(before.variables) != dict(spec.environment):
        yield "declared variables have changed"
    if (before.image, tuple(before.host_access)) != (spec.image, spec.host_access):
        yield "the image has changed"
    if before.programs != recipe.programs.id:
        was = Programs(tuple(program.program() for program in row_queries.programs(snapshot, [before.programs])))
        yield f"programs have changed: {few(was.unlike(recipe.programs), SHOWN)}"


def _files(recipe: Recipe, before: BuildRow, store: Store, snapshot: Snapshot) -> str:
    """Return the names of the changed files of the source; nothing if the last source is not recorded."""
    recorded = snapshot.values(str, FILES, t=before.source)
    try:
        names = source.changed(store.object(recorded[0]), recipe.manifest) if recorded else []
    except NotFound:
        names = []
    return f" ({few(names, SHOWN)})" if names else ""
