"""Conformance suite for ranges of criteria, as functions that a plug-in's author calls in tests.

    from sierra.testing import criteria as conformance

    def test_it_is_a_range():
        conformance.check("Primes", {"5": (2, 3, 5, 7, 11)}, refused=["", "0", "x"])

The package must be installed, because ranges are found by their name. `known` maps texts after the name to the right values.
`refused` are texts that mean nothing. Each claim is one function of a `Trial`, and can be called alone. A broken claim raises
AssertionError with one line, even if Python runs with `-O`.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

from sierra.config.field_types import RawTable
from sierra.config.plugin_registry import CRITERIA
from sierra.design.query import grammar, ranges
from sierra.errors import QueryError
from sierra.model import Criterion, Value
from sierra.testing.assertions import holds, says_what_its_options_are
from sierra.util.lazy_definitions import regex

NAME = regex(r"[A-Za-z_]+")
OTHER_PROCESS = """
import sys
sys.path[:] = {path!r}
from sierra.design.query import grammar
for text in {texts!r}:
    print(repr(grammar.parse(text, {tables!r})))
"""


@dataclass
class Trial:
    """A range to test, and the values that its texts mean."""

    name: str
    known: Mapping[str, tuple[Value, ...]]
    refused: Sequence[str] = ()
    options: RawTable = field(default_factory=dict)

    def parse(self, text: str) -> Criterion:
        """Return the criterion of a variable with this range, as a query has it."""
        return grammar.parse(f"x.{self.name}{text}", {self.name: self.options})


def check(
    name: str, known: Mapping[str, tuple[Value, ...]], refused: Sequence[str] = (), options: RawTable | None = None
) -> None:
    """Check all claims about the range `name`. `options` are those of `[criteria.NAME]`."""
    trial = Trial(name, known, refused, options or {})
    for claim in CLAIMS:
        claim(trial)


def declares_options(trial: Trial) -> None:
    """Check its name, its options, and that its example means something."""
    criterion = CRITERIA.load(trial.name)
    says_what_its_options_are(criterion)
    holds(NAME.fullmatch(trial.name) is not None, f"the name {trial.name!r} has other characters than letters and _")
    try:
        trial.parse(criterion.example)
    except QueryError as error:
        raise AssertionError(f"the example is refused: {error}") from error


def has_the_known_values(trial: Trial) -> None:
    """Check the values of each known text."""
    for text, expected in trial.known.items():
        found = ranges.values(trial.parse(text).scale)
        same = [type(value) for value in found] == [type(value) for value in expected] and found == expected
        holds(same, f"{trial.name}{text} has the values {found}, not {expected}")


def refuses_texts_in_one_line(trial: Trial) -> None:
    """Check that a text that means nothing raises QueryError with one line."""
    for text in trial.refused:
        try:
            values = ranges.values(trial.parse(text).scale)
        except QueryError as error:
            holds("\n" not in str(error), f"the message about {trial.name}{text} has several lines")
        except Exception as error:
            raise AssertionError(f"{trial.name}{text} raises {type(error).__name__}, not QueryError: {error}") from error
        else:
            raise AssertionError(f"{trial.name}{text} is not refused, but has the values {values}")


def is_repeatable(trial: Trial) -> None:
    """Check that the same texts have the same values and changes, also in another process with other hashes of texts."""
    texts = [f"x.{trial.name}{text}" for text in trial.known]
    here = [repr(trial.parse(text)) for text in trial.known]
    holds(here == [repr(trial.parse(text)) for text in trial.known], f"{trial.name} has other values the second time")
    code = OTHER_PROCESS.format(path=sys.path, texts=texts, tables={trial.name: dict(trial.options)})
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env={"PYTHONHASHSEED": "1"})
    holds(done.returncode == 0, f"{trial.name} fails in another process: {done.stderr[-300:]!r}")
    holds(done.stdout.splitlines() == here, f"{trial.name} has other values in another process")


CLAIMS: tuple[Callable[[Trial], None], ...] = (
    declares_options,
    has_the_known_values,
    refuses_texts_in_one_line,
    is_repeatable,
)
