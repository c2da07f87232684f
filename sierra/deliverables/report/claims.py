"""The section about claims: the sentences of the paper, each with its verdict and the numbers that decide it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

from sierra.config.claim_table import Claim
from sierra.config.project_file import LoadedProject
from sierra.deliverables.claims import evaluate
from sierra.deliverables.claims.model import Evaluated, Verdict
from sierra.deliverables.report.parts import Place, Section, auto, badge, code, details, facts, note, sql
from sierra.store.store import Store
from sierra.util.hashing import short
from sierra.util.html_elements import Markup, element, joined
from sierra.util.lazy_definitions import dataclass
from sierra.util.text import counted, few

KINDS = {Verdict.holds: "good", Verdict.does_not_hold: "bad", Verdict.cannot_tell: "unclear"}
NAMED = 8


@dataclass(frozen=True, slots=True)
class Claims:
    """The claims that a report shows."""

    shown: Sequence[Evaluated]
    others: Sequence[str] = ()
    """The names of the project's claims that rest on other batches, or on none that is recorded."""

    @property
    def counts(self) -> Mapping[Verdict, int]:
        """Return the number of claims by verdict."""
        found = {verdict: sum(one.verdict == verdict for one in self.shown) for verdict in Verdict}
        return {verdict: count for verdict, count in found.items() if count}


def find(project: LoadedProject, store: Store, batches: Sequence[str], among: Sequence[str] | None, *, every: bool) -> Claims:
    """Return the claims that rest on one of these batches, or all if `every`; `among` is as in `evaluate`."""
    if not project.config.claims:
        return Claims(())
    found = evaluate.evaluate(project, store, among=among)
    shown = [one for one in found if every or set(batches).intersection(one.batches)]
    return Claims(shown, [one.name for one in found if one not in shown])


def section(project: LoadedProject, found: Claims, place: Place) -> Section | None:
    """Return the section about claims; None if the project has none."""
    if not found.shown and not found.others:
        return None
    lines = [_claim(one, project.config.claims[one.name], place) for one in found.shown]
    if found.others:
        text = "Claims of the project that rest on other batches, or on none that is recorded"
        lines.append(note(f"{text}: {few(found.others, NAMED)}."))
    return Section("claims", "Claims", joined(lines))


def _claim(one: Evaluated, claim: Claim, place: Place) -> Markup:
    return element(
        "article",
        element(place.inner, badge(one.verdict.value, KINDS[one.verdict]), " ", auto(one.says)),
        element("p", one.text, dir="auto", class_="numbers"),
        *map(note, one.notes),
        facts(_facts(one)),
        *_origin(one, claim),
        class_="claim",
    )


def _facts(one: Evaluated) -> dict[str, str]:
    tests = f"corrected for {counted(one.tests, 'claim')} on this table of pairs (Holm)" if one.tests else ""
    return {
        "name": one.name,
        "registered": "; ".join(one.registration.lines),
        "shown in": one.shown,
        "runs": f"{one.n}" if one.n else "",
        "data": one.ground.value,
        "p values": tests,
        "batches": ", ".join(map(short, one.batches)),
    }


def _origin(one: Evaluated, claim: Claim) -> Iterator[Markup]:
    if claim.sql:
        yield sql(claim.sql, summary="SQL that decides this")
        return
    declared = claim.model_dump_json(exclude_unset=True, by_alias=True, indent=1)
    yield details(f"How this is decided: by its {one.kind}", code(declared, "the declaration"))
