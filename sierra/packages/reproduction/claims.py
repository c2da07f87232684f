"""The claims of a package, decided by what was executed again.

A claim whose runs were all executed again is decided by their new values. These are the recorded ones if all outputs have the
same bytes. A claim of which any run was not executed again is decided by the recorded values alone, because a mix of
both would be the result of neither.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

from sierra.config.project_file import LoadedProject
from sierra.deliverables.claims import evaluate
from sierra.deliverables.claims.model import Evaluated, Ground
from sierra.errors import UsageError
from sierra.packages.reproduction.batches_of_claims import with_batches
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


@dataclass(frozen=True, slots=True)
class Rests:
    """The batches that claims rest on."""

    project: LoadedProject
    """The project, whose claims name these batches."""
    batches: Mapping[str, tuple[str, ...]]
    """The batches of each claim; none if the package does not have them."""
    unknown: Mapping[str, str]
    """The reason for each claim without batches."""


def rest(project: LoadedProject, store: Store, names: Iterable[str]) -> Rests:
    """Return the batches of the claims with these names. Executes nothing of the package."""
    project, unknown = with_batches(project, store)
    known = [name for name in names if name not in unknown]
    found: dict[str, tuple[str, ...]] = dict.fromkeys(names, ())
    for name in known:
        with contextlib.suppress(UsageError):  # the evaluation says why
            found[name] = evaluate.batches(project, store, (name,))[name]
    return Rests(project, found, unknown)


def decide(rests: Rests, store: Store, replays: Mapping[str, Replay]) -> tuple[Evaluated, ...]:
    """Return the evaluation of claims with its ground.

    `replays` are those, by batch, in which all runs with a result were executed again.
    """
    grounds = {name: _ground([replays.get(batch) for batch in batches]) for name, batches in rests.batches.items()}
    changed = [replay.id for replay in replays.values() if replay.verdict is not Verdict.IDENTICAL]
    new = store.replayed(changed) if changed else store
    found: dict[str, Evaluated] = {}
    for source, names in (
        (store, [name for name, ground in grounds.items() if ground is Ground.RECORDED]),
        (new, [name for name, ground in grounds.items() if ground is not Ground.RECORDED]),
    ):
        for one in evaluate.evaluate(rests.project, source, names) if names else ():
            text = rests.unknown.get(one.name, one.text)
            found[one.name] = replace(one, ground=grounds[one.name], text=text)
    return tuple(found[name] for name in rests.batches)


def _ground(replays: Sequence[Replay | None]) -> Ground:
    """Return the ground of a claim from the complete replays of its batches, each None if there is none."""
    complete = [one for one in replays if one is not None]
    if not complete or len(complete) < len(replays):
        return Ground.RECORDED
    if any(experiment.verdict is Verdict.EQUIVALENT for one in complete for experiment in one.experiments):
        return Ground.STATISTICALLY_REEXECUTED
    return Ground.REEXECUTED
