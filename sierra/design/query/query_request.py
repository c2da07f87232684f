"""Query requests: research queries as programs and files hand them in.

`sierra run FILE.json` reads one, the JSON of a dry run contains one, and a recorded batch is repeated from one.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, Field, PositiveInt

from sierra.config.field_types import Table
from sierra.config.validate import options
from sierra.design.query.grammar import setting
from sierra.errors import Missing, UsageError
from sierra.util.quoted_values import words
from sierra.util.regular_files import read_regular
from sierra.util.text import half_character

SUFFIX = ".json"
KEY = "request"
"""The key of a request in the JSON of a dry run."""


class Override(Table):
    """A value that is set in the template of all runs."""

    xpath: str = Field(min_length=1, description="XPath 1.0 of the attributes or elements")
    value: str = Field(description="the new value; may contain {expressions}")


class QueryRequest(Table):
    """A research query: criteria, and the settings that all experiments share."""

    criteria: tuple[str, ...] = Field(min_length=1, description="a criterion for each axis, or names of queries in sierra.toml")
    runs: PositiveInt | None = Field(None, description="runs per experiment; default: the project's number")
    controller: str | None = Field(None, description="name of the controller; default: the project's")
    scenario: str | None = Field(None, description="name of the scenario; default: the project's")
    overrides: tuple[Override, ...] = Field((), description="values that are set in the template of all runs")
    target: str | None = Field(None, description="name of the target; default: the project's")


class RequestFile(BaseModel):
    """A file with a request: the JSON of a dry run. Other keys are ignored."""

    model_config = ConfigDict(frozen=True, title="query.json", defer_build=True)

    request: QueryRequest = Field(description="the query")
    batch: str | None = Field(None, description="id of the batch that the query expanded to")


def request(
    criteria: Iterable[str],
    *,
    runs: int | None = None,
    controller: str | None = None,
    scenario: str | None = None,
    sets: Iterable[tuple[str, str]] = (),
    target: str | None = None,
) -> QueryRequest:
    """Return a request; `sets` are pairs of XPath and value. Raises UsageError."""
    if runs is not None and runs < 1:
        raise UsageError(f"{runs} runs per experiment; request 1 or more")
    criteria, sets = tuple(criteria), tuple(sets)
    for text in (*criteria, controller, scenario, target, *(text for pair in sets for text in pair)):
        if text is not None and (character := half_character(text)):
            raise UsageError(f"{text!r}: {character!r} is no character of UTF-8")
    return QueryRequest(
        criteria=criteria,
        runs=runs,
        controller=controller,
        scenario=scenario,
        overrides=tuple(Override(xpath=path, value=value) for path, value in sets),
        target=target,
    )


def repeated(row: Mapping[str, Any], runs: int, target: str | None = None) -> QueryRequest:
    """Return the request that repeats a recorded batch, from its row of `batches` and the number of runs per experiment."""
    named = {name: row[name] for name in ("controller", "scenario") if name not in row["axes"]}
    return request(words(row["query"]), runs=runs, sets=map(setting, row["overrides"]), target=target, **named)


def read(path: Path) -> RequestFile:
    """Return the request in a JSON file, alone or in the JSON of a dry run. Raises Missing, UsageError."""
    try:
        return parse(read_regular(path), path)[0]
    except OSError as error:
        raise Missing(f"{path}: cannot be read: {error.strerror}") from error


def parse(data: bytes, path: Path) -> tuple[RequestFile, Mapping[str, Any]]:
    """Return the request in the content of a file, and everything in it. Raises UsageError."""
    try:
        content = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise UsageError(f"{path}: not JSON: {error}") from error
    if not isinstance(content, dict):
        raise UsageError(f'{path}: a request should be an object, as in {{"criteria": ["population_size.Log8"]}}')
    if KEY in content:
        return options(RequestFile, content, str(path)), content
    return RequestFile(request=options(QueryRequest, content, str(path)), batch=None), content
