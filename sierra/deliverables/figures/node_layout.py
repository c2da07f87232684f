"""Computed places of the nodes of a network, for figures and videos."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TypeAlias

from sierra.errors import NotInstalled
from sierra.util.text import natural

NAMED = 30
"""The largest number of nodes whose names are written."""
SEED = 1
EXTRA = "pip install 'sierra-experiments[figures]'"
Places: TypeAlias = "dict[str, tuple[float, float]]"


def layout(nodes: Iterable[str], edges: Iterable[tuple[str, str]], name: str) -> Places:
    """Return positions between -1 and 1, always the same for the same edges in the same order. Raises NotInstalled.

    The spring layout minimizes an energy, because networkx's other method draws each part of a network together to a point if
    the network has several parts.
    """
    try:
        import networkx
    except ImportError as error:
        raise NotInstalled(f"networkx is not installed; {EXTRA}") from error
    graph = networkx.Graph()
    graph.add_nodes_from(sorted(set(nodes), key=natural))
    graph.add_edges_from(edges)
    if name == "spring":
        positions = networkx.spring_layout(graph, seed=SEED, iterations=200, method="energy")
    else:
        positions = {"kamada_kawai": networkx.kamada_kawai_layout, "circular": networkx.circular_layout}[name](graph)
    return {node: (float(x), float(y)) for node, (x, y) in positions.items()}
