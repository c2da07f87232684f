"""Differences of the code: first files, then the commits between, then the patch."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path

from sierra.errors import Damaged, NotFound
from sierra.explain.diff.load_sides import ComparedRuns
from sierra.explain.diff.model import ARROW, Difference
from sierra.provenance import commits_between, recorded_source_diff
from sierra.provenance.commits_between import Commits
from sierra.provenance.recorded_source_diff import File, State
from sierra.provenance.source import manifest, suggest_exclusions
from sierra.store.store import Store
from sierra.util.text import few

SHOWN = 8


def source(store: Store, root: Path, before: ComparedRuns, after: ComparedRuns) -> Iterator[Difference]:
    """Yield the difference of the two recorded sources."""
    was, now = before.spec.source, after.spec.source
    if was == now:
        return
    if was is None or now is None:
        parts = "not part of the identity before" if was is None else "no longer part of the identity"
        yield Difference("source", "tree", f"source: {parts}", was, now)
    else:
        yield _tree(store, root, before, after)


def _tree(store: Store, root: Path, before: ComparedRuns, after: ComparedRuns) -> Difference:
    was, now = before.spec.source, after.spec.source
    try:
        old, new = (_state(store, side) for side in (before, after))
    except (NotFound, Damaged) as error:
        why = "the list of files is not in the store" if isinstance(error, NotFound) else error
        return Difference("source", "tree", f"source: the files differ; {why}", was, now)
    if after.plan:  # its files are not in the store
        files = [_file(file) for file in recorded_source_diff.changed(old.manifest, new.manifest)]
        return Difference("source", "tree", _line(files), was, now)
    changed = recorded_source_diff.between(old, new, root, lambda blob: _blob(store, blob))
    commits = _commits(root, before, after)
    files = [_file(file, "content lost" if file.path in changed.unknown else "binary") for file in changed.files]
    line = f"{_line(files)}{_relation_text(commits, after)}"
    unknown = [f"{path}: its content is neither in git nor in the store" for path in changed.unknown]
    more = files if len(files) > SHOWN else ()
    return Difference(
        "source", "tree", line, was, now, lambda: (*more, *_logs(root, before, after, commits), *unknown, *changed.lines)
    )


def _line(files: Sequence[str]) -> str:
    count = "1 file differs" if len(files) == 1 else f"{len(files)} files differ"
    return f"source: {count}: {few(files, SHOWN)}"


def _state(store: Store, side: ComparedRuns) -> State:
    """Return the source of a side. Raises NotFound, Damaged."""
    if side.spec.source and side.plan and side.plan.source:
        return State(side.spec.source, side.plan.source.manifest)
    if side.spec.source is None or side.source is None:
        raise NotFound("the source is not recorded")
    return State(side.spec.source, store.object(side.source.files))


def _file(file: File, uncounted: str = "") -> str:
    """Return the name of a file, and how it differs; `uncounted` tells why its lines are not counted."""
    match file.what:
        case "renamed":
            return f"{file.was} {ARROW} {file.now}"
        case "submodule":
            return f"submodule {file.path} ({file.was[:10]} {ARROW} {file.now[:10]})"
        case "mode":
            return f"{file.path} (mode {file.was} {ARROW} {file.now})"
        case what:
            counts = f"+{file.added} −{file.removed}" if file.added is not None else ""
            parts = ", ".join(filter(None, ("" if what == "changed" else what, counts))) or uncounted
            return f"{file.path} ({parts})" if parts else file.path


def exclusions(store: Store, before: ComparedRuns, after: ComparedRuns) -> Iterator[Difference]:
    """Yield advice if the files that differ suggest to exclude them from the source."""
    if before.spec.source == after.spec.source:
        return
    with contextlib.suppress(NotFound, Damaged):
        old, new = (_state(store, side).manifest for side in (before, after))
        advice = suggest_exclusions.advice(map(os.fsencode, manifest.changed(old, new)), manifest.paths(new))
        if advice != suggest_exclusions.ONLY_SAID:
            yield Difference("source", "exclusions", advice)


def _blob(store: Store, blob: str) -> bytes | None:
    try:
        return store.blob(blob)
    except (NotFound, Damaged):
        return None


def _commits(root: Path, before: ComparedRuns, after: ComparedRuns) -> Commits:
    was, now = (_commit(side) for side in (before, after))
    return commits_between.between(root, was, now) if was and now and was != now else Commits()


def _relation_text(commits: Commits, after: ComparedRuns) -> str:
    """Return a text about the commits between both sides, and about uncommitted changes of the later one."""
    parts = []
    if commits.on:
        parts.append(f"{commits.on} commit{'s' * (commits.on > 1)} ahead")
    if commits.back:
        parts.append(f"{commits.back} commit{'s' * (commits.back > 1)} behind")
    if commits.missing:
        parts.append(f"commit {' and '.join(commit[:10] for commit in commits.missing)} not in this repository")
    if after.source and after.source.dirty:
        parts.append("with uncommitted changes")
    return f"; {', '.join(parts)}" if parts else ""


def _logs(root: Path, before: ComparedRuns, after: ComparedRuns, commits: Commits) -> Iterator[str]:
    was, now = str(_commit(before)), str(_commit(after))
    for sign, count, ends in (("+", commits.on, (was, now)), ("-", commits.back, (now, was))):
        if count:
            log = commits_between.listed(root, *ends)
            yield from (f"{sign} {commit}" for commit in log)
            if count > len(log):
                yield f"{sign} … {count - len(log)} more commits"
    if commits.on or commits.back:
        yield _relation(commits)


def _relation(commits: Commits) -> str:
    """Return a sentence on whether one of two commits is an ancestor of the other."""
    if not commits.back:
        return "the first commit is an ancestor of the second"
    if not commits.on:
        return "the second commit is an ancestor of the first"
    return f"neither commit is an ancestor of the other; common ancestor: {commits.base[:10] if commits.base else 'none'}"


def has_commits(before: ComparedRuns, after: ComparedRuns) -> bool:
    """Check whether the commits of both sides are recorded and their sources are the same."""
    return bool(before.source and after.source) and before.spec.source == after.spec.source


def commit(root: Path, before: ComparedRuns, after: ComparedRuns) -> Iterator[Difference]:
    """Yield a difference if the commits differ although the sources are the same."""
    was, now = (_commit(side) for side in (before, after))
    if was != now:
        commits = _commits(root, before, after)
        names = [f"{(_commit(side) or 'none')[:10]}{_branch(side)}" for side in (before, after)]
        line = f"commit: {names[0]} {ARROW} {names[1]}, the same files{_relation_text(commits, after)}"
        yield Difference("commit", "commit", line, was, now, partial(_logs, root, before, after, commits))


def _commit(side: ComparedRuns) -> str | None:
    return side.source.commit if side.source else None


def _branch(side: ComparedRuns) -> str:
    return f" ({side.source.branch})" if side.source and side.source.branch else ""
