"""The shipped platforms pass the conformance suite, and the suite detects a violation of each of its claims."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

import pytest
from pydantic import ConfigDict

from sierra.config import field_types, project_file
from sierra.config.change_tables import OWN_PLACEHOLDERS
from sierra.config.plugin_registry import PLATFORMS
from sierra.design import platforms
from sierra.design.platforms.base import Platform, Reader, Rendering
from sierra.design.platforms.command import Command
from sierra.design.query import grammar
from sierra.errors import ConfigError, TemplateError
from sierra.model import Add, Axis, Change, Criterion, Point, Remove, Rename, Set
from sierra.templates.xml import XmlTemplate
from sierra.testing import platforms as conformance

TEMPLATE = XmlTemplate(b'<arena size="1"><random seed="0"/></arena>', "t.xml")


def test_command_conforms() -> None:
    project = project_file.parse({"template": "t.xml", "command": "python3 sim.py {input} {seed}"}, "sierra.toml")
    conformance.gives_the_same_answers(Command, project, TEMPLATE, {})
    conformance.says_what_its_options_are(conformance.made(Command, project))
    conformance.checks_in_one_line(conformance.made(Command, project), TEMPLATE)
    conformance.changes_are_well_formed(conformance.made(Command, project), TEMPLATE)
    conformance.seed_changes_are_well_formed(conformance.made(Command, project))
    conformance.says_none_for_unknown_criteria(conformance.made(Command, project), TEMPLATE)
    conformance.describes_its_criteria(conformance.made(Command, project), {})
    conformance.command_is_argv_with_known_placeholders(conformance.made(Command, project))
    conformance.environment_is_of_no_machine(conformance.made(Command, project))
    conformance.files_are_safe(conformance.made(Command, project))


def test_the_suite_knows_all_placeholders_of_commands() -> None:
    assert set(OWN_PLACEHOLDERS) == conformance.COMMAND_PLACEHOLDERS


SPEED = grammar.parse("speed=1,2")
CHANGE = Set("/a/@b", "1", why="test")
Span = tuple[Axis, tuple[Point, ...]]


def span(*values: Any, name: str = "speed", changes: tuple[Change, ...] | None = None) -> Span:
    """Return an axis whose points set their value, unless other changes are given."""
    own = {value: (Set("/a/@speed", str(value), why="speed"),) if changes is None else changes for value in values}
    return Axis(name, values), tuple(Point(value, own[value]) for value in values)


class Sound:
    """A platform that conforms; each test breaks one of its answers."""

    Options: ClassVar[type[field_types.Table]] = field_types.Table

    def __init__(self, project: project_file.Project, options: object) -> None:
        """Make a platform."""

    def changes(self, template: Reader) -> tuple[Change, ...]:
        return (CHANGE,)

    def seed_changes(self) -> tuple[Change, ...]:
        return (Set("/a", "{seed}", attribute="seed", why="seed"),)

    def criterion(self, criterion: Criterion, template: Reader) -> Span | None:
        return span(1, 2) if criterion.name == "speed" else None

    def criteria(self) -> Mapping[str, str]:
        return {"speed": "how fast"}

    def check(self, document: Reader, template: Reader) -> None:
        pass

    def command(self) -> tuple[str, ...]:
        return ("sound", "{input}")

    def files(self, document: bytes) -> tuple[tuple[str, bytes], ...]:
        return (("input.xml", document), ("copy.xml", document))

    def environment(self) -> Mapping[str, str]:
        return {"SOUND_PATH": "{project}/lib"}


def check(make: type[Platform]) -> None:
    project = project_file.parse({"template": "t.xml", "platform": "sound"}, "sierra.toml")
    conformance.check(make, project, TEMPLATE, {"speed": SPEED})


def test_a_sound_platform_conforms() -> None:
    check(Sound)


@pytest.mark.parametrize(
    ("method", "answer", "complaint"),
    [
        ("changes", [CHANGE], "not <class 'tuple'>"),
        ("changes", ("/a/@b",), "'/a/@b' is str"),
        ("changes", (Set("", "1", why="x"),), "has no path"),
        ("changes", (Set("/a/@b", "1"),), "has no `why`"),
        ("changes", (Set("/a/@b", "1", why="two\nlines"),), "is not one line"),
        ("changes", (Set("/a/@b", 1, why="x"),), "1 is int"),  # type: ignore[arg-type]
        ("changes", (Remove("/a", expect=0, why="x"),), "expects less than one"),
        ("changes", (Set("/a/@b", "{seed + 1}", why="x"),), "uses the seed or the run"),
        ("changes", (Add("/a", "<b c='{run}'/>", why="x"),), "uses the seed or the run"),
        ("seed_changes", (CHANGE,), r"no seed change contains \{seed\}"),
        ("seed_changes", (Rename("/a", "b", why="x"),), "is not a Set"),
        ("criterion", span(1, 2), "not None"),
        ("criteria", {"speed": ""}, "has no description"),
        ("criteria", {"speed": "a\nb"}, "is not one line"),
        ("criteria", {"speed": "how fast", "top-speed": "how fast at most"}, "is not a valid column name"),
        ("criteria", {"speed": "how fast", "mass": "how heavy"}, "but there are examples of"),
        ("criteria", {}, "but there are examples of"),
        ("command", ["sound"], "not a tuple of texts"),
        ("command", "sound {input}", "not a tuple of texts"),
        ("command", ("sound", "a\0b"), "not a tuple of texts"),
        ("command", (), "names no program"),
        ("command", ("sound", "{inputs}"), "unknown placeholders"),
        ("environment", {"A B": "1"}, "not the name of a variable"),
        ("environment", {"A": 1}, "not a tuple of texts"),
        ("environment", {"A": "{output}"}, "unknown placeholders"),
        ("files", (), "returns no files"),
        ("files", [("a", b"")], "not <class 'tuple'>"),
        ("files", (("../a", b""),), "not a safe file name"),
        ("files", (("/a", b""),), "not a safe file name"),
        ("files", (("a\n", b""),), "not a safe file name"),
        ("files", (("..", b""),), "not a safe file name"),
        ("files", (("a", "text"),), "'text' is str"),
        ("files", (("a", b""), ("A", b"")), "two files have the same name"),
    ],
)
def test_an_invalid_answer_is_detected(method: str, answer: object, complaint: str) -> None:
    broken = type("Broken", (Sound,), {method: lambda self, *args: answer})
    with pytest.raises(AssertionError, match=complaint):
        check(broken)


def test_what_follows_may_be_missing_but_not_wrong() -> None:
    counted = itertools.count()
    check(type("Follows", (Sound,), {"follow": lambda self, *args: (CHANGE,)}))
    for follow, complaint in (
        (lambda self, *args: [CHANGE], "not <class 'tuple'>"),
        (lambda self, *args: (Set("/a/@b", "1"),), "has no `why`"),
        (lambda self, *args: (Set("/a/@b", str(next(counted)), why="x"),), "differs when it is called again"),
    ):
        with pytest.raises(AssertionError, match=complaint):
            check(type("Broken", (Sound,), {"follow": follow}))


@pytest.mark.parametrize(
    ("rendering", "complaint"),
    [
        (Rendering(("sound",), ""), "names no frames"),
        (Rendering((), "*.png"), "has no command"),
        (Rendering(("sound",), "*.png", lambda document: (Set("/a/@b", "1"),)), "has no `why`"),
    ],
)
def test_a_rendering_may_be_missing_but_not_wrong(rendering: Rendering, complaint: str) -> None:
    check(type("Renders", (Sound,), {"rendering": lambda self, *args: Rendering(("sound",), "*.png")}))
    with pytest.raises(AssertionError, match=complaint):
        check(type("Broken", (Sound,), {"rendering": lambda self, *args: rendering}))


@pytest.mark.parametrize(
    ("answer", "complaint"),
    [
        (None, "returns None"),
        (span(1, 2, name="velocity"), "has the name 'velocity'"),
        (span(), "has no values"),
        (span(1, "fast"), "mixes numbers and names"),
        (span(1, True), "duplicate values"),
        (span(0, True), "is not an int, float or str"),
        (span(1, 2, changes=()), "change nothing"),
        (span(1, 2, changes=(CHANGE,)), "make the same changes"),
        ((Axis("speed", (2, 1)), span(1, 2)[1]), "values in order"),
        ((Axis("speed", [1, 2]), span(1, 2)[1]), "not <class 'tuple'>"),  # type: ignore[arg-type]
    ],
)
def test_an_invalid_axis_is_detected(answer: Span | None, complaint: str) -> None:
    class Broken(Sound):
        def criterion(self, criterion: Criterion, template: Reader) -> Span | None:
            return answer if criterion.name == "speed" else None

    with pytest.raises(AssertionError, match=complaint):
        conformance.spans_an_axis(Broken(project_file.parse({"template": "t.xml"}, "sierra.toml"), None), TEMPLATE, SPEED)


def test_a_path_of_this_machine_is_detected(monkeypatch: pytest.MonkeyPatch, tmp_path: Any) -> None:
    monkeypatch.chdir(tmp_path)

    class Broken(Sound):
        def environment(self) -> Mapping[str, str]:
            return {"SOUND_PATH": f"{tmp_path}/lib"}

    with pytest.raises(AssertionError, match="a path of this machine"):
        check(Broken)


def test_options_that_accept_any_key_are_detected() -> None:
    class Anything(field_types.Table):
        model_config = ConfigDict(extra="allow")

    class Broken(Sound):
        Options = Anything

    with pytest.raises(AssertionError, match="accepts the unknown option"):
        check(Broken)


def test_a_check_that_returns_a_value_or_has_a_long_message_is_detected() -> None:
    class Answers(Sound):
        def check(self, document: Reader, template: Reader) -> Any:
            return False

    with pytest.raises(AssertionError, match="is False, not None"):
        check(Answers)

    class Rambles(Sound):
        def check(self, document: Reader, template: Reader) -> None:
            raise TemplateError("no\nno")

    with pytest.raises(AssertionError, match="is not one line"):
        check(Rambles)


def test_the_error_for_options_of_an_unknown_platform_lists_known_ones() -> None:
    project = project_file.parse({"template": "t.xml", "command": "x {input}", "platforms": {"argus": {}}}, "sierra.toml")
    known = ", ".join(PLATFORMS.names())
    with pytest.raises(ConfigError, match=rf"\[platforms.argus\]: unknown platform 'argus'; known are {known}$"):
        platforms.find("command", project)


def test_an_installed_platform_and_its_options_are_found_by_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "soundly.py").write_text(
        "from sierra.config.field_types import Table\n"
        "class Options(Table):\n    volume: int = 1\n"
        "class Soundly:\n    contract = 1\n    Options = Options\n"
        "    def __init__(self, project, options): self.project = project\n"
        "    changes = seed_changes = criterion = criteria = check = command = files = environment = None\n"
    )
    info = tmp_path / "soundly-1.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: soundly\nVersion: 1\n")
    (info / "entry_points.txt").write_text("[sierra.platforms]\nsoundly = soundly:Soundly\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    table = {"template": "t.xml", "platform": "soundly", "command": "x {input}", "platforms": {"soundly": {"volume": 2}}}
    assert "soundly" in PLATFORMS.names()
    assert type(platforms.find("soundly", project_file.parse(table, "sierra.toml"))).__name__ == "Soundly"
    wrong = project_file.parse({**table, "platform": "command", "platforms": {"soundly": {"volumes": 2}}}, "sierra.toml")
    with pytest.raises(ConfigError, match=r"\[platforms.soundly\]: .*volume"):
        platforms.find("command", wrong)


def test_answers_that_change_are_detected() -> None:
    counter = itertools.count()

    class Asked(Sound):
        def command(self) -> tuple[str, ...]:
            return ("sound", str(next(counter)))

    with pytest.raises(AssertionError, match="when it is requested again"):
        check(Asked)

    class Made(Sound):
        def __init__(self, project: project_file.Project, options: object) -> None:
            super().__init__(project, options)
            self._number = next(counter)

        def environment(self) -> Mapping[str, str]:
            return {"NUMBER": str(self._number)}

    with pytest.raises(AssertionError, match="a new instance gives a different answer"):
        check(Made)


def test_an_example_of_another_criterion_is_detected() -> None:
    project = project_file.parse({"template": "t.xml", "platform": "sound"}, "sierra.toml")
    with pytest.raises(AssertionError, match="is for 'mass'"):
        conformance.describes_its_criteria(Sound(project, None), {"speed": grammar.parse("mass=1,2")})
