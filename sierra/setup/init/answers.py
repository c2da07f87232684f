"""Each thing to say goes one way: what an option gives, what is answered, and what was found pass the same check."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, TypeVar

from sierra.errors import Missing

T = TypeVar("T")

NONE = "-"
"""The answer that refuses what was found."""
SHOWN = 12
"""How many of a kind are shown at most."""


@dataclass(frozen=True, slots=True)
class Options:
    """What is said beforehand; None, or empty, is what has to be found out."""

    template: str | None = None
    command: str | None = None
    seed: str | None = None
    variables: tuple[str, ...] = ()
    source: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Question:
    """What to ask. Enter takes `default`; without one, `missing` is what is wrong where nobody can be asked."""

    text: str
    choices: tuple[str, ...] = ()
    default: str | None = None
    missing: str = ""


class Ask(Protocol):
    """Asks somebody until the answer passes the check; says what is wrong with others."""

    def __call__(self, question: Question, check: Callable[[str], T]) -> T: ...


def settled(given: str | None, question: Question, ask: Ask | None, check: Callable[[str], T]) -> T:
    """What is given, or answered, or found, checked. Raises Missing where there is none."""
    if given is None and ask is not None:
        return ask(question, check)
    settling = question.default if given is None else given
    if settling is None:
        raise Missing(question.missing)
    return check(settling)
