"""Notes of a replay about files that were not recorded."""

from __future__ import annotations

import pytest

from sierra.provenance import tracer
from sierra.replay.same_files import UsedFiles

UNKNOWN = UsedFiles(executions=2, observed=0, compared=0, changed=(), found=False)


@pytest.mark.parametrize(
    ("usable", "advice"),
    [("/usr/bin/strace", "(observe in sierra.toml records it)"), (None, "(that needs strace, which does not work here)")],
)
def test_observation_is_advised_only_where_it_works(monkeypatch: pytest.MonkeyPatch, usable: str | None, advice: str) -> None:
    monkeypatch.setattr(tracer, "usable", lambda: usable)
    assert UNKNOWN.words.endswith(advice)
