"""Answers of `sierra init`: values from options, from the user and from the folder pass the same checks."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol, TypeVar

from sierra.errors import Missing
from sierra.util.lazy_definitions import dataclass

T = TypeVar("T")

NONE = "-"
"""The answer that rejects the value that was found."""
SHOWN = 12
"""The largest number of suggestions of a kind that are shown."""


@dataclass(frozen=True, slots=True)
class Options:
    """The values that options give; None, or empty, means that the value must be found out."""

    template: str | None = None
    format: str | None = None
    """The format of the template."""
    command: str | None = None
    seed: str | None = None
    variables: tuple[str, ...] = ()
    source: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Question:
    """A question to the user. Enter takes `default`; without a default, `missing` is the error if nobody can be asked."""

    text: str
    choices: tuple[str, ...] = ()
    default: str | None = None
    missing: str = ""


class Ask(Protocol):
    """A function that asks the user until the answer passes the check; it reports what is wrong with other answers."""

    def __call__(self, question: Question, check: Callable[[str], T]) -> T: ...


def checked_answer(given: str | None, question: Question, ask: Ask | None, check: Callable[[str], T]) -> T:
    """Return the checked value: the given one, or the answer, or the one found. Raises Missing if there is none."""
    if given is None and ask is not None:
        return ask(question, check)
    text = question.default if given is None else given
    if text is None:
        raise Missing(question.missing)
    return check(text)
