"""Registered claims: a claim that was recorded before any execution that counts for it began is planned, else exploratory.

Order is that of Lamport numbers (see `sierra.store.lamport_clock`). A session takes a higher number than all those that are
recorded or living. So an execution began after a registration if the number of its session is higher. Sessions with the same
number lived at the same time, and sessions that began first may execute runs later: in both cases the claim is exploratory. A
claim's text is read before the registration takes its number, so that nobody can see results in between.

The numbers of two stores cannot be compared. So a registration only counts for executions that were made in the same store:
those of this store, or those that came in the same package.

Also: the normal form of a claim, which says what is claimed and how the runs decide it, without the layout of the file.

It has the sentence, the queries with their criteria and runs per experiment, and the keys that decide the claim, each without
those that have their default. It does not have the claim's name, nor where the paper shows it, nor what only matters for
comparisons with a baseline. Nothing of the project is read or started, so that it may be a received one.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from datetime import UTC, datetime
from functools import cache, partial
from typing import NamedTuple

from sierra.config.claim_table import DECISIONS, Claim
from sierra.config.project_file import LoadedProject
from sierra.deliverables.claims import rests_on
from sierra.deliverables.claims.model import Registered, Registration
from sierra.design.query import condition, query_request
from sierra.errors import DamagedFile, SierraError
from sierra.execution.batches_of_queries import identity
from sierra.execution.sessions import Session
from sierra.store.batch_data import BatchData
from sierra.store.claim_records import NO_BATCH, claim_id
from sierra.store.lamport_clock import number_of, stamp
from sierra.store.row_types import RegisteredClaimRow
from sierra.store.store import Store
from sierra.util.json_types import JsonView
from sierra.util.lazy_definitions import dataclass
from sierra.util.text import counted, one_line

OF_BASELINES = ("better", "regression")
"""The keys of a value that are only used with a baseline."""


def normal_form(project: LoadedProject, claim: Claim) -> dict[str, JsonView]:
    """Return the normal form of a claim. Raises QueryError for a query that is not valid."""
    kind = next(name for name in DECISIONS if getattr(claim, name))
    decision = claim.model_dump(mode="json", include={kind}, exclude_defaults=True)[kind]
    if kind == "value":
        decision = {key: value for key, value in decision.items() if key not in OF_BASELINES}
    form: dict[str, JsonView] = {"says": " ".join(claim.says.split()), kind: decision}
    if claim.query:
        form["query"] = identity(project, rests_on.request_of(claim))
    else:
        form["batches"] = [_batch(project, word) for word in claim.batches]
    if claim.lost:
        form["lost"] = claim.lost
    if claim.plan_n:
        form["plan_n"] = claim.plan_n
    return form


def _batch(project: LoadedProject, word: str) -> dict[str, JsonView]:
    """Return the label and the query of a word of `batches`; for the prefix of an id, the prefix."""
    label, _, name = word.rpartition("=")
    if name in project.config.queries:
        return {"label": label or name, "query": identity(project, query_request.request([name]))}
    return {"label": label, "batch": name.lower()}


OWN = "SELECT DISTINCT claim FROM registered_claims ANTI JOIN imported_sessions USING (session)"
OF_PROJECT = "SELECT DISTINCT claim FROM registered_claims WHERE list_contains($claims, claim) OR list_contains($names, name)"
RECORDED = """
SELECT claim, name, epoch(registered) AS registered, lamport, packages
FROM registered_claims LEFT JOIN (SELECT session, packages FROM imported_sessions) USING (session)
"""
COUNTED = """
SELECT e.lamport, e.packages, count(DISTINCT e.execution) AS executions
FROM effective f JOIN all_judgements e USING (judgement)
WHERE f.batch = $batch AND ($ordinals IS NULL OR list_contains($ordinals, f.ordinal))
GROUP BY e.lamport, e.packages
"""
"""The executions that count in a batch, by their place in the logical order and by where they were made."""


class _Recorded(NamedTuple):
    claim: str
    name: str
    registered: float
    lamport: int
    packages: list[str] | None


class _Counted(NamedTuple):
    lamport: int
    packages: list[str] | None
    executions: int


@dataclass(frozen=True, slots=True)
class NewRegistrations:
    """The claims of a project, as they were registered now or before."""

    new: tuple[str, ...]
    """The names of those whose text was not recorded before."""
    known: tuple[str, ...]
    refused: Mapping[str, str]
    """The reasons why others cannot be registered, by name."""


def register(project: LoadedProject, store: Store) -> NewRegistrations:
    """Record the claims of a project that are not recorded yet. Raises Missing if the store cannot be written."""
    forms: dict[str, Mapping[str, JsonView]] = {}
    refused: dict[str, str] = {}
    for name, claim in project.config.claims.items():
        try:
            forms[name] = normal_form(project, claim)
        except SierraError as error:
            refused[name] = one_line(error)
    ids = {name: claim_id(form) for name, form in forms.items()}
    known = set(store.values(str, OWN)) if ids else set()
    new = {name: identity for name, identity in ids.items() if identity not in known}
    if new:
        _record(store, {name: (identity, forms[name]) for name, identity in new.items()})
    return NewRegistrations(tuple(new), tuple(name for name in ids if name not in new), refused)


def _record(store: Store, claims: Mapping[str, tuple[str, Mapping[str, JsonView]]]) -> None:
    session = Session(store.paths, logged=False)
    try:
        session.take_number()
        writer = store.writer(session.paths.segment, NO_BATCH)
        position, now = stamp(session.number, session.id), datetime.now(UTC)
        writer.records(
            RegisteredClaimRow(identity, session.id, name, json.dumps(form, ensure_ascii=False, sort_keys=True), now, position)
            for name, (identity, form) in claims.items()
        )
        store.publish(writer)
    finally:
        session.close()


def recorded(project: LoadedProject, store: Store) -> set[str]:
    """Return the hashes of the recorded claims of a project: as they are now, and as they were before under these names."""
    if not project.config.claims:
        return set()
    ids = []
    for claim in project.config.claims.values():
        with contextlib.suppress(SierraError):  # its query is not valid
            ids.append(claim_id(normal_form(project, claim)))
    return set(store.values(str, OF_PROJECT, claims=ids, names=list(project.config.claims)))


def registrations(project: LoadedProject, store: Store, batches: Mapping[str, Sequence[str]]) -> dict[str, Registration]:
    """Return the registration of claims, by name; `batches` has the ids of the batches that decide each. Writes nothing."""
    known = sorted(store.select(_Recorded, RECORDED), key=lambda row: row.lamport)
    counted_in = cache(partial(_executions, project, store))
    return {name: _registration(project, name, known, ids, counted_in) for name, ids in batches.items()}


def _registration(
    project: LoadedProject,
    name: str,
    known: Iterable[_Recorded],
    batches: Sequence[str],
    counted_in: Callable[[str, str], Sequence[_Counted]],
) -> Registration:
    claim = project.config.claims[name]
    measured = claim.value or claim.tested
    try:
        identity = claim_id(normal_form(project, claim))
        executions = [row for batch in batches for row in counted_in(batch, measured.experiments if measured else "")]
    except DamagedFile:
        raise
    except SierraError as error:
        return Registration(reason=one_line(error))
    word, reason = _word([row for row in known if row.claim == identity], executions)
    history = [row for row in known if row.packages is None and (row.name == name or row.claim == identity)]
    first = f"{datetime.fromtimestamp(history[0].registered, UTC):%Y-%m-%d}" if history else ""
    return Registration(word, reason, identity, _changes([row.claim for row in history], identity), first, claim.plan_n)


def _changes(texts: Sequence[str], now: str) -> int:
    """Return how often a claim has changed; `texts` are the registered ones in their order, each when it was first seen."""
    seen = list(dict.fromkeys(texts))
    # A text that was registered before others was changed to these, and back again.
    return len(seen) - 1 + (seen[-1] != now) if now in seen else len(seen)


def _executions(project: LoadedProject, store: Store, batch: str, experiments: str) -> list[_Counted]:
    """Return the executions that count in the experiments of a batch that a condition selects; "": in all."""
    ordinals = None
    if experiments:
        with BatchData(store, batch) as frame:
            labels = {axis.name: project.config.labels(axis) for axis in frame.axes()}
            ordinals = sorted(condition.matching(experiments, frame.axes(), frame.cells(), "experiments", labels))
    return store.select(_Counted, COUNTED, batch=batch, ordinals=ordinals)


def _word(own: Sequence[_Recorded], executions: Sequence[_Counted]) -> tuple[Registered, str]:
    """Return the word for registrations of one text, and the reason in one line."""
    if not executions:
        if own:
            return Registered.UNDECIDED, "no execution counts for it yet"
        return Registered.MISSING, "register it by: sierra claims --register"
    total = sum(row.executions for row in executions)
    if not own:
        return Registered.EXPLORATORY, f"it is not registered, and {counted(total, 'execution')} counted before"
    first: dict[tuple[str, ...] | None, int] = {}
    for row in own:
        origin = _place(row.packages)
        first[origin] = min(first.get(origin, row.lamport), row.lamport)
    elsewhere = sum(row.executions for row in executions if _place(row.packages) not in first)
    before = sum(
        row.executions
        for row in executions
        if (origin := _place(row.packages)) in first and number_of(row.lamport) <= number_of(first[origin])
    )
    reasons = [f"{before} of {counted(total, 'execution')} began before it was registered"] if before else []
    if elsewhere:
        reasons.append(f"{elsewhere} of {counted(total, 'execution')} came from another store than its registration")
    if reasons:
        return Registered.EXPLORATORY, "; ".join(reasons)
    return Registered.PLANNED, f"it was registered before {counted(total, 'execution')} began"


def _place(packages: Sequence[str] | None) -> tuple[str, ...] | None:
    return None if packages is None else tuple(packages)
