"""Make the folder of a paper, and check whether it still follows from the store."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

from sierra.config.project_file import LoadedProject
from sierra.deliverables.paper import bound_files, folder
from sierra.deliverables.paper.bound_files import PaperItem
from sierra.deliverables.paper.folder import PaperFile, PaperQuery, Provenance, Written
from sierra.deliverables.record import Recorder
from sierra.design.query.query_request import QueryRequest
from sierra.errors import DamagedFile, NotFound, SierraError, UsageError
from sierra.execution.batches_of_queries import BatchesOfQueries, command
from sierra.store.layout import PROVENANCE
from sierra.store.store import Store
from sierra.util.hashing import sha256, short

COMMIT = """
SELECT s.commit FROM sessions e JOIN sources s USING (source) WHERE e.batch = $b AND s.commit IS NOT NULL
ORDER BY e.lamport LIMIT 1
"""


def requests(project: LoadedProject) -> list[QueryRequest]:
    """Return the requests of all queries of the paper; each once. Raises NotFound if there are none."""
    if found := bound_files.requests(project.config):
        return found
    raise NotFound("nothing is bound to a query: give figures, tables or comparisons of sierra.toml the key `query`")


def path(project: LoadedProject) -> Path:
    """Return the folder of the paper."""
    return project.root / project.config.paper.folder


def make(project: LoadedProject, store: Store) -> Written:
    """Make the files of the paper from the last batches of its queries, and record them. Raises the errors of `items`.

    The files of a deliverable stay as they are if they show the same data in the same way, also if the batch is another one.
    """
    before = folder.read(path(project)) or Provenance()
    contents: dict[str, bytes] = {}
    files: dict[str, PaperFile] = {}
    made: list[tuple[PaperItem, list[str]]] = []
    for item in bound_files.items(project, store):
        kept = _kept(item, before, path(project))
        own = item.files() if kept is None else dict.fromkeys(kept, b"")
        if twice := sorted(own.keys() & files.keys()):
            raise UsageError(f"two deliverables of the paper have the file {twice[0]}; rename one of them: {item.name!r}")
        if kept is None:
            contents |= own
            made.append((item, [*own]))
        files |= kept or {name: _described(item, data) for name, data in own.items()}
    written = folder.write(path(project), Provenance(queries=_batches(project, store), files=files), contents)
    _record(project, store, made, {*written.edited})
    return written


def _kept(item: PaperItem, before: Provenance, place: Path) -> dict[str, PaperFile] | None:
    """Return the files of a deliverable if they exist and show the same data in the same way; else None."""
    known = {name: file for name, file in before.files.items() if (file.kind, file.name) == (item.content.kind, item.name)}
    same = all((file.data, file.definition) == (item.data, _definition(item)) for file in known.values())
    return known if known and same and not any(folder.faults(place, Provenance(files=known))) else None


def _described(item: PaperItem, data: bytes) -> PaperFile:
    """Return what `provenance.json` says about a file of a deliverable."""
    return PaperFile(
        sha256=sha256(data),
        kind=item.content.kind,
        name=item.name,
        batches=item.content.batches,
        data=item.data,
        definition=_definition(item),
    )


def _definition(item: PaperItem) -> str:
    """Return the hash of how a deliverable is made."""
    return sha256(json.dumps(item.content.definition, sort_keys=True, ensure_ascii=False).encode())


def _batches(project: LoadedProject, store: Store) -> dict[str, PaperQuery]:
    found = BatchesOfQueries(project, store)
    batches = {word: found.last(word) for word in bound_files.queries(project.config)}
    commits = {batch: next(iter(store.values(str, COMMIT, b=batch)), None) for batch in batches.values()}
    return {word: PaperQuery(batch=batch, commit=commits[batch]) for word, batch in batches.items()}


def _record(project: LoadedProject, store: Store, made: list[tuple[PaperItem, list[str]]], edited: set[Path]) -> None:
    """Record the files of each deliverable, so that a copy of any of them is known by its content."""
    root = path(project)
    recorders: dict[str, Recorder] = {}
    for item, names in made:
        batch = item.content.batches[0]
        recorder = recorders.setdefault(batch, Recorder(store, project.root, batch))
        own = tuple(root / name for name in names if root / name not in edited)
        if own:
            recorder.add(item.content, own)
    for recorder in recorders.values():
        recorder.close()


def faults(project: LoadedProject, store: Store | None) -> Iterator[str]:
    """Yield one line for each file that is missing, was edited, or shows other data than the store has; and for each query
    that has no batch of the present code.

    Without a store, the files are compared with `provenance.json` alone. Raises NotFound if the paper was not made.
    """
    place, shown = path(project), Path(project.config.paper.folder)
    provenance = folder.read(place)
    if provenance is None:
        raise NotFound(f"{shown / PROVENANCE} does not exist; make it with: sierra paper")
    yield from (f"{shown / name} {fault}" for name, fault in folder.faults(place, provenance))
    if store is not None:
        yield from dict.fromkeys(_old_queries(project, store))
        yield from _differences(project, store, shown, provenance)


def _old_queries(project: LoadedProject, store: Store) -> Iterator[str]:
    """Yield a line for each query that has no batch with the project as it is now."""
    found = BatchesOfQueries(project, store)
    for request in requests(project):
        text = " ".join(request.criteria)
        try:
            now, last = found.now(request), found.same(request)[-1:]
        except DamagedFile:
            raise
        except SierraError as error:
            yield f"query {text!r}: {error}"
            continue
        if not last:
            yield f"query {text!r} has not been run; run: {command(request)}"
        elif now is None:
            yield f"query {text!r} has not been run with the code as it is now; its last batch is {short(last[0])}"
        elif now != last[0]:
            yield f"query {text!r} was requested last with other code, as batch {short(last[0])}; make the paper again"


def _differences(project: LoadedProject, store: Store, place: Path, provenance: Provenance) -> Iterator[str]:
    """Yield a line for each file of a deliverable that shows other data now, and for those that are no longer made."""
    known: dict[str, tuple[str, str]] = {}
    try:
        for item in bound_files.items(project, store):
            known[f"{item.content.kind} {item.name}"] = item.data, _definition(item)
    except DamagedFile:
        raise
    except SierraError as error:
        yield f"{error}"
        return
    recorded = {f"{file.kind} {file.name}" for file in provenance.files.values()}
    for name, file in provenance.files.items():
        data, definition = known.get(f"{file.kind} {file.name}", (None, None))
        if data is None:
            yield f"{place / name}: sierra.toml no longer binds this {file.kind} to a query"
        elif data != file.data:
            yield f"{place / name} shows other data than the store has now"
        elif definition != file.definition:
            yield f"{place / name} is made otherwise now: sierra.toml or SIERRA has changed"
    yield from (f"{item} was not made for the paper yet" for item in known if item not in recorded)
