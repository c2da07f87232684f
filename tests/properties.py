"""Properties that few random examples check in the quick tier, and many in the nightly tier."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis.strategies import SearchStrategy

QUICK = 20
NIGHTLY = 500


def given_in_tiers(
    *strategies: SearchStrategy[Any], quick: int = QUICK
) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Return a decorator like `given`, whose test runs with `quick` examples, and once more with many in the nightly tier."""

    def decorated(test: Callable[..., None]) -> Callable[..., None]:
        def run(examples: int, **others: object) -> None:
            settings(max_examples=examples)(given(*strategies)(test))(**others)

        run.__name__, run.__doc__, run.__module__ = test.__name__, test.__doc__, test.__module__
        run.pytestmark = list(getattr(test, "pytestmark", []))  # type: ignore[attr-defined]
        kept = list(inspect.signature(test).parameters.values())[: -len(strategies)]
        parameter = inspect.Parameter("examples", inspect.Parameter.POSITIONAL_OR_KEYWORD)
        run.__signature__ = inspect.Signature([*kept, parameter])  # type: ignore[attr-defined]
        marked: Callable[..., None] = pytest.mark.parametrize(
            "examples", [quick, pytest.param(NIGHTLY, marks=pytest.mark.nightly)]
        )(run)
        return marked

    return decorated
