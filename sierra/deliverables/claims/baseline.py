"""Baselines: the results of claims that later results are compared with, in a file that is committed with the project.

The file has all that a comparison needs, so a clone without the store can check its own runs against it. Like `sierra.lock`,
it is no part of the source, so a new baseline makes no run new.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Literal

from pydantic import Field

from sierra.config.claim_table import DECISIONS, Claim
from sierra.config.field_types import Finite, Table
from sierra.config.project_file import Project
from sierra.config.validate import options
from sierra.deliverables.claims.model import Evaluated
from sierra.errors import ConfigError, Missing, NotFound
from sierra.store.layout import BASELINES
from sierra.util.fs import write_whole
from sierra.util.regular_files import read_regular
from sierra.util.text import like

RESTS_ON = ("query", "controller", "scenario", "target", "batches")
JUDGED = ("expected", "margin", "better", "regression")
"""The keys of a value that judge it, and may change after the baseline was set."""


class ClaimInBaseline(Table):
    """The result of one claim in a baseline."""

    verdict: Literal["holds", "does not hold", "can't tell"] = Field(description="the verdict on the claim")
    text: str = Field(description="the numbers, in one line")
    n: int = Field(description="number of runs with a value")
    value: Finite | None = Field(None, description="the value, or the difference of two groups, in the column's unit")
    low: Finite | None = Field(None, description="lower end of the value's 95 % interval")
    high: Finite | None = Field(None, description="upper end of the value's 95 % interval")
    runs: Mapping[str, Finite] = Field(default_factory=dict, description="values of the runs, by seed")
    batches: tuple[str, ...] = Field((), description="ids of the batches that decided")
    decision: str = Field(description="how the claim was decided, as JSON: the keys of its table")


class Baselines(Table):
    """All baselines of a project."""

    format: Literal[1] = 1
    baselines: Mapping[str, Mapping[str, ClaimInBaseline]] = Field(
        default_factory=dict, description="results of claims, by name of the baseline and of the claim"
    )


def decision_of(config: Project, claim: Claim) -> str:
    """Return what a claim measures, as JSON: results of claims that measure something else cannot be compared."""
    how = next(kind for kind in DECISIONS if getattr(claim, kind))
    declared = claim.model_dump(mode="json", include={*RESTS_ON, how}, exclude_defaults=True)
    if claim.value:
        declared[how] = {key: value for key, value in declared[how].items() if key not in JUDGED}
    named = [word.rpartition("=")[2] for word in (*claim.query, *claim.batches)]
    queries = {
        name: config.queries[name].model_dump(mode="json", exclude={"runs"}, exclude_defaults=True)
        for name in named
        if name in config.queries
    }
    return json.dumps(declared | {"queries": queries}, sort_keys=True, ensure_ascii=False)


def read(root: Path, name: str) -> Mapping[str, ClaimInBaseline]:
    """Return the results in a project's baseline by claim. Raises NotFound, ConfigError."""
    every = _read(root / BASELINES).baselines
    if name not in every:
        hint = like(name, list(every), "there are") if every else f"set it by: sierra claims --keep {name}"
        raise NotFound(f"{BASELINES} has no baseline {name!r}; {hint}")
    return every[name]


def write(root: Path, name: str, config: Project, evaluations: Sequence[Evaluated]) -> Path:
    """Write evaluations to the project's baseline of this name; return the file. Raises ConfigError, Missing."""
    path = root / BASELINES
    known = _read(path).model_dump(mode="json", exclude_defaults=True).get("baselines", {})
    known[name] = {evaluation.name: _written(config, evaluation) for evaluation in evaluations}
    try:
        return write_whole(path, _text({"format": 1, "baselines": known}).encode())
    except OSError as error:
        raise Missing(f"{path}: cannot be written: {error.strerror}") from error


def _written(config: Project, evaluation: Evaluated) -> dict[str, object]:
    """Return the keys of a result that is in a baseline; numbers that are not finite are none."""
    values = {name: value for name, value in asdict(evaluation).items() if name in ClaimInBaseline.model_fields}
    kept = {name: value for name, value in values.items() if value not in ((), {}) and not _is_none(value)}
    return kept | {"verdict": str(evaluation.verdict), "decision": decision_of(config, config.claims[evaluation.name])}


def _is_none(value: object) -> bool:
    return value is None or (isinstance(value, float) and not math.isfinite(value))


def _text(content: object) -> str:
    """Return JSON with sorted keys, so that version control shows what has changed."""
    return json.dumps(content, indent=1, sort_keys=True, ensure_ascii=False, allow_nan=False) + "\n"


def _read(path: Path) -> Baselines:
    try:
        content = json.loads(read_regular(path))
    except FileNotFoundError:
        return Baselines()
    except OSError as error:
        raise Missing(f"{path}: cannot be read: {error.strerror}") from error
    except (ValueError, RecursionError) as error:
        raise ConfigError(f"{path.name} is not JSON: {error}") from error
    return options(Baselines, content, path.name)
