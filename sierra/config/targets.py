"""Targets: the platforms of one project, as one table of `sierra.toml` for each.

A target is resolved before anything else looks at the project: its table is merged over the other keys, and the result is a
project without targets. The rules are:

- a key of the target replaces the key of the same name;
- a table, such as `limits` or `outputs`, is merged key by key, one level deep;
- `template`, `templates` and `template_format` belong together: a target that has one of the first two replaces all three;
- in `variables`, `controllers`, `scenarios` and `seed`, the table `targets.NAME` replaces the keys that make changes.

The functions work on tables as they are in the file. The models of `sierra.config.project_file` validate the result.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping

RawTable = Mapping[str, object]
"""A table that no model has validated yet."""
PER_TARGET: Mapping[str, tuple[str, ...]] = {
    "seed": ("set", "argument", "environment"),
    "variables": ("set", "changes", "argument", "environment"),
    "controllers": ("changes", "platform"),
    "scenarios": ("changes", "platform"),
}
"""By table with changes for each target, the keys of it that make changes."""
SHARED = (
    *("target", "targets", *PER_TARGET),
    *("runs", "controller", "scenario", "per_run", "queries", "equivalence", "determinism", "store"),
    *("tables", "sql", "figure_formats", "figures", "figure_defaults", "paper_tables"),
    *("comparisons", "comparison_methods", "criteria", "claims", "numbers", "paper", "plugins"),
)
"""Keys that no target has: those that ask a question are the same for all targets."""
TEMPLATES = ("template", "templates", "template_format")


def merged(table: RawTable, name: str) -> dict[str, object]:
    """Return the table of a project with the target called `name` merged over it, and without targets."""
    own = _table(_table(table.get("targets")).get(name))
    left_out = TEMPLATES if any(key in own for key in TEMPLATES[:2]) else ()
    kept = {key: value for key, value in table.items() if key not in left_out}
    result = {**kept, **{key: _over(kept.get(key), value) for key, value in own.items()}}
    for kind, keys in PER_TARGET.items():
        if kind in result:
            result[kind] = _of_target(result[kind], name, keys) if kind == "seed" else _each(result[kind], name, keys)
    return {**result, "targets": {}, "target": name}


def named(table: RawTable) -> Iterator[tuple[str, Collection[str]]]:
    """Yield each table that has changes for targets, by its place, with the names of these targets."""
    for kind in PER_TARGET:
        tables = {"": table.get(kind)} if kind == "seed" else _table(table.get(kind))
        for name, one in tables.items():
            if targets := _table(_table(one).get("targets")):
                yield (f"{kind}.{name}" if name else kind), targets.keys()


def _over(before: object, now: object) -> object:
    return {**before, **now} if isinstance(before, Mapping) and isinstance(now, Mapping) else now


def _each(tables: object, name: str, keys: Collection[str]) -> object:
    return {one: _of_target(table, name, keys) for one, table in tables.items()} if isinstance(tables, Mapping) else tables


def _of_target(table: object, name: str, keys: Collection[str]) -> object:
    """Return a table with the changes of one target, and without `targets`."""
    if not isinstance(table, Mapping) or "targets" not in table:
        return table
    own = {key: value for key, value in table.items() if key != "targets"}
    targets = _table(table["targets"])
    if name not in targets:
        return own
    now = targets[name]
    return {
        **{key: value for key, value in own.items() if key not in keys},
        **_table({"set": now} if isinstance(now, str) else now),
    }


def inner_table(table: object, *names: str) -> RawTable:
    """Return a table within another one by its path; an empty one if there is none."""
    return inner_table(_table(table).get(names[0]), *names[1:]) if names else _table(table)


def _table(value: object) -> RawTable:
    return value if isinstance(value, Mapping) else {}
