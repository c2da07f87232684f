"""The normal form of a claim: everything that says what is claimed and how the runs decide it, without the layout of the file.

It has the sentence, the queries with their criteria and runs per experiment, and the keys that decide the claim, each without
those that have their default. It does not have the claim's name, nor where the paper shows it, nor what only matters for
comparisons with a baseline. Nothing of the project is read or started, so that it may be a received one.
"""

from __future__ import annotations

from sierra.config.claim_table import DECISIONS, Claim
from sierra.config.project_file import LoadedProject
from sierra.deliverables.claims import rests_on
from sierra.design.query import query_request
from sierra.execution.batches_of_queries import identity
from sierra.util.json_types import JsonView

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
