"""Graphs of an old project as figures and outputs.

| old                           | here                                              |
|-------------------------------|---------------------------------------------------|
| `stacked_line`                | one figure over time for each column              |
| `summary_line`, `summary`     | a summary of the last values                      |
| `heatmap` between experiments | a heatmap of the last values                      |
| others                        | listed                                            |

`src_stem` becomes an output, whose table has the same name with `_` for other characters.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping

from sierra.extensions.sierra1.old_project import OldProject
from sierra.extensions.sierra1.yaml_values import Plain
from sierra.util.lazy_definitions import dataclass, field, regex

Entry = dict[str, str | bool]
"""A table of `sierra.toml` with simple values."""
FILES = {
    "graphs.yaml": "",
    "intra-graphs-line.yaml": "intra-exp",
    "inter-graphs-line.yaml": "inter-exp",
    "intra-graphs-hm.yaml": "intra-exp",
    "inter-graphs-hm.yaml": "inter-exp",
}
"""Files with graphs; for those of older versions, the section that `graphs.yaml` has for them."""
OTHERS = {
    "inter-controller": "compare controllers by a query: sierra run VARIABLE.Log8 controller=ONE,TWO",
    "inter-scenario": "compare scenarios by a query: sierra run VARIABLE.Log8 scenario=ONE,TWO",
    "imagize": 'images of files for each tick; read such files as a table: file = "{stem}/{stem}-{{tick}}.csv" in [outputs.…]',
}
IGNORED = ("backend", "points", "legend")
"""Keys that only concern the look."""
LABELS = {"title": "title", "xlabel": "xlabel", "ylabel": "ylabel", "zlabel": "ylabel"}
_ESCAPED = regex(r"\\([#%&_])")


@dataclass(slots=True)
class Graphs:
    """Outputs and figures by name, and what cannot be carried over."""

    outputs: dict[str, Entry] = field(default_factory=dict)
    figures: dict[str, Entry] = field(default_factory=dict)
    left_out: list[str] = field(default_factory=list)


def graphs(old: OldProject, folder: str) -> Graphs:
    """Return the figures of a project; `folder` is the one in which runs write their files, or empty."""
    converted = Graphs()
    for file, section in FILES.items():
        content = old.section(file)
        for where, part in {section: dict(content)}.items() if section and content else content.items():
            if where in OTHERS:
                converted.left_out += _not_converted(file, where, part)
            elif where not in ("intra-exp", "inter-exp"):
                converted.left_out.append(f"{file}: {where}: unknown section")
            else:
                for name, graph in _each(part):
                    _add(converted, f"{file}: {where}: {name}", where, graph, folder)
    return converted


def _not_converted(file: str, where: str, part: Plain | None) -> Iterator[str]:
    for graph in part if isinstance(part, list) else [part]:
        stem = str(graph.get("dest_stem") or graph.get("src_stem") or "?") if isinstance(graph, dict) else "?"
        yield f"{file}: {where}: {stem}: {OTHERS[where].format(stem=stem)}"


def _each(part: Plain | None) -> Iterator[tuple[str, Plain]]:
    """Yield the graphs of a section with their names."""
    for category, items in part.items() if isinstance(part, dict) else ():
        inner = items.get("graphs", "") if isinstance(items, dict) else items
        for number, graph in enumerate(inner if isinstance(inner, list) else ()):
            stem = graph.get("dest_stem") if isinstance(graph, dict) else None
            yield f"{category}: {stem or number}", graph


def _add(converted: Graphs, where: str, section: str, graph: Plain, folder: str) -> None:
    if not isinstance(graph, dict) or not isinstance(graph.get("src_stem"), str):
        converted.left_out.append(f"{where}: it has no src_stem")
        return
    stem, columns = str(graph["src_stem"]), _columns(graph)
    kind = _kind(graph, section)
    if kind is None:
        converted.left_out.append(f"{where}: no figure of the type {graph.get('type', 'heatmap')!r} within an experiment")
        return
    if not columns:
        converted.left_out.append(f"{where}: it names no column; without [figures], each column gets figures")
        return
    if str(graph.get("index", "-1")) != "-1":
        converted.left_out.append(f"{where}: index {graph['index']} is not carried over; figures show the last value")
        return
    if (path := _file(stem, folder)) is None:
        converted.left_out.append(f"{where}: {stem!r} cannot be the name of a file of a run")
        return
    table = name(stem)
    converted.outputs.setdefault(table, {"file": path})
    for column in columns:
        _figure(converted, kind, table, column, graph)
    converted.left_out += [f"{where}: {key}: is not carried over" for key in graph if key not in _known()]
    if any(text.strip() and text not in columns for text in _texts(graph.get("legend"))):
        converted.left_out.append(f"{where}: legend: figures show the names of columns and the values of variables")


def _known() -> set[str]:
    return {*LABELS, *IGNORED, "src_stem", "dest_stem", "cols", "col", "type", "summary", "index", "logy"}


def _figure(converted: Graphs, kind: str, table: str, column: str, graph: Mapping[str, Plain]) -> None:
    labels = {key: text for old, key in LABELS.items() if (text := _label(graph.get(old)))}
    figure: Entry = {"kind": kind, "table": table, "column": column, **labels}
    if str(graph.get("logy", "false")).lower() in ("true", "yes", "on"):
        figure["log_y"] = True
    if any(same["kind"] == kind and same["table"] == table and same["column"] == column for same in converted.figures.values()):
        return
    suffix = "" if kind == "timeseries" else f"_{kind}"
    base = name(f"{table}_{column}{suffix}")
    free = (base, *(f"{base}_{number}" for number in range(2, len(converted.figures) + 3)))
    converted.figures[next(candidate for candidate in free if candidate not in converted.figures)] = figure


def _columns(graph: Mapping[str, Plain]) -> list[str]:
    return _texts(graph.get("cols")) or _texts(graph.get("col"))


def _texts(value: Plain | None) -> list[str]:
    return [item for item in (value if isinstance(value, list) else [value]) if isinstance(item, str) and item]


def _kind(graph: Mapping[str, Plain], section: str) -> str | None:
    """Return the kind of figure; None if there is no such kind here."""
    if str(graph.get("summary", "false")).lower() == "true" or graph.get("type") == "summary_line":
        return "summary"
    if graph.get("type", "stacked_line") == "stacked_line" and _columns(graph):
        return "timeseries"
    return "heatmap" if graph.get("type") == "heatmap" and section == "inter-exp" else None


def _file(stem: str, folder: str) -> str | None:
    path = f"{folder}/{stem}.csv" if folder else f"{stem}.csv"
    return path if re.fullmatch(r"[\w.-]+(/[\w.-]+)*", path) and ".." not in path.split("/") else None


def name(text: str) -> str:
    """Return a name for tables and figures."""
    plain = re.sub(r"[^A-Za-z0-9]+", "_", text).strip("_") or "output"
    return plain if plain[0].isalpha() else f"t_{plain}"


def _label(value: Plain | None) -> str:
    """Return a label; the characters that LaTeX needs escaped are not escaped here."""
    return _ESCAPED.sub(r"\1", value).strip() if isinstance(value, str) else ""
