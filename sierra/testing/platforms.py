"""Conformance suite for platforms, as functions that a plug-in's author calls in tests.

    from sierra.testing import platforms as conformance

    def test_it_is_a_platform():
        conformance.check(MyPlatform, project, template, {"population_size": Criterion("population_size", Log(8))})

`project` is a `sierra.config.project_file.Project` that uses this platform. `template` is one that the platform accepts. Each
claim is one function, and can be called alone. A broken claim raises AssertionError with one line, even if Python runs with
`-O`. The suite does not check that the changes fit the template: applying them (`sierra.templates.base`) shows this.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from itertools import chain
from pathlib import Path
from types import UnionType

from sierra.config.capture_table import Capture
from sierra.config.project_file import Project
from sierra.config.validate import options
from sierra.design.platforms.base import Following, Placing, Platform, Reader, Renders
from sierra.errors import SierraError
from sierra.model import Add, Axis, Change, Criterion, Linear, Listed, Log, MonteCarlo, Point, Pose, Remove, Rename, Repeat, Set
from sierra.testing.assertions import holds, is_one_line, says_what_its_options_are
from sierra.util.lazy_definitions import regex

COMMAND_PLACEHOLDERS = frozenset(("input", "output", "run", "seed", "project", "python", "arch", "arguments"))
"""Placeholders that a command may contain in braces; `sierra.execution.commands` describes each."""
VARIABLE_PLACEHOLDERS = frozenset(("project", "python", "arch"))
"""Placeholders that a variable may contain. A variable is the same for all runs of a batch."""
CRITERION_NOBODY_HAS = "no_platform_has_a_criterion_of_this_name"
DOCUMENTS = (b"<a/>", b"", b"\xff\x00not text\n")

Make = type[Platform]
"""The class of a platform."""

_NAME = regex(r"[A-Za-z_][A-Za-z0-9_]*")
_PLACEHOLDER = regex(r"\{([a-z_]+)\}")
_FILE = regex(r"[A-Za-z0-9_][A-Za-z0-9_.-]*")
_SEEDLESS = regex(r"\{[^{}]*\b(seed|run)\b[^{}]*\}")


def check(make: Make, project: Project, template: Reader, examples: Mapping[str, Criterion]) -> None:
    """Check all claims. `examples` has, by name, a valid criterion for each one that the platform knows."""
    gives_the_same_answers(make, project, template, examples)
    says_what_its_options_are(made(make, project))
    checks_in_one_line(made(make, project), template)
    changes_are_well_formed(made(make, project), template)
    seed_changes_are_well_formed(made(make, project))
    what_follows_is_well_formed(made(make, project), template)
    rendering_is_well_formed(made(make, project), template)
    says_none_for_unknown_criteria(made(make, project), template)
    describes_its_criteria(made(make, project), examples)
    for criterion in examples.values():
        spans_an_axis(made(make, project), template, criterion)
    command_is_argv_with_known_placeholders(made(make, project))
    environment_is_of_no_machine(made(make, project))
    files_are_safe(made(make, project))


def made(make: Make, project: Project) -> Platform:
    """Return a platform of this class, made for a project with its options, as SIERRA makes it."""
    name = project.platform
    return make(project, options(make.Options, project.platforms.get(name, {}), f"[platforms.{name}]"))


def gives_the_same_answers(make: Make, project: Project, template: Reader, examples: Mapping[str, Criterion]) -> None:
    """Check that a platform repeats its answers, even if it is made again: they are part of identities."""
    platform = made(make, project)
    first = _answers(platform, template, examples.values())
    holds(_answers(platform, template, examples.values()) == first, "the answer differs when it is requested again")
    holds(_answers(made(make, project), template, examples.values()) == first, "a new instance gives a different answer")
    backwards = _answers(made(make, project), template, reversed(list(examples.values())))
    holds(backwards[1:] == first[1:], "the answer differs after other calls")


def checks_in_one_line(platform: Platform, template: Reader) -> None:
    """Check that an input is accepted, or refused with a user's error. The template may be valid only after the changes."""
    try:
        answer: object = platform.check(template, template)  # type: ignore[func-returns-value]
    except SierraError as error:
        is_one_line(str(error))
        return
    holds(answer is None, f"check() is {answer!r}, not None")


def changes_are_well_formed(platform: Platform, template: Reader) -> None:
    """Check that changes for all runs do not use the run's seed or number."""
    changes = platform.changes(template)
    _are_changes(changes)
    for change in changes:
        text = f"{change.value if isinstance(change, Set) else ''}{change.xml if isinstance(change, Add) else ''}"
        holds(not _SEEDLESS.search(text), f"{change} uses the seed or the run; only seed_changes and run_changes may")


def seed_changes_are_well_formed(platform: Platform) -> None:
    """Check that the seed is used: some change contains `{seed}`, or there are no seed changes."""
    changes = platform.seed_changes()
    _are_changes(changes)
    for change in changes:
        holds(isinstance(change, Set), f"{change} is not a Set; a seed is a value of its run")
    used = any("{seed}" in change.value for change in changes if isinstance(change, Set))
    holds(used or not changes, "no seed change contains {seed}")


def what_follows_is_well_formed(platform: Platform, template: Reader) -> None:
    """Check that the changes that follow from others are changes and repeat, if the platform has such changes."""
    if not isinstance(platform, Following):
        return
    try:
        first, again = platform.follow(template, template), platform.follow(template, template)
    except SierraError as error:  # the template may be valid only after the changes
        is_one_line(str(error))
        return
    _are_changes(first)
    holds(first == again, "follow() differs when it is called again")


def rendering_is_well_formed(platform: Platform, template: Reader) -> None:
    """Check that the rendering of a recorded command has frames and repeats, if the platform renders."""
    if not isinstance(platform, Renders):
        return
    rendering = platform.rendering(Capture(), platform.command())
    holds(bool(rendering.files.strip()), "rendering() names no frames")
    holds(bool(rendering.command), "rendering() has no command")
    holds(rendering.files == platform.rendering(Capture(), platform.command()).files, "rendering() differs when called again")
    try:
        first, again = tuple(rendering.changes(template)), tuple(rendering.changes(template))
    except SierraError as error:  # the template may be valid only after the changes
        is_one_line(str(error))
        return
    _are_changes(first)
    holds(first == again, "the changes of rendering() differ when they are made again")


def says_none_for_unknown_criteria(platform: Platform, template: Reader) -> None:
    """Check that the answer for an unknown criterion is None, without an error, on any scale."""
    unknown = CRITERION_NOBODY_HAS not in platform.criteria()
    holds(unknown, f"criteria() contains {CRITERION_NOBODY_HAS!r}, which no platform has")
    for scale in (Log(8), Linear(10, 5), Listed(("one", "two")), MonteCarlo(3)):
        answer = platform.criterion(Criterion(CRITERION_NOBODY_HAS, scale), template)
        holds(answer is None, f"criterion {CRITERION_NOBODY_HAS!r} is {answer!r}, not None")


def describes_its_criteria(platform: Platform, examples: Mapping[str, Criterion]) -> None:
    """Check that criteria have names that can be columns and a sentence each, and that `examples` has one of each."""
    criteria = platform.criteria()
    for name, sentence in criteria.items():
        holds(bool(_NAME.fullmatch(name)), f"{name!r} is not a valid column name; use letters, digits and _")
        holds(bool(sentence.strip()), f"criterion {name!r} has no description")
        is_one_line(sentence)
    holds(set(criteria) == set(examples), f"criteria() has {sorted(criteria)}, but there are examples of {sorted(examples)}")
    for name, criterion in examples.items():
        holds(criterion.name == name, f"the example for {name!r} is for {criterion.name!r}")


def spans_an_axis(platform: Platform, template: Reader, criterion: Criterion) -> None:
    """Check that a criterion's axis has its name, and that its values are distinct, of one kind and in the points' order."""
    answer = platform.criterion(criterion, template)
    if answer is None:
        raise AssertionError(f"criteria() has {criterion.name!r}, but criterion() returns None")
    axis, points = answer
    _is(axis, Axis)
    _is(axis.values, tuple)
    holds(axis.name == criterion.name, f"the axis of {criterion.name!r} has the name {axis.name!r}")
    holds(bool(axis.values), f"the axis {axis.name!r} has no values")
    holds(len(set(axis.values)) == len(axis.values), f"the axis {axis.name!r} has duplicate values: {axis.values}")
    for value in axis.values:
        holds(type(value) in (int, float, str), f"{value!r} on axis {axis.name!r} is not an int, float or str")
    of_one_kind = axis.numeric or all(isinstance(value, str) for value in axis.values)
    holds(of_one_kind, f"the axis {axis.name!r} mixes numbers and names: {axis.values}")
    _are_points(axis, points)


def command_is_argv_with_known_placeholders(platform: Platform) -> None:
    """Check that the command is a program with text arguments, and has only known placeholders."""
    command = platform.command()
    _is_a_tuple_of_texts(command, "command()")
    holds(bool(command) and bool(command[0]), "command() names no program")
    for word in command:
        _is_filled_as_known(word, COMMAND_PLACEHOLDERS, "command()")


def environment_is_of_no_machine(platform: Platform) -> None:
    """Check that variables have portable names, and values without paths of this machine."""
    for name, value in platform.environment().items():
        holds(bool(_NAME.fullmatch(name)), f"{name!r} is not the name of a variable")
        _is_a_tuple_of_texts((value,), f"variable {name}")
        _is_filled_as_known(value, VARIABLE_PLACEHOLDERS, f"variable {name}")


def files_are_safe(platform: Platform) -> None:
    """Check that any document has at least one file, with plain names that are distinct even if case is ignored."""
    for document in DOCUMENTS:
        try:
            files = platform.files(document)
        except SierraError:  # a platform that splits its document may refuse invalid ones
            continue
        _is(files, tuple)
        holds(bool(files), f"files({document!r}) returns no files")
        if isinstance(platform, Placing):
            poses = platform.start_poses(files[0][1])
            holds(all(isinstance(pose, Pose) for pose in poses), f"start_poses() returns {poses!r}, not a tuple of Pose")
        names = [name for name, _ in files]
        for name, content in files:
            holds(bool(_FILE.fullmatch(name)), f"{name!r} is not a safe file name; use letters, digits, _ - and .")
            _is(content, bytes)
        holds(len({name.lower() for name in names}) == len(names), f"two files have the same name: {names}")


def _answers(platform: Platform, template: Reader, criteria: Iterable[Criterion]) -> list[object]:
    """Return all answers of a platform. The criteria come first, sorted by name, so that their order does not matter."""
    spanned = {criterion.name: platform.criterion(criterion, template) for criterion in criteria}
    return [
        list(spanned),
        sorted(spanned.items()),
        platform.changes(template),
        platform.seed_changes(),
        dict(platform.criteria()),
        platform.command(),
        dict(platform.environment()),
        [platform.files(document) for document in DOCUMENTS[:1]],
    ]


def _are_points(axis: Axis, points: tuple[Point, ...]) -> None:
    _is(points, tuple)
    in_order = tuple(point.value for point in points) == axis.values
    holds(in_order, f"the points of {axis.name!r} do not have the axis's values in order")
    for point in points:
        _are_changes(point.changes)
    moved = any(chain.from_iterable(point.changes for point in points)) or len({p.stream for p in points}) > 1
    holds(moved or len(points) == 1, f"the points of {axis.name!r} change nothing, not even seeds")
    distinct = {(point.changes, point.stream) for point in points}
    holds(len(distinct) == len(points), f"two points of {axis.name!r} make the same changes, so they are the same experiment")


def _are_changes(changes: tuple[Change, ...]) -> None:
    """Check that this is a tuple of changes, each with a path, a one-line `why` for messages, and valid values."""
    _is(changes, tuple)
    for change in changes:
        _is(change, Set | Add | Remove | Rename | Repeat)
        holds(bool(change.path.strip()), f"{change} has no path")
        holds(change.expect is None or change.expect > 0, f"{change} expects less than one match")
        holds(bool(change.why), f"{change} has no `why`, which messages show")
        is_one_line(change.why)
        if isinstance(change, Set):
            _is(change.value, str)


def _is_filled_as_known(text: str, known: frozenset[str], where: str) -> None:
    """Check that a text has no path of this machine, and only known placeholders."""
    for path in (str(Path.home()), str(Path.cwd())):
        holds(path == "/" or path not in text, f"{where} contains {path!r}, a path of this machine; use {{project}}")
    unknown = [name for name in _PLACEHOLDER.findall(text) if name not in known]
    holds(not unknown, f"{where} has unknown placeholders {unknown}; known are {sorted(known)}")


def _is_a_tuple_of_texts(value: object, where: str) -> None:
    texts = isinstance(value, tuple) and all(isinstance(word, str) and "\0" not in word for word in value)
    holds(texts, f"{where} is {value!r}, not a tuple of texts")


def _is(value: object, kind: type | UnionType) -> None:
    holds(isinstance(value, kind), f"{value!r} is {type(value).__name__}, not {kind}")
