"""The section about the question: the query as it was written, and what it means in words."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

from sierra.deliverables.paper_tables import plain
from sierra.deliverables.report.batch_state import BatchState
from sierra.deliverables.report.parts import Section, auto, facts, filled_table
from sierra.model import Value
from sierra.util.html_elements import Markup, element, joined
from sierra.util.text import counted, few

SHOWN = 12
"""The largest number of values of a variable that are listed."""


def section(state: BatchState) -> Section:
    """Return the section about what the query asks."""
    row = state.shown.row
    lines = [element("p", in_words(state), class_="lead", dir="auto")]
    fixed = {
        "controller": _label(state, "controller", row.controller),
        "scenario": _label(state, "scenario", row.scenario),
        "targets": few(state.shown.targets, SHOWN),
        "set for all runs": joined(auto(override, "div") for override in row.overrides) if row.overrides else None,
    }
    written = element("code", state.query, dir="auto")
    lines.append(facts({"query as written": written, **fixed}))
    if row.axes:
        lines.append(_variables(state))
    lines += _outputs(state)
    return Section("question", "Question", joined(lines))


def in_words(state: BatchState) -> str:
    """Return the query as a sentence."""
    row = state.shown.row
    each = counted(row.runs // row.experiments, "run") if row.experiments and row.runs % row.experiments == 0 else ""
    size = f"{each} each" if each and row.experiments > 1 else each or f"{row.runs} runs in all"
    seeds = ", which differ in their seeds" if row.runs > row.experiments else ""
    size = f"{counted(row.experiments, 'experiment')} with {size}{seeds}."
    axes = values_of(state)
    if not axes:
        return f"How do results vary if only the seeds differ? {size}"
    varied = (f"{_label_of(state, name)} ({_with_unit(state, name, values)})" for name, values in axes.items())
    return f"How do results depend on {' and '.join(varied)}? {size}"


def title(state: BatchState) -> str:
    """Return a short title: the variables that the query varies."""
    names = [_label_of(state, name) for name in state.shown.row.axes]
    return f"Effect of {' and '.join(names)}" if names else f"Query {state.query}"


def values_of(state: BatchState) -> Mapping[str, Sequence[Value]]:
    """Return the values of each variable, in the order of the batch."""
    rows = [experiment.values for experiment in state.shown.experiments]
    return {name: list(dict.fromkeys(row[name] for row in rows if name in row)) for name in state.shown.row.axes}


def _listed(values: Sequence[Value]) -> str:
    return few(list(map(str, plain(values))), SHOWN)


def _label_of(state: BatchState, name: str) -> str:
    declared = state.project.config.variables.get(name)
    return (declared.label if declared else "") or name.replace("_", " ")


def _with_unit(state: BatchState, name: str, values: Sequence[Value]) -> str:
    declared = state.project.config.variables.get(name)
    return f"{_listed(values)} {declared.unit}" if declared and declared.unit else _listed(values)


def _variables(state: BatchState) -> Markup:
    config = state.project.config
    rows = []
    for name, values in values_of(state).items():
        declared = config.variables.get(name)
        rows.append((name, declared.label if declared else "", declared.unit if declared else "", len(values), _listed(values)))
    return filled_table(("variable", "label", "unit", "number", "values"), rows, "What is varied", numbers=(3,))


def _outputs(state: BatchState) -> Iterator[Markup]:
    """Yield a table of the declared outputs, with the units of their columns."""
    rows = []
    for name, declared in state.project.config.outputs.items():
        units = [f"{column} [{unit}]" for column, unit in declared.units.items()]
        rows.append((name, declared.file, ", ".join(units)))
    if rows:
        yield filled_table(("table", "file of a run", "columns with a declared unit"), rows, "What is measured")


def _label(state: BatchState, kind: str, name: str | None) -> str | None:
    groups = state.project.config.controllers if kind == "controller" else state.project.config.scenarios
    variable = state.project.config.variables.get(kind)
    given = variable.labels if variable else {group: table.label for group, table in groups.items()}
    label = given.get(name or "", "")
    return f"{label} ({name})" if label else name
