"""Reasons in words."""

from __future__ import annotations

from sierra.cli.render_reasons import BASES, new_runs
from sierra.execution.reasons import Basis
from sierra.explain.diff.model import changed
from sierra.explain.why_new_runs import NewRuns


def test_every_basis_has_words() -> None:
    assert set(BASES) == set(Basis)


def test_new_runs_are_compared_with_a_batch() -> None:
    differences = tuple(changed("query", "runs", 2, 3, called="runs per experiment"))
    lines = new_runs(NewRuns(Basis.BATCH, "abcdef0123456789", "n=1", differences))
    assert lines == ["compared with batch abcdef0123 (n=1):", "runs per experiment: 2 → 3"]
