"""Resolving a request into a query: named queries, criteria, and the defaults of the project."""

from __future__ import annotations

import difflib

from sierra.config.project_file import LoadedProject
from sierra.design.query import grammar
from sierra.design.query.query_request import QueryRequest
from sierra.errors import QueryError
from sierra.execution import targets
from sierra.model import Query, Set
from sierra.util.lazy_definitions import regex

BARE = regex(r"[^\W\d]\w*")
"""Pattern of a word that is not a criterion, because it has no range."""


def target(project: LoadedProject, request: QueryRequest) -> str | None:
    """Return the target of a request: its own, or else that of the query in `sierra.toml` that it names; None for none."""
    named = (project.config.queries[word].target for word in request.criteria if word in project.config.queries)
    return request.target or next(filter(None, named), None)


def resolve(project: LoadedProject, request: QueryRequest) -> Query:
    """Return the query of a request, with the project's defaults; a name of a query in `sierra.toml` stands for its criteria.

    Raises QueryError.
    """
    project.check_written()
    config, words = project.config, request.criteria
    names = [word for word in words if word in config.queries]
    if len(names) > 1:
        raise QueryError(f"{names[0]!r} and {names[1]!r} are both named queries; use one of them, with more criteria if needed")
    for word in words:
        if word == grammar.MONTE_CARLO:
            raise QueryError(
                f"{word!r} needs a number of experiments, which differ only in their seeds; use, for example, {word}.C20"
            )
        if word not in names and BARE.fullmatch(word):
            close = difflib.get_close_matches(word, config.queries, 1, cutoff=0.5)
            hint = (
                f"; did you mean {close[0]!r}?" if close else f"; a criterion needs a range, such as {word}.Log8 or {word}=1,2"
            )
            raise QueryError(f"{word!r} is not a query in sierra.toml{hint}")
    named = config.queries[names[0]] if names else None
    spelled = [part for word in words for part in (named.criteria if named and word in names else (word,))]
    with project.plugins():
        query = Query(
            criteria=grammar.parse_all(spelled, config.criteria),
            runs=request.runs or (named and named.runs) or config.runs,
            controller=request.controller or (named and named.controller) or None,
            scenario=request.scenario or (named and named.scenario) or None,
            sets=tuple(Set(change.xpath, change.value, why=f"--set {change.xpath}") for change in request.overrides),
            base_seed=config.seed.base,
        )
        targets.check(project, query)
    return query
