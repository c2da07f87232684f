"""Properties that few random examples check in the quick tier, many in the nightly tier, and others in each soak."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import pytest
from hypothesis import HealthCheck, Phase, given, seed, settings
from hypothesis.strategies import SearchStrategy

QUICK = 20
NIGHTLY = 500
PHASES = tuple(phase for phase in Phase if phase is not Phase.explain)
"""All phases except the one that explains a failure: tracing each line, it did not end in a process with many tests."""
ANY_SPEED = (HealthCheck.too_slow,)
"""Health checks that depend on the load of the machine."""


def given_in_tiers(
    *strategies: SearchStrategy[Any], quick: int = QUICK
) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Return a decorator like `given`, whose test runs with `quick` examples, and once more with many in the nightly tier."""

    def decorated(test: Callable[..., None]) -> Callable[..., None]:
        def run(examples: int, **others: object) -> None:
            settings(max_examples=examples, suppress_health_check=ANY_SPEED)(given(*strategies)(test))(**others)

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


@dataclass(frozen=True, slots=True)
class Property:
    """A claim about random values: a test, and one of `tests.soak.properties`."""

    name: str
    strategies: tuple[SearchStrategy[Any], ...]
    claim: Callable[..., None]

    def tests(self, quick: int = QUICK) -> Callable[..., None]:
        """Return the test of the claim in both tiers."""
        return given_in_tiers(*self.strategies, quick=quick)(self.claim)

    def check(self, chosen: int, examples: int) -> None:
        """Check examples that follow from a seed alone. Raises the error of the simplest example that fails."""
        setting = settings(
            max_examples=examples,
            database=None,
            deadline=None,
            suppress_health_check=ANY_SPEED,
            derandomize=False,
            phases=PHASES,
        )
        setting(seed(chosen)(given(*self.strategies)(self.claim)))()
