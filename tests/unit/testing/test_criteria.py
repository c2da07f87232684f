"""The shipped ranges pass the conformance suite; ranges that break the contract do not."""

from __future__ import annotations

from pathlib import Path

import pytest

from sierra.testing import criteria as conformance
from tests import plugins

BROKEN = """
import random
from sierra.plugin import Computed, NoOptions, QueryError
class Base:
    contract, Options, example = 1, NoOptions, "2"
    def __init__(self, options): pass
class Chance(Base):
    def scale(self, text): return Computed.of(*random.sample(range(10**6), int(text)))
class Sets(Base):
    def scale(self, text): return Computed.of(*{f"v{k}" for k in range(int(text))})
class Floats(Base):
    def scale(self, text): return Computed.of(*(float(k) for k in range(int(text))))
class Twice(Base):
    def scale(self, text): return Computed.of(1, 1)
"""


@pytest.mark.integration
@pytest.mark.each_case
@pytest.mark.parametrize(
    ("name", "known", "refused"),
    [
        ("Log", {"1": (1,), "8": (1, 2, 4, 8)}, ["", "3", "x", "8.C2", "-8"]),
        ("Linear", {"100": tuple(range(10, 101, 10)), "6.C2": (3, 6)}, ["", "7.C2", "6.C", "0"]),
    ],
)
def test_a_shipped_range_fulfils_the_contract(name: str, known: dict[str, tuple[int, ...]], refused: list[str]) -> None:
    conformance.check(name, known, refused)


@pytest.mark.integration
@pytest.mark.parametrize(
    ("broken", "claim", "message"),
    [
        ("Chance", "is_repeatable", "has other values the second time"),
        ("Sets", "is_repeatable", "has other values in another process"),
        ("Floats", "has_the_known_values", r"has the values \(0.0, 1.0, 2.0\), not"),
        ("Twice", "declares_options", "the example is refused: .* 1 is listed twice"),
    ],
)
def test_a_range_that_breaks_the_contract_is_found(
    broken: str, claim: str, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(plugins.write(tmp_path, "broken_range", {f"sierra.criteria {broken}": broken}, BROKEN)))
    trial = conformance.Trial(broken, {"50": tuple(range(50))} if broken == "Sets" else {"3": (0, 1, 2)})
    with pytest.raises(AssertionError, match=message):
        getattr(conformance, claim)(trial)
