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
        numbers = {verdict: sum(claim.verdict == verdict for claim in self.shown) for verdict in Verdict}
        return {verdict: count for verdict, count in numbers.items() if count}


def find(project: LoadedProject, store: Store, batches: Sequence[str], among: Sequence[str] | None, *, every: bool) -> Claims:
    """Return the claims that rest on one of these batches, or all if `every`; `among` is as in `evaluate`."""
    if not project.config.claims:
        return Claims(())
    evaluations = evaluate.evaluate(project, store, among=among)
    shown = [evaluation for evaluation in evaluations if every or set(batches).intersection(evaluation.batches)]
    return Claims(shown, [evaluation.name for evaluation in evaluations if evaluation not in shown])


def section(project: LoadedProject, claims: Claims, headings: Place) -> Section | None:
    """Return the section about claims; None if the project has none."""
    if not claims.shown and not claims.others:
        return None
    lines = [_claim(evaluation, project.config.claims[evaluation.name], headings) for evaluation in claims.shown]
    if claims.others:
        text = "Claims of the project that rest on other batches, or on none that is recorded"
        lines.append(note(f"{text}: {few(claims.others, NAMED)}."))
    return Section("claims", "Claims", joined(lines))


def _claim(evaluation: Evaluated, claim: Claim, headings: Place) -> Markup:
    return element(
        "article",
        element(headings.inner, badge(evaluation.verdict.value, KINDS[evaluation.verdict]), " ", auto(evaluation.says)),
        element("p", evaluation.text, dir="auto", class_="numbers"),
        *map(note, evaluation.notes),
        facts(_facts(evaluation)),
        *_origin(evaluation, claim),
        class_="claim",
    )


def _facts(evaluation: Evaluated) -> dict[str, str]:
    tests = f"corrected for {counted(evaluation.tests, 'claim')} on this table of pairs (Holm)" if evaluation.tests else ""
    return {
        "name": evaluation.name,
        "registered": "; ".join(evaluation.registration.lines),
        "shown in": evaluation.shown,
        "runs": f"{evaluation.n}" if evaluation.n else "",
        "data": evaluation.ground.value,
        "p values": tests,
        "batches": ", ".join(map(short, evaluation.batches)),
    }


def _origin(evaluation: Evaluated, claim: Claim) -> Iterator[Markup]:
    if claim.sql:
        yield sql(claim.sql, summary="SQL that decides this")
        return
    declared = claim.model_dump_json(exclude_unset=True, by_alias=True, indent=1)
    yield details(f"How this is decided: by its {evaluation.kind}", code(declared, "the declaration"))
