"""A figure inherits the keys of another figure or of defaults, and overrides some."""

from __future__ import annotations

import re
from typing import Any

import pytest

from sierra.config import project_file
from sierra.config.deliverable_tables import Figure
from sierra.errors import ConfigError

DEFAULTS = {"paper": {"size": "acm-column", "band": "sd", "palette": "grey"}}
COVERAGE = {"inherit": "paper", "kind": "summary", "table": "swarm", "column": "coverage"}


def figures(**tables: dict[str, Any]) -> dict[str, Figure]:
    project = {"template": "t.xml", "figure_defaults": DEFAULTS, "figures": tables}
    return dict(project_file.parse(project, "sierra.toml").figures)


def test_keys_are_inherited_along_a_chain_and_overridden() -> None:
    found = figures(last={"inherit": "first", "palette": "viridis"}, first=COVERAGE)
    assert (found["last"].columns, found["last"].size, found["last"].palette) == (("coverage",), "acm-column", "viridis")
    assert found["first"].palette == "grey"


def test_keys_that_belong_together_or_to_another_kind_are_not_inherited() -> None:
    timed = COVERAGE | {"measure": "time_to", "threshold": 0.5}
    found = figures(first=timed, final={"inherit": "first", "measure": "final"}, box={"inherit": "first", "kind": "box"})
    assert found["final"].threshold is None
    assert (found["box"].band, found["box"].threshold) == (None, 0.5)
    own = figures(first=COVERAGE, own={"inherit": "first", "sql": "FROM swarm"})["own"]
    assert (own.table, own.sql) == ("", "FROM swarm")
    scatter = {"kind": "scatter", "fit": "linear", "column": ["a", "b"]}
    assert not figures(first=scatter, box={"inherit": "first", "kind": "box", "column": "a"})["box"].own


@pytest.mark.parametrize(
    ("tables", "complaint"),
    [
        ({"a": {"inherit": "b"}, "b": {"inherit": "a"}}, "figures.b.inherit: a → b → a is a cycle"),
        ({"a": {"inherit": "papers"}}, "figures.a.inherit: there are no keys with the name 'papers'; did you mean 'paper'?"),
        ({"paper": {"inherit": "paper"}}, "figure_defaults.paper: a figure has this name"),
        ({"a": {"inherit": "paper", "banana": 1}}, "figures.a: unknown key 'banana'"),
    ],
)
def test_cycles_and_unknown_names_are_one_line(tables: dict[str, Any], complaint: str) -> None:
    with pytest.raises(ConfigError, match=re.escape(complaint)) as raised:
        figures(**tables)
    assert "\n" not in str(raised.value)


def test_a_mistake_in_defaults_is_found_where_a_figure_takes_them(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(DEFAULTS, "paper", {"sizze": "acm-column"})
    with pytest.raises(ConfigError, match=r"figures\.a: unknown key 'sizze'; did you mean 'size'\?"):
        figures(a={"inherit": "paper"})
