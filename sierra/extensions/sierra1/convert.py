"""The conversion of an old project to the text of a `sierra.toml`, with a list of what is not carried over.

The name of a controller stays `CATEGORY.NAME`; the changes of a category become those of the controllers' category. A scenario
becomes `NAME.{x}x{y}x{z}`, which sets the arena, its walls and the area where robots start, as SIERRA 1.x does. Everything is
tried on the template, so that the result loads and its changes fit.
"""

from __future__ import annotations

import os
import re
import tomllib
from collections.abc import Iterator, Mapping
from json import dumps
from pathlib import Path

from sierra import templates
from sierra.config import field_types, project_file
from sierra.config.group_names import GROUP_NAME
from sierra.design import platforms
from sierra.design.platforms.base import Following, Platform
from sierra.design.query import grammar
from sierra.errors import ConfigError, Missing, QueryError, SierraError, UsageError
from sierra.extensions.argos.platform import ARENA, EXPERIMENT, PLACEHOLDER
from sierra.extensions.sierra1 import graphs as figures
from sierra.extensions.sierra1.changes import ADDS, REMOVES, RENAMES, SETS, Old, Trial, first, listed, translated, xpath
from sierra.extensions.sierra1.old_project import Call, OldProject, read
from sierra.extensions.sierra1.yaml_values import Plain
from sierra.model import Add, Change, Remove, Rename, Set
from sierra.setup.init import folder
from sierra.store.layout import CONFIG
from sierra.templates.base import Template
from sierra.util.fs import write_whole
from sierra.util.lazy_definitions import dataclass, field, regex
from sierra.util.regular_files import read_regular
from sierra.util.text import one_line

ORDER = (*SETS, *RENAMES, *ADDS, *REMOVES)
HEIGHT = "{x},{y},{z}"
WALL, INSET = 0.4, 0.88
"""The thickness of walls, and the distance from the arena's edges to the area where robots start, in metres (SIERRA 1.x)."""
PLACES = (
    (".//arena/distribute/position", "min", f"{INSET},{INSET},0"),
    (".//arena/distribute/position", "max", f"{{round(x - {INSET}, 9)}},{{round(y - {INSET}, 9)}},0"),
    (".//arena/*[@id='wall_north']", "size", f"{{x}},{WALL},0.5"),
    (".//arena/*[@id='wall_north']/body", "position", "{x / 2},{y},0"),
    (".//arena/*[@id='wall_south']", "size", f"{{x}},{WALL},0.5"),
    (".//arena/*[@id='wall_south']/body", "position", "{x / 2},0,0"),
    (".//arena/*[@id='wall_east']", "size", f"{WALL},{{round(y + {WALL}, 9)}},0.5"),
    (".//arena/*[@id='wall_east']/body", "position", f"{{round(x - {WALL / 2}, 9)}},{{y / 2}},0"),
    (".//arena/*[@id='wall_west']", "size", f"{WALL},{{round(y + {WALL}, 9)}},0.5"),
    (".//arena/*[@id='wall_west']/body", "position", "0,{y / 2},0"),
)
"""The start area and the walls of SIERRA 1.x, of an arena of a scenario's size."""
SETUP = regex(r"exp_setup\.T([0-9]{1,9})(?:\.K([0-9]{1,5}))?(?:\.N[0-9]+)?")
LENGTH, TICKS = 5000, 5
"""The defaults of SIERRA 1.x for ARGoS: seconds, and ticks per second."""
SCENARIO = regex(r"([A-Za-z_][A-Za-z0-9_]*)\.([0-9]+)x([0-9]+)(?:x([0-9]+))?")
NOT_READ = {
    "collate.yaml": "every column of an output can be queried: sierra sql",
    "models.yaml": "models are Python; declare them as [models.NAME] with a command",
    "stage5.yaml": "compare controllers or scenarios by a query: controller=ONE,TWO",
    "perf.yaml": "performance measures are not computed; use SQL",
}
PHYSICS = {
    "physics-n-engines": ("physics_engines", "[1-9][0-9]{0,2}"),
    "physics-iter-per-tick": ("physics_iterations", "[1-9][0-9]{0,5}"),
    "physics-engine-type2D": ("physics_type", "[a-z][a-z0-9_]{0,40}"),
}
"""Options of the old program for physics engines, each with the key here and the form of its value."""
DEVICES = {"with-robot-rab": "range_and_bearing", "with-robot-leds": "leds", "with-robot-battery": "battery"}
OPTIONS = {
    *PHYSICS, *DEVICES,
    "controller", "scenario", "batch-criteria", "bc", "n-runs", "exp-setup", "expdef-template", "template-input-file",
    "engine", "platform", "project", "pipeline", "sierra-root", "exp-overwrite", "log-level", "exec-resume", "version",
}  # fmt: skip
"""Options of the old program that are carried over, or that nothing here needs."""


@dataclass(frozen=True, slots=True)
class Converted:
    """The text of a `sierra.toml`, and its parts for messages."""

    text: str
    template: str
    copied: Path | None
    """The template's old file, if it has to be copied to the new project."""
    controllers: tuple[str, ...]
    scenarios: tuple[str, ...]
    variables: tuple[str, ...]
    figures: tuple[str, ...]
    left_out: tuple[str, ...]
    next: str
    """The suggested first query."""


@dataclass(slots=True)
class Draft:
    """The new project while it is made."""

    platform: dict[str, str | int | list[str]] = field(default_factory=dict)
    groups: dict[str, tuple[Change, ...]] = field(default_factory=dict)
    """Categories and controllers."""
    scenarios: dict[str, tuple[Change, ...]] = field(default_factory=dict)
    variables: dict[str, tuple[Set, ...]] = field(default_factory=dict)
    queries: dict[str, dict[str, str | int]] = field(default_factory=dict)
    left_out: list[str] = field(default_factory=list)


def convert(root: Path, target: Path, template: str | None = None) -> Converted:
    """Return the project in `root` as a `sierra.toml` for the folder `target`; `template` is a path of the user.

    Raises Missing, UsageError, TemplateError for what cannot be read.
    """
    old = read(root)
    path, copied = _template(old, target, template)
    content = templates.read(copied or target / path)
    draft = Draft()
    _setup(draft, old, content)
    _physics(draft, old)
    _devices(draft, old, content)
    common = _accepted(draft, content)
    _controllers(draft, old, content, common)
    _scenarios(draft, old, content, common)
    _variables(draft, old, content, common)
    drawn = figures.graphs(old, _folder(old, content))
    draft.left_out += drawn.left_out
    _queries(draft, old)
    draft.left_out += _rest(old)
    members = tuple(name for name in draft.groups if "." in name)
    left_out = tuple(dict.fromkeys(one_line(line) for line in draft.left_out))
    text = "\n".join(_lines(path, draft, members, drawn, left_out)) + "\n"
    _check(text, root)
    return Converted(
        text,
        path,
        copied,
        members,
        tuple(draft.scenarios),
        tuple(draft.variables),
        tuple(drawn.figures),
        left_out,
        _next(draft),
    )


def write(root: Path, target: Path, template: str | None = None) -> tuple[Path, Converted]:
    """Write the `sierra.toml` of an old project into `target`, and copy the template if it is elsewhere; overwrite nothing.

    Return the path with what was converted. Raises like `convert`, and UsageError if there is a project in `target` already.
    """
    folder.check(target)
    converted = convert(root, target, template)
    if converted.copied:
        write_whole(target / converted.template, read_regular(converted.copied))
    return write_whole(target / CONFIG, converted.text.encode()), converted


def _check(text: str, root: Path) -> None:
    try:
        project_file.parse(tomllib.loads(text), "the converted project")
        text.encode()
    except (tomllib.TOMLDecodeError, UnicodeEncodeError, ConfigError) as error:
        raise UsageError(f"{root}: cannot be converted: {one_line(str(error))}") from error


def _template(old: OldProject, target: Path, given: str | None) -> tuple[str, Path | None]:
    """Return the template's path in the new project, and its old file if it must be copied there."""
    named = (call.first("expdef-template", "template-input-file", "template-file") for call in old.calls)
    existing = [file for name in named if name and name.endswith(".argos") and _is_inside(file := old.root / name, old.root)]
    candidates = [Path(given)] if given else list(dict.fromkeys([*existing, *old.templates]))
    if given and not candidates[0].is_file():
        raise Missing(f"{given}: no such file; give the template with --template FILE")
    if not candidates:
        raise Missing(
            f"{old.root}: no .argos file with {PLACEHOLDER}; give the template with --template FILE (only ARGoS is converted)"
        )
    if len(candidates) > 1 and not existing:
        shown = ", ".join(str(path) for path in candidates[:8])
        raise Missing(f"{old.root}: several files could be the template ({shown}); give one with --template FILE")
    file = candidates[0]
    inside = os.path.relpath(file.resolve(), target.resolve())
    if not inside.startswith(".."):
        return inside, None
    if os.path.lexists(target / file.name):
        raise UsageError(f"{target / file.name} exists already and is never overwritten; remove it, or use another folder")
    return file.name, file


def _is_inside(file: Path, root: Path) -> bool:
    """Return True for a file of the old project; what a script names elsewhere is not copied unless the user names it."""
    return file.is_file() and file.resolve().is_relative_to(root.resolve())


def _setup(draft: Draft, old: OldProject, template: Template) -> None:
    """Set the length and the origin. SIERRA 1.x sets both in every run."""
    draft.platform["origin"] = "corner"
    setups = [setup for call in old.calls if (setup := call.first("exp-setup", "time-setup"))]
    draft.left_out += [f"exp_setup: {other}: the first one, {setups[0]}, is used" for other in setups[1:] if other != setups[0]]
    match = SETUP.fullmatch(setups[0].replace("time_setup", "exp_setup")) if setups else None
    if setups and not match:
        draft.left_out.append(f"exp_setup: {setups[0]}: unknown form; set length and ticks_per_second in [platforms.argos]")
    length = int(match[1]) if match else LENGTH
    if match or template.find(f"{EXPERIMENT}/@length") in ((), ("0",)):
        draft.platform["length"] = length or LENGTH
        draft.platform["ticks_per_second"] = int((match[2] if match else None) or TICKS)
        if not match:
            draft.left_out.append(f"exp_setup: no script names it; the old default T{LENGTH}.K{TICKS} is used")


def _physics(draft: Draft, old: OldProject) -> None:
    """Set the options of physics engines that scripts give."""
    for option, (key, pattern) in PHYSICS.items():
        values = list(dict.fromkeys(value for call in old.calls for value in call.options.get(option, ())))
        draft.left_out += [f"--{option} {other}: the first one, {values[0]}, is used" for other in values[1:]]
        if not values or (option == "physics-n-engines" and values[0] == "1"):
            continue
        if not re.fullmatch(pattern, values[0]):
            draft.left_out.append(f"--{option} {values[0]}: unknown form; set {key} in [platforms.argos]")
        else:
            draft.platform[key] = int(values[0]) if values[0].isdecimal() else values[0]


def _devices(draft: Draft, old: OldProject, template: Template) -> None:
    """Remove the devices that SIERRA 1.x removes because no script asks for them."""
    absent = [device for option, device in DEVICES.items() if not any(option in call.options for call in old.calls)]
    found = [device for device in absent if template.find(f"//actuators/{device} | //sensors/{device} | {ARENA}//{device}")]
    if found:
        draft.platform["remove_devices"] = found
        draft.left_out.append(f"devices: {', '.join(found)}: removed as before, because no script has --with-robot-…")


def _accepted(draft: Draft, template: Template) -> tuple[Change, ...]:
    """Keep the options that the platform accepts for this template, and return its changes with them."""
    wanted, draft.platform = draft.platform, {}
    changes = _with_options({}, template)
    for key, value in wanted.items():
        try:
            changes = _with_options({**draft.platform, key: value}, template)
            draft.platform[key] = value
        except SierraError as error:
            draft.left_out.append(f"platforms.argos: {key} = {_quoted(value)}: {error}")
    return changes


def _with_options(options: Mapping[str, object], template: Template) -> tuple[Change, ...]:
    platform = _platform(options)
    changes = platform.changes(template)
    document = Trial(template, {"controller": "c"}, list(changes)).document()
    if isinstance(platform, Following):
        platform.follow(document, document)
    return changes


def _platform(options: Mapping[str, object]) -> Platform:
    table = {"template": "t.argos", "platform": "argos", "platforms": {"argos": dict(options)}}
    return platforms.find("argos", project_file.parse(table, "the converted project"))


def _controllers(draft: Draft, old: OldProject, template: Template, common: tuple[Change, ...]) -> None:
    library = _library(old)
    for category, content in old.section("controllers.yaml").items():
        if not isinstance(content, dict) or "controllers" not in content:
            if not isinstance(content, list):  # lists of graphs, which others refer to
                draft.left_out.append(f"controllers.yaml: {category}: it has no controllers")
            continue
        draft.left_out += _other_formats(content, f"controllers.yaml: {category}")
        shared: list[Old] = []
        for old_change in listed(content.get("xml"), f"controllers.yaml: {category}"):
            if isinstance(old_change, str):
                draft.left_out.append(old_change)
            else:
                shared.append(old_change)
        members = content["controllers"]
        for member in members if isinstance(members, list) else []:
            _controller(draft, category, member, shared, library, template, common)
        _factor_out(draft, category)


def _controller(
    draft: Draft,
    category: str,
    member: Plain,
    shared: list[Old],
    library: str,
    template: Template,
    common: tuple[Change, ...],
) -> None:
    name = f"{category}.{member['name']}" if isinstance(member, dict) and isinstance(member.get("name"), str) else ""
    where = f"controllers.yaml: {name or category}"
    if not isinstance(member, dict) or not re.fullmatch(GROUP_NAME, name) or "{" in name:
        draft.left_out.append(f"{where}: {str(member)[:80]}: its name is not one of letters, digits, _, . and -")
        return
    if name in draft.groups:
        draft.left_out.append(f"{where}: it occurs twice; the first one is used")
        return
    trial = Trial(template, {"controller": name}, list(common))
    loops, placeholder = _library_changes(library, template)
    every: list[Old] = [*loops, *_sorted(shared), *placeholder]
    own: list[Old] = []
    for old_change in listed(member.get("xml"), where):
        if isinstance(old_change, str):
            draft.left_out.append(old_change)
        else:
            own.append(old_change)
    draft.left_out += _other_formats(member, where)
    if member.get("graphs") or member.get("graphs_inherit"):
        draft.left_out.append(f"{where}: graphs: figures are drawn for all controllers")
    changes: list[Change] = []
    for old_change in (*every, *_sorted(own)):
        result = translated(old_change, trial, name)
        if isinstance(result, str):
            draft.left_out.append(result)
        else:
            changes.append(result)
    draft.groups[name] = tuple(changes)


def _sorted(changes: list[Old]) -> list[Old]:
    """Return changes so that paths with old tags come before the tags are renamed."""
    return sorted(changes, key=lambda change: ORDER.index(change.kind))


def _library(old: OldProject) -> str:
    """Return the library's name in `main.yaml`, or the one that SIERRA 1.x derives from the name of the project."""
    sierra = old.section("main.yaml").get("sierra")
    run = sierra.get("run") if isinstance(sierra, dict) else None
    name = run.get("library_name") if isinstance(run, dict) else None
    return name if isinstance(name, str) and name else f"lib{_project(old)}"


def _project(old: OldProject) -> str:
    """Return the project's name as scripts give it, or as it follows from its folder."""
    folder = old.folder.resolve()
    given = (name for call in old.calls for name in call.options.get("project", ()))
    fitting = (name for name in given if re.fullmatch(r"[\w.-]+", name) and name.rpartition(".")[2] == folder.name)
    return next(fitting, f"{folder.parent.name}.{folder.name}")


def _library_changes(library: str, template: Template) -> tuple[list[Old], list[Old]]:
    """Return the changes that SIERRA 1.x makes for the library: to the loop functions, and to the controller."""
    where, found = "main.yaml: library_name", []
    for path in (".//loop_functions", f".//{PLACEHOLDER}"):
        fits = template.find(f"{path[1:]}/@library")
        found.append([Old(where, "attr_change", (path, "library", library))] if fits else [])
    return found[0], found[1]


def _factor_out(draft: Draft, category: str) -> None:
    """Move the changes that all controllers of a category begin with to the category itself."""
    members = [name for name in draft.groups if name.startswith(f"{category}.")]
    if category in draft.groups or len(members) < 2:
        return
    each = [draft.groups[name] for name in members]
    count = next((n for n in range(min(map(len, each))) if len({changes[n] for changes in each}) > 1), min(map(len, each)))
    if count == 0:
        return
    own = {name: draft.groups.pop(name)[count:] for name in members}
    draft.groups |= {category: each[0][:count], **own}


def _other_formats(content: Mapping[str, Plain], where: str) -> Iterator[str]:
    for section in ("json", "yaml"):
        if content.get(section):
            yield f"{where}: {section}: only the changes to XML are carried over"


def _folder(old: OldProject, template: Template) -> str:
    """Return the folder in which runs write their tables: that of the template, or the one that main.yaml names."""
    named = {value for value in template.find("//@output_dir") if re.fullmatch(r"[\w-][\w.-]*(/[\w-][\w.-]*)*/?", value)}
    if len(named) == 1:
        return named.pop().rstrip("/")
    sierra = old.section("main.yaml").get("sierra")
    run = sierra.get("run") if isinstance(sierra, dict) else None
    leaf = run.get("run_metrics_leaf") if isinstance(run, dict) else None
    return leaf.strip("/") if isinstance(leaf, str) else ""


def _scenarios(draft: Draft, old: OldProject, template: Template, common: tuple[Change, ...]) -> None:
    """Make a scenario of each name in generators/scenario*.py and in scripts."""
    for call in old.calls:
        for scenario in call.options.get("scenario", ()):
            if not SCENARIO.fullmatch(scenario):
                draft.left_out.append(f"{call.origin}: scenario {scenario}: unknown form; expected a name such as A.10x10x2")
    written = [match for call in old.calls for s in call.options.get("scenario", ()) if (match := SCENARIO.fullmatch(s))]
    names = dict.fromkeys([*old.scenarios, *(match[1] for match in written)])
    changes = _arena(draft, template, common) if names else ()
    if any("population_constant_density" in text for call in old.calls for text in _criteria(call)):
        draft.left_out.append(
            f"population_constant_density: start area {INSET} m inside each arena: it grows with the arena instead"
        )
    for name in names:
        draft.scenarios[f"{name}.{{x}}x{{y}}x{{z}}"] = changes
        draft.left_out.append(
            f"scenario {name}: it sets the arena; what else its function in generators/scenario.py does is Python: "
            "write it as changes"
        )


def _arena(draft: Draft, template: Template, common: tuple[Change, ...]) -> tuple[Change, ...]:
    """Return the changes that SIERRA 1.x makes for the arena of a scenario, or only its size if the others do not fit."""
    size = Set(f"{ARENA}/@size", HEIGHT, expect=1)
    trial = Trial(template, {"controller": "c", "x": 20, "y": 10, "z": 2}, list(common))
    try:
        places = [(first(trial, xpath(path, "c")), name, value) for path, name, value in PLACES]
        present = [(path, name, value) for path, name, value in places if path and trial.count(f"{path}/@{name}")]
        placed = tuple(Set(path, value, attribute=name) for path, name, value in present)
        changes = (size, Set(ARENA, "{x / 2},{y / 2},{z / 2}", attribute="center"), *placed)
        trial.changes += changes
        _check_input(trial, Trial(template, trial.values, list(common)), _platform(draft.platform))
    except SierraError as error:
        draft.left_out.append(
            f"scenarios: start area {INSET} m inside the arena, walls of {WALL} m: {error}; both follow the arena instead"
        )
        return (size,)
    return changes


def _check_input(trial: Trial, base: Trial, platform: Platform) -> None:
    """Raise SierraError if a platform refuses an input, with all that follows from its changes."""
    if isinstance(platform, Following):
        trial.changes += platform.follow(trial.document(), base.document())
    platform.check(trial.document(), trial.template)


def _variables(draft: Draft, old: OldProject, template: Template, common: tuple[Change, ...]) -> None:
    for name, pairs in old.variables.items():
        if not pairs or not re.fullmatch(field_types.NAME, name):
            draft.left_out.append(f"variables/{name}.py: its changes are computed by Python; write them in [variables.{name}]")
            continue
        changes: list[Set] = []
        trial = Trial(template, {"controller": "c", name: 1}, list(common))
        for path, attribute in pairs:
            change = Set(xpath(path, "c"), f"{{{name}}}", attribute=attribute)
            try:
                exists = trial.count(f"{change.path}/@{attribute}")
            except SierraError:
                exists = 0
            if exists and PLACEHOLDER not in path and not trial.fits(change):
                changes.append(change)
            else:
                draft.left_out.append(f"variables/{name}.py: {path} {attribute}: it matches nothing in the template")
        if changes:
            draft.variables[name] = tuple(changes)


def _queries(draft: Draft, old: OldProject) -> None:
    """Make a named query of each call in scripts that has criteria."""
    for call in old.calls:
        draft.left_out += [
            f"{call.origin}: --{option}: is not carried over" for option in call.options if option not in OPTIONS
        ]
        criteria = [_criterion(text) for text in _criteria(call)]
        if not criteria:
            continue
        try:
            grammar.parse_all(criteria)
        except QueryError as error:
            draft.left_out.append(f"{call.origin}: --batch-criteria {' '.join(criteria)}: {error}")
            continue
        if query := _query(draft, call, criteria):
            stem = figures.name(criteria[0])
            free = (stem, *(f"{stem}_{number}" for number in range(2, len(draft.queries) + 3)))
            if query not in draft.queries.values():
                draft.queries[next(name for name in free if name not in draft.queries)] = query


def _criteria(call: Call) -> Iterator[str]:
    yield from (text for name in ("batch-criteria", "bc") for text in call.options.get(name, ()))


def _criterion(text: str) -> str:
    """Return a criterion that has the same values in the grammar of queries.

    SIERRA 1.x has a tenth of the end as the number of values of `Linear100`, and rounds the end of `Log1000` down to 512.
    """
    if match := re.fullmatch(r"(\w+)\.Linear([0-9]{2,9})", text):
        return f"{text}.C{int(match[2]) // 10}"
    if match := re.fullmatch(r"(\w+)\.Log([1-9][0-9]{0,8})", text):
        return f"{match[1]}.Log{1 << (int(match[2]).bit_length() - 1)}"
    return re.sub(r"^builtin\.MonteCarlo\.", "montecarlo.", text)


def _query(draft: Draft, call: Call, criteria: list[str]) -> dict[str, str | int] | None:
    query: dict[str, str | int] = {"criteria": " ".join(criteria)}
    if (runs := call.first("n-runs")) and runs.isdecimal() and int(runs[:6]) > 0:
        query["runs"] = int(runs[:6])
    if controller := call.first("controller"):
        if controller not in draft.groups:
            draft.left_out.append(f"{call.origin}: --controller {controller}: controllers.yaml has no such controller")
            return None
        query["controller"] = controller
    if (scenario := call.first("scenario")) and SCENARIO.fullmatch(scenario):
        if not SCENARIO.fullmatch(scenario)[4]:  # type: ignore[index]
            draft.left_out.append(f"{call.origin}: --scenario {scenario}: give the height of the arena too: {scenario}x2")
            return None
        query["scenario"] = scenario
    return query


def _rest(old: OldProject) -> Iterator[str]:
    for file in old.settings:
        if file not in (*figures.FILES, "controllers.yaml", "main.yaml"):
            yield f"{file}: {NOT_READ.get(file, 'is not carried over')}"
    robots = old.section("main.yaml").get("ros")
    if robots:
        yield "main.yaml: ros: only projects for ARGoS are converted"


def _next(draft: Draft) -> str:
    if draft.queries:
        return next(iter(draft.queries))
    words = ["population_size.Log8"]
    if controller := next((name for name in draft.groups if "." in name), None):
        words += ["--controller", controller]
    return " ".join(words)


# ---------------------------------------------------------------- the text


def _lines(
    template: str, draft: Draft, members: tuple[str, ...], drawn: figures.Graphs, left_out: tuple[str, ...]
) -> Iterator[str]:
    yield "# Converted from a project of SIERRA 1.x. The end of this file lists what is not carried over."
    yield f"template = {_quoted(template)}"
    yield 'platform = "argos"'
    yield "runs = 10  # per experiment"
    if members:
        yield f"controller = {_quoted(members[0])}  # unless --controller names another"
    yield "\n[platforms.argos]"
    yield from (f"{key} = {_quoted(value)}" for key, value in draft.platform.items())
    for name, sets in draft.variables.items():
        yield from (line for change in sets for line in _change(f"variables.{name}", change))
    for kind, groups in (("controllers", draft.groups), ("scenarios", draft.scenarios)):
        for name, changes in groups.items():
            if not changes:
                yield f"\n[{kind}.{_quoted(name)}]"
            yield from (line for change in changes for line in _change(f"{kind}.{_quoted(name)}", change))
    for kind, entries in (("outputs", drawn.outputs), ("figures", drawn.figures), ("queries", draft.queries)):
        for name, entry in entries.items():
            yield f"\n[{kind}.{name}]"
            yield from (f"{key} = {_quoted(value)}" for key, value in entry.items())
    yield "\n# Not carried over:" if left_out else "\n# Everything is carried over."
    yield from (f"# - {line}" for line in left_out)


def _change(owner: str, change: Change) -> Iterator[str]:
    yield f"\n[[{owner}.changes]]"
    match change:
        case Set(path, value, attribute):
            yield f"set = {_quoted(path)}"
            if attribute is not None:
                yield f"attribute = {_quoted(attribute)}"
            yield f"value = {_quoted(value)}"
        case Add(path, xml):
            yield f"add = {_quoted(path)}"
            yield f"xml = {_quoted(xml)}"
        case Remove(path):
            yield f"remove = {_quoted(path)}"
        case Rename(path, to):
            yield f"rename = {_quoted(path)}"
            yield f"to = {_quoted(to)}"


def _quoted(value: str | int | bool | list[str]) -> str:
    """Return a value as TOML writes it."""
    if isinstance(value, list):
        return f"[{', '.join(map(_quoted, value))}]"
    if isinstance(value, str):
        return dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    return str(value).lower()
