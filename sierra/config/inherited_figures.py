"""Figures that inherit keys: `inherit = "NAME"` takes the keys of another figure, or of `[figure_defaults.NAME]`.

Keys of the figure itself come first. Keys that belong together are inherited together or not at all (`TOGETHER`): a figure with
its own `sql` does not inherit `table`. Keys of another kind are not inherited: a box does not take the `band` of a line.
"""

from __future__ import annotations

from collections.abc import Mapping

from sierra.config.deliverable_tables import Figure
from sierra.config.field_types import RawTable
from sierra.config.figure_options import CHOSEN
from sierra.util.text import like

TOGETHER = (("table", "sql"), ("measure", "threshold"), ("band", "quantiles"))
"""Keys that depend on each other."""
TIMESERIES = "timeseries"
SHARED = frozenset(field.alias or name for name, field in Figure.model_fields.items())


def resolved(figures: Mapping[str, object], defaults: Mapping[str, object]) -> dict[str, object]:
    """Return the tables of all figures with the keys that they inherit. Raises ValueError for an unknown name or a cycle."""
    if both := sorted(figures.keys() & defaults.keys()):
        raise ValueError(f"figure_defaults.{both[0]}: a figure has this name; use another name")
    return {name: _whole(name, figures, {**defaults, **figures}, ()) for name in figures}


def _whole(name: str, figures: Mapping[str, object], known: Mapping[str, object], children: tuple[str, ...]) -> object:
    """Return a table with inherited keys. `children`: the tables that inherit from it, the nearest last."""
    table = known[name]
    if not isinstance(table, Mapping) or not table.get("inherit"):
        return table
    parent, where = table["inherit"], f"{'figures' if name in figures else 'figure_defaults'}.{name}.inherit"
    if parent in (*children, name):
        raise ValueError(f"{where}: {' → '.join((*children, name, str(parent)))} is a cycle")
    if not isinstance(parent, str) or parent not in known:
        names = [other for other in known if other != name]
        raise ValueError(f"{where}: there are no keys with the name {parent!r}; {like(str(parent), names, 'known are')}")
    above = _whole(parent, figures, known, (*children, name))
    own = {key: value for key, value in table.items() if key != "inherit"}
    return {**_taken(above, own, of_figure=parent in figures), **own} if isinstance(above, Mapping) else own


def _taken(above: RawTable, own: RawTable, *, of_figure: bool) -> RawTable:
    """Return the keys that a figure takes from another table, `of_figure` or of defaults."""
    from sierra.config.plugin_registry import FIGURES

    replaced = {key for group in TOGETHER if own.keys() & set(group) for key in group}
    before = above.get("kind", TIMESERIES if of_figure else None)
    kind = own.get("kind", before or TIMESERIES)
    taken = {key: value for key, value in above.items() if key not in replaced}
    if not isinstance(kind, str) or kind not in FIGURES.shipped:
        return taken
    uses, options = FIGURES.load(kind).uses, FIGURES.load(kind).Options.model_fields
    foreign = {key for key in taken if key in CHOSEN and key not in uses}
    if "measure" in foreign:
        foreign.add("threshold")
    if before is not None and before != kind:
        foreign |= {key for key in taken if key not in SHARED and key not in options}
    return {key: value for key, value in taken.items() if key not in foreign}
