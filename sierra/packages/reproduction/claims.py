"""The claims of a package, decided by the runs that were executed again.

A claim whose runs were all executed again is decided by their new values. These are the recorded ones if all outputs have the
same bytes. A claim of which any run was not executed again is decided by the recorded values alone, because a mix of
both would be the result of neither.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

from sierra.config.project_file import LoadedProject
from sierra.deliverables.claims import evaluate
from sierra.deliverables.claims.model import Evaluated, Ground
from sierra.deliverables.claims.registration import registrations
from sierra.errors import SierraError, UsageError
from sierra.packages.reading import received
from sierra.replay.compare_values import Verdict
from sierra.replay.verdicts import Replay
from sierra.store.store import Store
from sierra.util.text import like


def named(project: LoadedProject, names: Sequence[str]) -> tuple[str, ...]:
    """Return the names of these claims, by default of all. Raises UsageError for an unknown name."""
    known = list(project.config.claims)
    for name in names:
        if name not in known:
            raise UsageError(
                f"--claim: the package has no claim {name!r}; {like(name, known) if known else 'it has no claims'}"
            )
    return tuple(name for name in known if not names or name in names)


def rest(project: LoadedProject, store: Store, names: Iterable[str]) -> dict[str, tuple[str, ...]]:
    """Return the packed batches of the claims with these names, none for a claim without. Starts nothing of the package."""
    packed = received.batches(store)
    needed: dict[str, tuple[str, ...]] = dict.fromkeys(names, ())
    for name in needed:
        with contextlib.suppress(SierraError):  # the evaluation says why
            needed[name] = evaluate.batches(project, store, (name,), among=packed)[name]
    return needed


def decide(
    project: LoadedProject, store: Store, rests: Mapping[str, tuple[str, ...]], replays: Mapping[str, Replay]
) -> tuple[Evaluated, ...]:
    """Return the evaluation of claims, which rest on these batches, with its ground.

    `replays` are those, by batch, in which all runs with a result were executed again.
    """
    grounds = {name: _ground([replays.get(batch) for batch in batches]) for name, batches in rests.items()}
    changed = [session for replay in replays.values() if replay.verdict is not Verdict.IDENTICAL for session in replay.sessions]
    new = store.replayed(changed) if changed else store
    packed = received.batches(store)
    decided: dict[str, Evaluated] = {}
    for source, names in (
        (store, [name for name, ground in grounds.items() if ground is Ground.RECORDED]),
        (new, [name for name, ground in grounds.items() if ground is not Ground.RECORDED]),
    ):
        for claim in evaluate.evaluate(project, source, names, among=packed) if names else ():
            decided[claim.name] = replace(claim, ground=grounds[claim.name])
    registered = registrations(project, store, rests)  # by the recorded executions: repeating them plans nothing
    return tuple(replace(decided[name], registered=registered[name].word, registration=registered[name]) for name in rests)


def recorded(project: LoadedProject, store: Store, names: Sequence[str]) -> tuple[Evaluated, ...]:
    """Return the evaluation of claims by the recorded runs."""
    return tuple(evaluate.evaluate(project, store, list(names), among=received.batches(store))) if names else ()


def _ground(replays: Sequence[Replay | None]) -> Ground:
    """Return the ground of a claim from the complete replays of its batches, each None if there is none."""
    complete = [replay for replay in replays if replay is not None]
    if not complete or len(complete) < len(replays):
        return Ground.RECORDED
    if any(experiment.verdict is Verdict.EQUIVALENT for replay in complete for experiment in replay.experiments):
        return Ground.STATISTICALLY_REEXECUTED
    return Ground.REEXECUTED
