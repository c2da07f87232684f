"""Dataclasses and regular expressions that are completed late behave as those of the standard library."""

from __future__ import annotations

import copy
import dataclasses
import inspect
import pickle
import re
import subprocess
import sys
import threading
from collections.abc import Callable
from typing import Any, ClassVar

import pytest

from sierra.model import Limits
from sierra.store.connections import _Open
from sierra.util.lazy_definitions import dataclass, regex

EITHER = pytest.mark.parametrize("made_by", [dataclass, dataclasses.dataclass])


def classes(made_by: Callable[..., Any]) -> tuple[Any, Any]:
    @made_by(frozen=True, slots=True)
    class Point:
        """A point."""

        x: int
        y: int = 2
        names: list[str] = dataclasses.field(default_factory=list)
        unseen: int = dataclasses.field(default=0, compare=False)
        KIND: ClassVar[str] = "point"

        @property
        def size(self) -> int:
            return self.x + self.y

    @made_by(frozen=True, slots=True)
    class Named(Point):  # type: ignore[misc, valid-type]
        """A point with a name."""

        y: int = 5
        name: str = "it"

    return Point, Named


@EITHER
def test_instances_have_their_defaults_text_and_pattern(made_by: Callable[..., Any]) -> None:
    point, named = classes(made_by)
    assert repr(named(1)).endswith("Named(x=1, y=5, names=[], unseen=0, name='it')")
    assert named(1).size == 6
    assert point(1).names is not point(1).names
    assert point.KIND == "point"
    match point(4, 3):
        case point(x, y):
            assert (x, y) == (4, 3)


@EITHER
def test_instances_are_equal_and_hashed_by_their_values(made_by: Callable[..., Any]) -> None:
    point, named = classes(made_by)
    assert point(1, unseen=3) == point(1, 2, [])
    assert point(1) != point(3)
    assert point(1) != named(1, 2)
    assert len({point(1, 2, ()), point(1, 2, ())}) == 1


@EITHER
def test_instances_cannot_be_changed_and_have_slots(made_by: Callable[..., Any]) -> None:
    point, _ = classes(made_by)
    one = point(1)
    with pytest.raises(dataclasses.FrozenInstanceError):
        one.x = 2
    assert not hasattr(one, "__dict__")


@EITHER
def test_the_functions_of_the_standard_library_take_them(made_by: Callable[..., Any]) -> None:
    point, named = classes(made_by)
    assert [field.name for field in dataclasses.fields(named)] == ["x", "y", "names", "unseen", "name"]
    assert dataclasses.is_dataclass(point)
    assert dataclasses.replace(point(1), y=9) == point(1, 9)
    assert dataclasses.asdict(point(1)) == {"x": 1, "y": 2, "names": [], "unseen": 0}
    assert copy.deepcopy(point(1, 2, ["a"])) == copy.copy(point(1, 2, ["a"]))


@EITHER
def test_wrong_arguments_are_refused(made_by: Callable[..., Any]) -> None:
    point, _ = classes(made_by)
    for _ in range(2):
        with pytest.raises(TypeError, match="missing 1 required positional argument: 'x'"):
            point()
        with pytest.raises(TypeError, match="unexpected keyword argument 'z'"):
            point(1, z=1)


@EITHER
def test_instances_that_change_cannot_be_hashed(made_by: Callable[..., Any]) -> None:
    @made_by(slots=True)
    class Counter:
        """A number that grows."""

        count: int = 0

    one = Counter()
    one.count += 1
    assert one == Counter(1)
    with pytest.raises(TypeError, match="unhashable"):
        hash(one)


def test_many_threads_may_make_the_first_instance() -> None:
    for _ in range(50):
        point, named = classes(dataclass)
        start = threading.Barrier(4)
        made = []

        def make(kind: Any) -> None:
            start.wait()  # noqa: B023
            made.append(kind(1, names=["a"]))  # noqa: B023

        threads = [threading.Thread(target=make, args=(kind,)) for kind in (point, named, point, named)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert len(made) == 4
        assert all(one.names == ["a"] for one in made)


def test_all_methods_are_those_of_a_compiled_pattern() -> None:
    late, early = regex(r"(?P<name>[a-z]+)=(\d+)", re.IGNORECASE), re.compile(r"(?P<name>[a-z]+)=(\d+)", re.IGNORECASE)
    text = "A=1, b=22"
    assert late.findall(text) == early.findall(text)
    assert late.sub(r"\2", text) == "1, 22"
    assert [match["name"] for match in late.finditer(text)] == ["A", "b"]
    found = late.fullmatch("x=5")
    assert found is not None
    assert found[2] == "5"
    assert (late.pattern, late.flags, late.groups, dict(late.groupindex)) == (
        *(early.pattern, early.flags, early.groups),
        dict(early.groupindex),
    )


def test_patterns_of_bytes_match_bytes() -> None:
    assert regex(rb"\d").search(b"a1") is not None
    with pytest.raises(TypeError):
        regex(r"\d").search(b"a1")  # type: ignore[arg-type]


def test_a_wrong_pattern_is_an_error_when_it_is_used() -> None:
    with pytest.raises(re.error):
        regex("(").match("")
    with pytest.raises(AttributeError):
        regex("a").no_such_method  # type: ignore[attr-defined]  # noqa: B018


SENT = """
import inspect, pickle, sys
from sierra.model import Limits
from sierra.store.connections import _Open
kind, text = {"frozen": Limits, "changing": _Open}[sys.argv[1]], sys.stdin.buffer.read()
assert str(inspect.signature(kind)).startswith("(")
assert "arguments" not in str(inspect.signature(kind))
one = pickle.loads(text)
print(one == pickle.loads(text), repr(one))
"""


@pytest.mark.parametrize(("name", "made"), [("frozen", Limits(wall_s=2.0)), ("changing", _Open(None, ("a",), "b"))])  # type: ignore[arg-type]
def test_another_process_gets_an_instance_as_the_first_one_of_its_class(name: str, made: object) -> None:
    if name == "changing":
        made.rest = None  # type: ignore[attr-defined]
    argv = [sys.executable, "-c", SENT, name]
    done = subprocess.run(argv, input=pickle.dumps(made), capture_output=True, check=False)
    assert done.returncode == 0, done.stderr.decode()
    assert done.stdout.decode().strip() == f"True {made!r}"


def test_a_class_shows_its_parameters_before_the_first_instance() -> None:
    point, named = classes(dataclass)
    assert str(inspect.signature(named)).startswith("(x: 'int', y: 'int' = 5, names")
    assert str(inspect.signature(point)) == str(inspect.signature(classes(dataclasses.dataclass)[0]))


@dataclass(frozen=True, slots=True)
class Asked:
    x: int


class Heir(Asked):
    def __init__(self, z: int) -> None: ...


def test_a_signature_may_be_asked_for_twice_and_is_of_one_class() -> None:
    assert str(Asked.__signature__) == str(Asked.__signature__) == str(inspect.signature(Asked))  # type: ignore[attr-defined]
    assert [*inspect.signature(Asked).parameters] == ["x"]
    assert [*inspect.signature(Heir).parameters] == ["z"]
