"""The controllers and scenarios that a figure shows, and their order: its keys `controllers` and `scenarios`.

A word is a name, a label of `sierra.toml`, or a category: `depth0` stands for all names that begin with `depth0.`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from sierra.config.deliverable_tables import Figure
from sierra.errors import NotFound
from sierra.model import Value
from sierra.util.text import like

KEYS = {"controllers": "controller", "scenarios": "scenario"}
"""The keys of figures, and the variables that they choose values of."""


def of(figure: Figure) -> dict[str, tuple[str, ...]]:
    """Return the words of a figure, by its keys that have any."""
    given = {"controllers": figure.controllers, "scenarios": figure.scenarios}
    return {key: words for key, words in given.items() if words}


def values(key: str, words: Sequence[str], labels: Mapping[Value, Value]) -> tuple[Value, ...]:
    """Return the values that words stand for, in the order of the words, each once. `labels` has the label of each value.

    Raises NotFound for a word that stands for no value.
    """
    if not labels:
        raise NotFound(f"{key}: this batch has no {key}")
    chosen: dict[Value, None] = {}
    for word in words:
        named = _values(word, labels)
        if not named:
            known = list(dict.fromkeys(str(text) for pair in labels.items() for text in pair))
            raise NotFound(f"{key}: this batch has no {KEYS[key]} {word!r}; {like(word, known)}")
        chosen |= dict.fromkeys(named)
    return tuple(chosen)


def _values(word: str, labels: Mapping[Value, Value]) -> list[Value]:
    if word in labels:
        return [word]
    of_label = [value for value, label in labels.items() if label == word]
    return of_label or [value for value in labels if str(value).startswith(f"{word}.")]
