"""Build the products for a plan before its runs execute: at most one process at a time, others wait for it.

The lock is in the store's folder. It names the session that builds: if that was killed, the next process ends what it left
running, and builds again, because a build is recorded only at its end.

A command such as make may find a product up to date by its times, although its content is wrong. Therefore older products
are moved aside while the command is executed, and are removed at its end. A file that the command did not make again is put
back; unless a build is known to have made it, this is an error, because it may be no product.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from sierra.containers import engines, images
from sierra.errors import ConfigError, SierraError
from sierra.execution import build_products, project_source, recover, resolve_plan
from sierra.execution.build.perform import Ended, Place, failure, perform, record
from sierra.execution.build.state import BuildState
from sierra.execution.observer import Observer
from sierra.execution.plan import Plan
from sierra.execution.sessions import Session, locked
from sierra.model import IN_PROJECT, Purpose
from sierra.provenance import source
from sierra.store.segments import disk_errors
from sierra.store.store import Store
from sierra.util.fs import inside
from sierra.util.hashing import sha256_file
from sierra.util.text import few
from sierra.worker.files import remove

SHOWN = 3
IGNORE = "name the code in [source] paths, or, in a git repository, add such files to .gitignore"


def ready(plan: Plan, store: Store, observer: Observer) -> Plan:
    """Return the plan with products that are up to date; build them if they are not.

    Raises SierraError if the build fails, ConfigError if products belong to the source, Missing if the disk is full.
    """
    if plan.build is None or plan.build.reason is None:
        return plan
    with _alone(plan, store, observer) as waited:
        recover.finish_dead(store, observer)
        other = _put_back(plan.project.root, store) or waited
        now = _planned_again(plan) if other else plan
        if now.build is None or now.build.reason is None:
            return now
        _build(now, now.build, store, observer)
        built = _planned_again(now)
    if built.batch.id != now.batch.id:
        raise SierraError(_other_batch(now, built))
    if built.build is None or built.build.reason is not None:
        because = "" if built.build is None else f": {built.build.reason}"
        raise SierraError(f"the build changes what it depends on, so its products would be built each time{because}")
    return built


def _planned_again(plan: Plan) -> Plan:
    """Return the same query planned with the current files."""
    again = resolve_plan.plan(plan.project, plan.request, engine=plan.engine.name)
    return replace(again, notes=(*dict.fromkeys((*again.notes, *plan.notes)),))


def _other_batch(plan: Plan, built: Plan) -> str:
    """Return why a build changed the ids of the runs, in one line."""
    was, now = plan.batch.spec.command, built.batch.spec.command
    words = [new.removeprefix(IN_PROJECT) for old, new in zip(was, now, strict=False) if old != new]
    if words:
        return f"the command names {words[0]!r}, which the build makes; add it to [build] produces"
    return "the project has changed while its products were built; run the command again"


@contextlib.contextmanager
def _alone(plan: Plan, store: Store, observer: Observer) -> Iterator[bool]:
    """Hold the lock of builds; yield True if another process held it before."""
    waited = False
    with disk_errors(store.paths.build):
        store.paths.build.mkdir(exist_ok=True)
        try:
            lock = locked(store.paths.build_lock, wait=False)
        except BlockingIOError:
            observer.notice("another process builds the products; waiting for it")
            waited = True
            lock = locked(store.paths.build_lock)
    try:
        _end_left(plan, store)
        yield waited
    finally:
        with contextlib.suppress(OSError):
            store.paths.build_lock.write_bytes(b"")
        if lock is not None:
            os.close(lock)


def _end_left(plan: Plan, store: Store) -> None:
    """End the containers of a build whose process was killed; `recover` ends its other processes."""
    with contextlib.suppress(OSError, ValueError, KeyError, TypeError, SierraError):
        left = json.loads(store.paths.build_lock.read_bytes() or b"{}")
        if left:
            engines.find(left["engine"], plan.project.config.engines).sweep([left["session"]])


def _build(plan: Plan, state: BuildState, store: Store, observer: Observer) -> None:
    """Execute the build of a plan and record it. Raises SierraError if it fails."""
    recipe, root = state.recipe, plan.project.root
    _check_outside(plan, state, [product.name for product in state.products])
    observer.notice(f"building, because {state.reason}")
    location = Place(root, plan.project, plan.engine, images.here(plan.image))
    session = Session(store.paths, logged=False)
    try:
        session.take_number()
        with disk_errors(store.paths.build):
            store.paths.build_lock.write_text(json.dumps({"session": session.id, "engine": plan.engine.name}))
        _move_aside(root, state, store)
        try:
            ended = _checked(plan, state, perform(recipe, location, store, session))
            ended = _really_built(_without_others(ended, root, store), state, store)
        finally:
            _put_back(root, store)
        record(recipe, ended, location, store, session, batch=plan.batch.id, purpose=Purpose.RUN)
        if ended.reason is not None:
            raise failure(ended, store, session)
    finally:
        session.close()


def _check_outside(plan: Plan, state: BuildState, names: list[str]) -> None:
    """Raise ConfigError if products belong to the source."""
    if held := build_products.in_source(names, source.paths(state.recipe.manifest)):
        raise ConfigError(
            f"[build] produces: {few(held, SHOWN)} would be part of the source, which products must not change; {IGNORE}"
        )


def _checked(plan: Plan, state: BuildState, ended: Ended) -> Ended:
    """Return the end of a build; as a failure, if the source is another one after it."""
    if ended.reason is not None:
        return ended
    changed = source.changed(state.recipe.manifest, project_source.code(plan.project, dirty="record").manifest)
    if not changed:
        return ended
    held = [one.name for one in ended.products if one.name in changed]
    what = f"its product {held[0]} is" if held else f"it changed the source ({few(changed, SHOWN)}): these files are"
    return replace(ended, reason=f"{what} part of the source, which a build must not change; {IGNORE}")


def _move_aside(root: Path, state: BuildState, store: Store) -> None:
    """Move older products out of the way of the command. A link stays; the file that it leads to is moved."""
    with disk_errors(store.paths.build_aside):
        for product in state.products:
            path = (root / product.name).resolve()
            if path.is_relative_to(root.resolve()) and path.is_file() and not _is_source(path, root, state):
                target = store.paths.build_aside / path.relative_to(root.resolve())
                target.parent.mkdir(parents=True, exist_ok=True)
                shutil.move(path, target)


def _is_source(path: Path, root: Path, state: BuildState) -> bool:
    return os.fsencode(path.relative_to(root.resolve())) in source.paths(state.recipe.manifest)


def _aside(store: Store) -> list[Path]:
    """Return the products that were moved aside, relative to the project."""
    aside = store.paths.build_aside
    return sorted(path.relative_to(aside) for path in aside.rglob("*") if path.is_file() and not path.is_symlink())


def _without_others(ended: Ended, root: Path, store: Store) -> Ended:
    """Remove older products that the build has made again, or that earlier builds made; any other file makes the build fail."""
    if ended.reason is not None:
        return ended
    known = set(store.values(str, "SELECT DISTINCT name || ' ' || sha256 FROM build_products"))
    others = []
    for name in _aside(store):
        old = store.paths.build_aside / name
        if (root / name).exists() or f"{name.as_posix()} {sha256_file(old)}" in known:
            old.unlink()
        else:
            others.append(name.as_posix())
    if not others:
        return ended
    what = f"{few(others, SHOWN)} matches produces, but the command did not make it"
    return replace(ended, reason=f"{what}; remove it, or make the pattern narrower")


OF_BUILD = "SELECT name || ' ' || sha256 FROM build_products WHERE build = $b"


def _really_built(ended: Ended, state: BuildState, store: Store) -> Ended:
    """Return the end of a build; as a failure, if the command gave products the bytes of files that no build made.

    A tool may keep a link to a product, or a copy. If the file was changed, moving it aside does not help.
    """
    recorded = set(store.values(str, OF_BUILD, b=state.recipe.id))
    if ended.reason is not None or not recorded:
        return ended
    now = {product.name: product.sha256 for product in ended.products}
    before = [product for product in state.products if now.get(product.name) == product.sha256]
    if not (same := [product.name for product in before if f"{product.name} {product.sha256}" not in recorded]):
        return ended
    what = f"the command left {few(same, SHOWN)} as it was, although it is not the file that was built from this source"
    return replace(ended, reason=f"{what}; let the command build everything (cmake --build … --clean-first)")


def _put_back(root: Path, store: Store) -> bool:
    """Move products that were moved aside back to where they were, unless there are newer ones; then remove the rest.

    Returns False if there is nothing to do.
    """
    aside = store.paths.build_aside
    if not aside.is_dir() or aside.is_symlink():
        return False
    with disk_errors(root):
        for name in _aside(store):
            target = inside(root, str(name), link=True)
            if not os.path.lexists(target):
                target.parent.mkdir(parents=True, exist_ok=True)
                shutil.move(aside / name, target)
    remove(str(aside))
    return True
