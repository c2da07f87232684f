"""Evaluate the claims of a project on the recorded runs.

A claim that cannot be evaluated is not an error: its verdict is that nothing can be told, with the reason, and the other claims
are still evaluated.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from functools import partial
from typing import NamedTuple, TypeVar

from sierra.config.claim_table import DECISIONS, Claim
from sierra.config.project_file import LoadedProject
from sierra.deliverables.claims import by_sql, by_test, by_value
from sierra.deliverables.claims.by_test import Family, Tested
from sierra.deliverables.claims.model import ClaimResult, Evaluated, Ground, Registration, Verdict
from sierra.deliverables.claims.pair_tables import PairTables, Prepared, families
from sierra.deliverables.claims.registration import registrations
from sierra.deliverables.claims.rests_on import BatchesOfClaims
from sierra.errors import DamagedFile, NotFound, SierraError, UsageError
from sierra.store.store import Store
from sierra.util.hashing import short
from sierra.util.text import like, one_line

R = TypeVar("R")
IMPORTED = "SELECT batch, packages[1] AS package FROM origins WHERE packages IS NOT NULL"
__all__ = ["Evaluated", "Ground", "Verdict", "batches", "evaluate"]


class _Imported(NamedTuple):
    """A batch whose executions that count came in a package."""

    batch: str
    package: str


def evaluate(
    project: LoadedProject,
    store: Store,
    names: Sequence[str] = (),
    *,
    ground: Ground = Ground.RECORDED,
    among: Sequence[str] | None = None,
) -> tuple[Evaluated, ...]:
    """Return the evaluation of the claims with these names, by default of all, in the order of `sierra.toml`.

    `ground` is the origin of the data in the store, which the caller knows. `among` has the ids of the batches that may decide,
    also if the project has changed since: see `rests_on`. p values are corrected for all claims of the project on the same
    table of pairs, also if only some are evaluated. Nothing is written. Raises NotFound for an unknown name, and if there are
    no claims.
    """
    chosen, every = _named(project, names), project.config.claims
    known = BatchesOfClaims(project, store, among)
    tested = [name for name, claim in every.items() if claim.tested]
    needed = {*chosen, *(() if chosen.keys().isdisjoint(tested) else tested)}
    tables = PairTables(project, store)
    rests: dict[str, tuple[str, ...]] = {}
    findings = {name: _find(project, store, known, tables, name, rests) for name in every if name in needed}
    concluded = _corrected(project, findings)
    imported = dict(store.select(_Imported, IMPORTED))
    registered = registrations(project, store, {name: rests.get(name, ()) for name in chosen})
    return tuple(
        _evaluated(name, claim, concluded[name], ground, rests.get(name, ()), imported, registered[name])
        for name, claim in chosen.items()
    )


def batches(
    project: LoadedProject, store: Store, names: Sequence[str] = (), *, among: Sequence[str] | None = None
) -> dict[str, tuple[str, ...]]:
    """Return the ids of the batches of each claim, by its name; `among` as in `evaluate`.

    Raises NotFound, which names a query that has to be run.
    """
    known = BatchesOfClaims(project, store, among)
    return {name: tuple(known.of(name, claim).values()) for name, claim in _named(project, names).items()}


def _named(project: LoadedProject, names: Sequence[str]) -> dict[str, Claim]:
    """Return the claims with these names; without names, all."""
    every = project.config.claims
    if not every:
        raise NotFound("sierra.toml declares no [claims.NAME]")
    if unknown := [name for name in names if name not in every]:
        raise NotFound(f"sierra.toml has no [claims.{unknown[0]}]; {like(unknown[0], list(every))}")
    return {name: claim for name, claim in every.items() if not names or name in names}


def _find(
    project: LoadedProject,
    store: Store,
    known: BatchesOfClaims,
    tables: PairTables,
    name: str,
    rests: dict[str, tuple[str, ...]],
) -> ClaimResult | Prepared:
    """Return the finding about a claim, or its pairs, which are tested with those of others; note the batches it rests on."""
    claim = project.config.claims[name]

    def find() -> ClaimResult | Prepared:
        own = known.of(name, claim)
        rests[name] = tuple(own.values())
        if claim.sql:
            return by_sql.find(store, name, claim, own)
        if claim.value:
            return by_value.find(project, store, claim, claim.value, own)
        if claim.tested:
            return tables.prepared(claim.tested, own)
        raise UsageError(f"[claims.{name}] says not how it is decided")  # the model of the table refuses that

    return _result_or_undecided(find)


def _result_or_undecided(find: Callable[[], R]) -> R | ClaimResult:
    """Return the result of a step; if it raises, the finding that nothing can be told, with the reason."""
    try:
        return find()
    except DamagedFile:
        raise
    except SierraError as error:
        return ClaimResult(Verdict.cannot_tell, one_line(error))


def _corrected(project: LoadedProject, findings: Mapping[str, ClaimResult | Prepared]) -> dict[str, ClaimResult]:
    """Return the findings, with the tests of each family corrected together; one that is not possible counts with p = 1."""
    prepared = {name: finding for name, finding in findings.items() if isinstance(finding, Prepared)}
    done = {name: finding for name, finding in findings.items() if isinstance(finding, ClaimResult)}
    for family, members in families(prepared):
        tests: dict[str, Tested] = {}
        for name, member in members.items():
            claim = project.config.claims[name]
            tested = _result_or_undecided(
                partial(by_test.test, project, claim, member.asked, member.runs, member.cells, family.tests)
            )
            if isinstance(tested, Tested):
                tests[name] = tested
            else:
                done[name] = tested
        done |= _concluded(tests, family)
    return done


def _concluded(tests: Mapping[str, Tested], family: Family) -> dict[str, ClaimResult]:
    if not tests:
        return {}
    from sierra.stats.comparison.rank_tests import holm

    adjusted = holm([*(tested.p for tested in tests.values()), *[1.0] * (family.tests - len(tests))])
    return {name: by_test.conclude(tested, p, family) for (name, tested), p in zip(tests.items(), adjusted, strict=False)}


def _evaluated(
    name: str,
    claim: Claim,
    finding: ClaimResult,
    ground: Ground,
    rests: tuple[str, ...],
    imported: Mapping[str, str],
    registration: Registration,
) -> Evaluated:
    shown = [f"figure {claim.figure}" if claim.figure else "", f"table {claim.table}" if claim.table else "", claim.paper]
    elsewhere = (
        f"batch {short(batch)} was not executed here: it came in package {short(imported[batch])}"
        for batch in rests
        if batch in imported
    )
    return Evaluated(
        **{field.name: getattr(finding, field.name) for field in fields(ClaimResult)} | {"notes": (*finding.notes, *elsewhere)},
        name=name,
        says=claim.says,
        shown=", ".join(filter(None, shown)),
        kind=next(kind for kind in DECISIONS if getattr(claim, kind)),
        ground=ground,
        batches=rests,
        registered=registration.word,
        registration=registration,
    )
