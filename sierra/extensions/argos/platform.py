"""ARGoS 3: a configuration in which SIERRA sets the seed, length, controller, arena and population.

`docs/extensions/argos.md` has the rules: replaced parts, the arena and its walls, densities, libraries, failures.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator, Mapping
from fractions import Fraction
from pathlib import PurePosixPath
from typing import Annotated, ClassVar, Literal

from pydantic import Field, NonNegativeInt, PositiveInt, StringConstraints

from sierra.config.capture_table import Capture
from sierra.config.field_types import Positive, Table
from sierra.config.project_file import Project
from sierra.design.platforms.base import Reader, Rendering
from sierra.design.query import ranges
from sierra.errors import ConfigError, QueryError, TemplateError
from sierra.extensions.argos import frames, physics, scripts
from sierra.model import (
    Add,
    Axis,
    Change,
    ConstantDensity,
    Criterion,
    Listed,
    MonteCarlo,
    Point,
    Remove,
    Rename,
    Scale,
    Set,
    VariableDensity,
)
from sierra.util.lazy_definitions import dataclass, regex
from sierra.util.text import short_number

TABLE = "[platforms.argos]"
PLACEHOLDER = "__CONTROLLER__"
WHY_CONTROLLER = f"{PLACEHOLDER} in the template needs a controller"
COMMAND = ("argos3", "-n", "-c", "{input}")
NO_VISUALIZATION = ("-z", "--no-visualization")
"""The options of ARGoS by which it ignores the visualization."""
INPUT = "input.argos"

ROOT = "/argos-configuration"
EXPERIMENT = f"{ROOT}/framework/experiment"
LENGTH, RATE = f"{EXPERIMENT}/@length", f"{EXPERIMENT}/@ticks_per_second"
SYSTEM = f"{ROOT}/framework/system"
ARENA = f"{ROOT}/arena"
ROBOTS = f"{ARENA}//*[controller]"
"""XPath of all elements with a controller, independent of their placement."""
POPULATION = f"{ARENA}/distribute/entity[*/controller]/@quantity"
WALLS = f"{ARENA}/box[starts-with(@id, 'wall')]"
BOXES = f"{ARENA}/distribute/position[@method='uniform']"
ENGINES = f"{ROOT}/physics_engines/*"
ENGINE_TYPES = ("dynamics2d", "dynamics3d", "pointmass3d")
BOUNDARIES = f"{ROOT}/physics_engines/*/boundaries"

LARGEST = 2**32 - 1
"""The largest number of ticks, and of robots, that ARGoS supports."""
LABEL = "Population size"
CRITERIA: Mapping[str, str] = {
    "population_size": "number of robots that are distributed in the arena",
    "population_constant_density": "number of robots in growing arenas, at one density in percent of robots per m²",
    "population_variable_density": "number of robots in one arena, at several densities in percent of robots per m²",
    "arena": "size of the arena in metres, as in arena=10x10,20x10",
}

_SIDE = r"([0-9]{1,9}(?:\.[0-9]{1,9})?)"
_SIZE = f"{_SIDE}x{_SIDE}(?:x{_SIDE})?"
_NUMBER = regex(r"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]{1,2})?")
Tag = Annotated[str, StringConstraints(pattern=r"^[A-Za-z_][A-Za-z0-9_.-]*$")]
Vector = tuple[Fraction, Fraction, Fraction]


class SpatialHash(Table):
    """The grid in which `dynamics2d` looks for collisions; without it, ARGoS uses a tree of bounding boxes."""

    cell_size: Positive = Field(description="size of a cell in metres, such as the size of a robot")
    cell_num: PositiveInt = Field(description="number of cells, at least ten times the number of objects")


class ArgosOptions(Table):
    """The options of ARGoS."""

    length: Positive | None = Field(None, description="length of a run in seconds; default: as in the template")
    ticks_per_second: PositiveInt | None = Field(None, description="ticks per simulated second; default: as in the template")
    threads: NonNegativeInt = Field(0, description="additional threads of one run; 0: only the main thread")
    visualization: bool = Field(False, description="whether to keep the template's visualization")
    arena: Annotated[str, StringConstraints(pattern=f"^{_SIZE}$")] | None = Field(
        None, description="size of the arena in metres, such as 10x10 or 10x10x2; default: as in the template"
    )
    origin: Literal["corner", "centre"] | None = Field(
        None,
        description="point of the arena's floor that is 0,0: its lowest `corner`, or its `centre`; default: the centre stays",
    )
    walls: str = Field(WALLS, description="XPath of the four boxes that bound the arena")
    population: str | None = Field(
        None, description="XPath of the attribute that population_size sets; default: the quantity of the distributed robots"
    )
    physics_engines: Annotated[int, Field(ge=2, le=1000)] | None = Field(
        None, description="number of physics engines that share the arena in equal parts; default: as in the template"
    )
    physics_type: Tag | None = Field(
        None, description="type of the physics engine, such as dynamics2d; default: as in the template"
    )
    physics_iterations: PositiveInt | None = Field(
        None, description="iterations of the physics engines per tick; default: as in the template"
    )
    spatial_hash: SpatialHash | None = Field(None, description="spatial hash of the physics engines dynamics2d")
    remove_devices: tuple[Tag, ...] = Field(
        (),
        description="tags of sensors, actuators and parts of robots to remove because controllers do not use them, such as "
        "`range_and_bearing`, `leds` or `battery`; a medium that only they use is removed too",
    )
    libraries: tuple[str, ...] = Field(
        ("build",), description="folders of the project that contain the libraries of the template"
    )
    cameras: Mapping[Tag, frames.Camera] = Field(
        default_factory=dict,
        description="cameras for `sierra video --capture`, by name; `overhead`, `corner` and `around` are always there",
    )
    label: Tag | None = Field(None, description=f"tag that replaces {PLACEHOLDER}; default: the controller's name")


@dataclass(frozen=True, slots=True)
class Size:
    """The sides of an arena in metres; without `z`, the arena keeps its height."""

    x: Fraction
    y: Fraction
    z: Fraction | None = None

    @property
    def area(self) -> Fraction:
        return self.x * self.y

    def __str__(self) -> str:
        return "x".join(_plain(side) for side in (self.x, self.y, self.z) if side is not None)


@dataclass(frozen=True, slots=True)
class Wall:
    """A box on one side of the arena: its side, and the properties that do not change."""

    id: str
    axis: int
    """The axis that the wall bounds: 0 is x, 1 is y."""
    high: bool
    """True if the wall is at the upper end of the axis."""
    position: Vector
    thickness: Fraction
    height: Fraction
    length: Fraction


@dataclass(frozen=True, slots=True)
class Space:
    """The range of positions where robots can be, along x and y."""

    low: tuple[Fraction, Fraction]
    high: tuple[Fraction, Fraction]

    def __post_init__(self) -> None:
        if not all(low < high for low, high in zip(self.low, self.high, strict=True)):
            raise TemplateError("the walls leave no space between them; use a larger arena")


class Argos:
    """The platform `argos`."""

    Options: ClassVar[type[Table]] = ArgosOptions
    usual_files: ClassVar = (INPUT,)
    finds_files: ClassVar = True

    def __init__(self, project: Project, options: ArgosOptions) -> None:
        self._options = options
        if project.template is None:
            raise ConfigError('platform "argos" needs one template, as in: template = "experiment.argos"')
        if project.command and not any("{input}" in word for word in project.command):
            raise ConfigError('platform "argos" needs {input} in its command, as in: command = "argos3 -n -c {input}"')
        self._command = project.command or COMMAND
        self._beside = project.files
        self._arena = _size(self._options.arena) if self._options.arena else None
        if self._arena and not all((self._arena.x, self._arena.y, self._arena.z != 0)):
            raise ConfigError(f"{TABLE}: arena: {self._options.arena!r} is empty; use a size such as 10x10")
        for folder in self._options.libraries:
            _check_folder(folder)

    def changes(self, template: Reader) -> tuple[Change, ...]:
        resized: tuple[Change, ...] = ()
        if self._arena or self._options.origin:
            option = "arena" if self._arena else "origin"
            resized = self._resized(template, self._arena or _arena_size(template), f"{TABLE} {option}")
        return (
            *self._length(),
            *self._threads(template),
            *self._controller(template),
            *self._visualization(template),
            *self._without_devices(template),
            *self._physics(template),
            *scripts.changes(template),
            *resized,
        )

    def seed_changes(self) -> tuple[Change, ...]:
        return (Set(EXPERIMENT, "{seed}", attribute="random_seed", expect=1, why="the seed"),)

    def criterion(self, criterion: Criterion, template: Reader) -> tuple[Axis, tuple[Point, ...]] | None:
        spans = {
            "population_size": self._population_size,
            "population_constant_density": self._constant_density,
            "population_variable_density": self._variable_density,
            "arena": self._arenas,
        }
        return spans[criterion.name](criterion, template) if criterion.name in spans else None

    def criteria(self) -> Mapping[str, str]:
        return CRITERIA

    def follow(self, document: Reader, base: Reader) -> tuple[Change, ...]:
        """Return the changes that fit walls and distributed robots to an arena that changed, if nobody else moved them."""
        parts = (f"({self._options.walls})/@*", f"({self._options.walls})/body/@*", f"{BOXES}/@*", f"{BOUNDARIES}//@*")
        engines = self._shared(document)
        if _edges(base) is None or not _has_other_edges(document, base) or base.find(BOUNDARIES):
            return engines
        if any(document.find(path) != base.find(path) for path in parts):
            return engines
        size = Size(*_vector(document, f"{ARENA}/@size"))
        center = None if _center(document) == _center(base) else _center(document)
        resized = self._resized(base, size, "the arena's size", center)[1:]
        return (*resized, *self._shared(document, center or self._centered(base, size)))

    def check(self, document: Reader, template: Reader) -> None:
        """Refuse an input that ARGoS would run for ever, hang in or not find, or whose arena does not fit its walls."""
        _check_length(document)
        _check_threads(document)
        self._check_arena(document, template)
        self._check_engines(document)
        scripts.check(document, self._beside)
        if left := document.find(f"//@*[contains(., '{PLACEHOLDER}')]"):
            raise TemplateError(f"{left[0]!r} contains {PLACEHOLDER} among other text, or was added later; use {{controller}}")

    def command(self) -> tuple[str, ...]:
        return self._command

    def files(self, document: bytes) -> tuple[tuple[str, bytes], ...]:
        return ((INPUT, document),)

    def environment(self) -> Mapping[str, str]:
        folders = ("{project}", *(f"{{project}}/{folder}" for folder in self._options.libraries))
        return {"ARGOS_PLUGIN_PATH": ":".join(folders)}

    def rendering(self, capture: Capture, command: tuple[str, ...]) -> Rendering:
        """Return the rendering by the visualization of ARGoS on a display; its frames have their tick in their names."""

        def changes(document: Reader) -> tuple[Change, ...]:
            center, sides = (tuple(map(float, vector)) for vector in (_center(document), _vector(document, f"{ARENA}/@size")))
            rate = _number_at(document, RATE)
            every = max(1, round((capture.interval or 0) * rate))
            ticks = math.ceil(_number_at(document, LENGTH) * rate)
            cameras = self._options.cameras
            return tuple(frames.changes(document, capture, cameras, center, sides, ticks, every))  # type: ignore[arg-type]

        return Rendering(
            tuple(word for word in command if word not in NO_VISUALIZATION),
            frames.FILES,
            changes,
            ticks_per_second=lambda document: float(_number_at(document, RATE)),
            display=frames.window(capture.size),
        )

    def _length(self) -> Iterator[Change]:
        for name in ("length", "ticks_per_second"):
            if (value := getattr(self._options, name)) is not None:
                yield Set(EXPERIMENT, short_number(value, 17), attribute=name, expect=1, why=f"{TABLE} {name}")

    def _threads(self, template: Reader) -> Iterator[Change]:
        threads, why = self._options.threads, f"{TABLE} threads"
        if template.find(SYSTEM):
            yield Set(SYSTEM, str(threads), attribute="threads", expect=1, why=why)
        elif threads:
            yield Add(f"{ROOT}/framework", f'<system threads="{threads}"/>', at=0, expect=1, why=why)

    def _controller(self, template: Reader) -> tuple[Change, ...]:
        name = Set(f"//@*[. = '{PLACEHOLDER}']", "{controller}", why=WHY_CONTROLLER)
        tag = Rename(f"//{PLACEHOLDER}", self._options.label or "{controller}", why=WHY_CONTROLLER)
        return tuple(change for change in (name, tag) if template.find(change.path))

    def _visualization(self, template: Reader) -> tuple[Change, ...]:
        unwanted = not self._options.visualization and template.find(frames.VISUALIZATION)
        return (Remove(frames.VISUALIZATION, why=f"{TABLE} visualization"),) if unwanted else ()

    def _without_devices(self, template: Reader) -> Iterator[Change]:
        """Yield the changes that remove devices, and the media that only these use."""
        why = f"{TABLE} remove_devices"
        places = [_device(name) for name in self._options.remove_devices]
        for name, path in zip(self._options.remove_devices, places, strict=True):
            if not template.find(path):
                raise TemplateError(f"{why}: the template has no sensor, actuator or part of a robot {name!r}; leave it out")
        for medium in dict.fromkeys(template.find(f"{ROOT}/media/*/@id") if places else ()):
            uses = f"@medium[. = {_literal(medium)}]"
            removed = sum(len(template.find(" | ".join(f"{part}/{uses}" for part in path.split(" | ")))) for path in places)
            if removed and removed == len(template.find(f"//{uses}")):
                yield Remove(f"{ROOT}/media/*[@id = {_literal(medium)}]", why=why)
        yield from (Remove(path, why=why) for path in places)

    def _physics(self, template: Reader) -> Iterator[Change]:
        """Yield the changes of the template's physics engines that do not depend on the arena."""
        options = self._options
        if options.physics_iterations:
            value, why = str(options.physics_iterations), f"{TABLE} physics_iterations"
            yield Set(ENGINES, value, attribute="iterations", why=why)
        if hashed := options.spatial_hash:
            why = f"{TABLE} spatial_hash"
            if template.find(f"{ENGINES}/spatial_hash"):
                yield Remove(f"{ENGINES}/spatial_hash", why=why)
            cells = f'cell_size="{short_number(hashed.cell_size, 17)}" cell_num="{hashed.cell_num}"'
            yield Add(ENGINES, f"<spatial_hash {cells}/>", at=0, why=why)
        if options.physics_type:
            yield Rename(ENGINES, options.physics_type, why=f"{TABLE} physics_type")

    def _shared(self, document: Reader, center: Vector | None = None) -> tuple[Change, ...]:
        """Return the changes that replace the one engine by several that share the arena; `center` is where it will be."""
        count, why = self._options.physics_engines, f"{TABLE} physics_engines"
        if count is None:
            return ()
        engine = _only_engine(document, why)
        made = physics.elements(count, _box(document, center), engine)
        added = (Add(f"{ROOT}/physics_engines", xml, expect=1, why=why) for xml in made)
        return (Remove(ENGINES, expect=1, why=why), *added)

    def _check_engines(self, document: Reader) -> None:
        """Check that the areas of several engines are those of the arena, which a change of single runs may have resized."""
        count = self._options.physics_engines
        if count is None:
            return
        expected = [point for points in physics.corners(count, _box(document)) for point in points]
        if list(document.find(f"{BOUNDARIES}/sides/vertex/@point")) != expected:
            raise TemplateError(
                f"{TABLE} physics_engines: the engines do not share the arena, because a later change resized it"
            )

    def _population_size(self, criterion: Criterion, template: Reader) -> tuple[Axis, tuple[Point, ...]]:
        if isinstance(criterion.scale, MonteCarlo):
            raise QueryError(f"{criterion.name} needs a range; use {criterion.name}.Log8")
        populations = tuple(_whole(criterion.name, value) for value in ranges.values(criterion.scale))
        path = self._population(template)
        points = tuple(Point(n, (_quantity(path, n, criterion.name),)) for n in populations)
        return Axis(criterion.name, populations, label=LABEL), points

    def _constant_density(self, criterion: Criterion, template: Reader) -> tuple[Axis, tuple[Point, ...]]:
        scale, name = criterion.scale, criterion.name
        if not isinstance(scale, ConstantDensity):
            raise QueryError(f"{name} needs a density, an increment in metres and a count; use {name}.5p0.I16.C4")
        first, path = _arena_size(template), self._population(template)
        sizes = tuple(Size(first.x + longer, first.y + longer) for longer in ranges.growths(scale))
        populations = tuple(_agents(name, size.area, scale.density) for size in sizes)
        if len(set(populations)) < len(populations):
            raise QueryError(_too_slow(name, first, scale, populations))
        resized = tuple(self._resized(template, size, name) for size in sizes)
        points = tuple(
            Point(n, (*shape, _quantity(path, n, name)), replaces=frozenset(shape))
            for n, shape in zip(populations, resized, strict=True)
        )
        return Axis(name, populations, label=LABEL), points

    def _variable_density(self, criterion: Criterion, template: Reader) -> tuple[Axis, tuple[Point, ...]]:
        scale, name = criterion.scale, criterion.name
        if not isinstance(scale, VariableDensity):
            raise QueryError(f"{name} needs two densities and a count; use {name}.1p0.5p0.C4")
        size, path = _arena_size(template), self._population(template)
        self._check_walls(template, size, "")
        populations = tuple(_agents(name, size.area, density) for density in ranges.densities(scale))
        if len(set(populations)) < len(populations):
            raise QueryError(_too_close(name, size, scale, populations))
        fixed = Set(f"{ARENA}/@size", _sides(template, size), expect=1, why=name)
        points = tuple(Point(n, (fixed, _quantity(path, n, name))) for n in populations)
        return Axis(name, populations, label=LABEL), points

    def _arenas(self, criterion: Criterion, template: Reader) -> tuple[Axis, tuple[Point, ...]]:
        sizes = _sizes(criterion.scale)
        points = tuple(Point(text, self._resized(template, size, f"arena={text}")) for text, size in sizes.items())
        return Axis(criterion.name, tuple(sizes), label="Arena", unit="m"), points

    def _population(self, template: Reader) -> str:
        """Return the XPath of the one attribute that holds the number of robots."""
        path = self._options.population or POPULATION
        selected = len(template.find(path))
        if selected != 1 or (not self._options.population and len(template.find(ROBOTS)) != 1):
            raise TemplateError(
                f"the template must have exactly one kind of robots, and distribute it ({path} selects {selected}); "
                f"set population in {TABLE} to the XPath of one quantity"
            )
        if template.find(f"({path})/self::*"):
            raise ConfigError(f"{TABLE}: population: {path!r} selects an element; use an attribute, as in {path}/@quantity")
        return path

    def _resized(self, template: Reader, size: Size, why: str, moved: Vector | None = None) -> tuple[Change, ...]:
        """Return the changes that fit the arena, its walls and the distributed robots to a size; the first sets the size.

        The arena's centre is `moved` if it is given; another change has then set it.
        """
        if template.find(BOUNDARIES) and self._options.physics_engines is None:
            raise TemplateError(f"{why}: {BOUNDARIES} would not follow the arena; use changes of your own")
        walls = self._walls(template)
        center = moved or self._centered(template, size)
        arena = _space(center, size)
        inner = _between(arena, walls)
        before = _within(walls) if walls else _space(_center(template), _arena_size(template))
        placed = not moved and (size.z is not None or center != _center(template))
        return (
            Set(f"{ARENA}/@size", _sides(template, size), expect=1, why=why),
            *((Set(ARENA, _joined(center), attribute="center", expect=1, why=why),) if placed else ()),
            *(change for wall in walls for change in self._moved(wall, arena, why)),
            *_stretched(template, before, inner, why),
        )

    def _centered(self, template: Reader, size: Size) -> Vector:
        """Return the centre of an arena of this size. If the arena becomes higher, its floor stays."""
        x, y, z = _center(template)
        if size.z is not None:
            z += (size.z - _vector(template, f"{ARENA}/@size")[2]) / 2
        if self._options.origin == "corner":
            return size.x / 2, size.y / 2, z
        return (Fraction(), Fraction(), z) if self._options.origin else (x, y, z)

    def _walls(self, template: Reader) -> tuple[Wall, ...]:
        """Return the four walls, or none. Raises TemplateError if the selected elements are something else."""
        path = self._options.walls
        ids = template.find(f"({path})/@id")
        sizes = tuple(_parsed(text, "a wall's size") for text in template.find(f"({path})/@size"))
        positions = tuple(_parsed(text, "a wall's position") for text in template.find(f"({path})/body/@position"))
        is_turned = any(any(_parsed(text, "an orientation")) for text in template.find(f"({path})/body/@orientation"))
        is_complete = len(template.find(path)) == len(ids) == len(sizes) == len(positions)
        if is_turned or not is_complete:
            raise TemplateError(
                f"{path} selects elements that are not walls: a wall is a box with id, size and position, without rotation"
            )
        walls = tuple(_wall(*facts, positions) for facts in zip(ids, sizes, positions, strict=True))
        sides = sorted((wall.axis, wall.high) for wall in walls)
        if walls and sides != [(0, False), (0, True), (1, False), (1, True)]:
            raise TemplateError(
                f"{', '.join(map(repr, ids))}: there must be one wall on each of the four sides; "
                f"set walls in {TABLE} to an XPath that selects four boxes, or none"
            )
        return walls

    def _check_arena(self, document: Reader, template: Reader) -> None:
        """Check the walls of an arena whose edges differ from the template's, independent of the change that moved them."""
        if not _has_other_edges(document, template):
            return
        size, everything = _arena_size(document), f"{BOUNDARIES}//@*"
        self._check_walls(document, size, f", or use arena={size}")
        if (found := document.find(everything)) and found == template.find(everything):
            raise TemplateError(f"{BOUNDARIES} would not follow the {size} arena; change the boundaries as well")

    def _check_walls(self, document: Reader, size: Size, otherwise: str) -> None:
        """Check that each wall is at most its thickness away from the arena's edge; otherwise robots lack part of the area."""
        arena = _space(_center(document), size)
        for wall in self._walls(document):
            if (wrong := _off_the_edge(wall, arena)) is not None:
                raise TemplateError(
                    f"{wall.id!r} {wrong} of the {size} arena, so that robots cannot use its whole area; "
                    f'set arena = "{size}" in {TABLE}{otherwise}, which moves the walls'
                )

    def _moved(self, wall: Wall, arena: Space, why: str) -> tuple[Change, ...]:
        """Return the changes that move a wall to the inside of the arena's edge, along the whole side."""
        across, along = wall.axis, 1 - wall.axis
        size, position = [Fraction()] * 2, [Fraction()] * 2
        size[across] = wall.thickness
        size[along] = arena.high[along] - arena.low[along]
        half = wall.thickness / 2
        position[across] = arena.high[across] - half if wall.high else arena.low[across] + half
        position[along] = (arena.low[along] + arena.high[along]) / 2
        path = f"({self._options.walls})[@id={_literal(wall.id)}]"
        return (
            Set(f"{path}/@size", _joined((*size, wall.height)), expect=1, why=why),
            Set(f"{path}/body/@position", _joined((*position, wall.position[2])), expect=1, why=why),
        )


def _check_folder(folder: str) -> None:
    """Check that a folder lies below the project, and that its name fits into a list separated by `:`."""
    parts = PurePosixPath(folder).parts
    if not parts or parts[0] == "/" or ".." in parts or set(folder) & set(":;,={}"):
        raise ConfigError(f'{TABLE}: libraries: {folder!r} is not a folder in the project; use one such as ["build"]')


def _check_length(document: Reader) -> None:
    if len(document.find(EXPERIMENT)) != 1:
        raise TemplateError(f"the template must have exactly one {EXPERIMENT}; ARGoS needs it")
    length = _at_most_one(document, LENGTH) or "0"
    ticks = _at_most_one(document, RATE)
    if ticks is None:
        raise TemplateError(f"{EXPERIMENT} has no ticks_per_second; add it, or set it in {TABLE}")
    count = _number(length, LENGTH) * _number(ticks, RATE)
    if count < 1:
        raise TemplateError(
            f"{LENGTH} is {length!r}, less than one tick, so the run would never end; set length = 300 in {TABLE}"
        )
    if count > LARGEST:
        raise TemplateError(f"{LENGTH} is {length!r}, which is more than the {LARGEST} ticks that ARGoS can count; use fewer")


def _check_threads(document: Reader) -> None:
    threads = _at_most_one(document, f"{SYSTEM}/@threads") or "0"
    count = _number(threads, f"{SYSTEM}/@threads")
    if count > 1 and _at_most_one(document, f"{SYSTEM}/@method") == "balance_length":
        raise TemplateError(f'{SYSTEM} has method="balance_length", which hangs with {threads} threads; use balance_quantity')
    pinned = _at_most_one(document, f"{SYSTEM}/@pin_threads_to_cores") or "false"
    if count > 0 and pinned.strip().lower() == "true":
        raise TemplateError(
            f'{SYSTEM} has pin_threads_to_cores="true", which pins thread n of each run to core n, '
            'so that runs at the same time would share the same cores; use pin_threads_to_cores="false"'
        )


def _quantity(path: str, population: int, why: str) -> Set:
    return Set(path, str(population), expect=1, why=why)


def _whole(name: str, value: float | str) -> int:
    if isinstance(value, str):
        raise QueryError(f"{name}: {value!r} is not a number of robots; use {name}=1,2,4")
    number = Fraction(value)
    if number.denominator > 1 or not 1 <= number <= LARGEST:
        raise QueryError(f"{name}: {value} is not a whole number of robots from 1 to {LARGEST}; use {name}=1,2,4")
    return int(number)


def _agents(name: str, area: Fraction, density: Fraction) -> int:
    """Return the number of robots at a density. Raises QueryError if it is less than one."""
    exact = area * density / 100
    if exact < 1:
        least = _step(100 / area)
        raise QueryError(
            f"{name}: {_plain(density)} % of {_plain(area)} m² gives {_plain(exact)} robots, less than one; "
            f"use a density of {least} or more, or a larger arena"
        )
    return int(exact)


def _too_slow(name: str, first: Size, scale: ConstantDensity, populations: tuple[int, ...]) -> str:
    """Return a message with an increment from which on each arena has at least one robot more than the last."""
    twice = next(n for n in populations if populations.count(n) > 1)
    sides = float(first.x + first.y)
    enough = (math.sqrt(sides**2 + 400 / float(scale.density)) - sides) / 2
    return (
        f"{name}: with arenas that grow by {_plain(scale.increment)} m, two arenas have {twice} robots; "
        f"use an increment of I{_step(Fraction(enough))} or more"
    )


def _too_close(name: str, size: Size, scale: VariableDensity, populations: tuple[int, ...]) -> str:
    twice = next(n for n in populations if populations.count(n) > 1)
    count = int(abs(scale.end - scale.start) * size.area / 100) + 1
    right = f"use C{count}" if count > 1 else "use densities that are further apart"
    return f"{name}: two of the densities give {twice} robots on {_plain(size.area)} m²; {right}, or a larger arena"


def _sizes(scale: Scale) -> dict[str, Size]:
    values = ranges.values(scale) if isinstance(scale, Listed) else ()
    matches = {text: re.fullmatch(_SIZE, text) for text in values if isinstance(text, str)}
    if not values or len(matches) < len(values) or not all(matches.values()):
        raise QueryError("an arena is given by its sides in metres; use arena=10x10,20x10")
    sizes = {text: _size(text) for text in matches}
    for text, size in sizes.items():
        if not (size.x and size.y and size.z != 0):
            raise QueryError(f"arena: {text!r} is empty; use arena=10x10,20x10")
    if len({(size.x, size.y, size.z) for size in sizes.values()}) < len(sizes):
        raise QueryError(f"arena: two of {', '.join(sizes)} are the same; use each size once")
    return sizes


def _size(text: str) -> Size:
    x, y, z = re.fullmatch(_SIZE, text).groups()  # type: ignore[union-attr]
    return Size(Fraction(x), Fraction(y), Fraction(z) if z else None)


def _arena_size(template: Reader) -> Size:
    x, y, _ = _vector(template, f"{ARENA}/@size")
    if min(x, y) <= 0:
        raise TemplateError(f"{ARENA}/@size is empty; use a size such as 10,10,2")
    return Size(x, y)


def _sides(template: Reader, size: Size) -> str:
    return _joined((size.x, size.y, _vector(template, f"{ARENA}/@size")[2] if size.z is None else size.z))


def _center(template: Reader) -> Vector:
    path = f"{ARENA}/@center"
    return _vector(template, path) if template.find(path) else (Fraction(), Fraction(), Fraction())


def _space(center: Vector, size: Size) -> Space:
    x, y, _ = center
    return Space((x - size.x / 2, y - size.y / 2), (x + size.x / 2, y + size.y / 2))


def _between(arena: Space, walls: Iterable[Wall]) -> Space:
    """Return the space between the walls of an arena, when they stand inside its edges."""
    low, high = list(arena.low), list(arena.high)
    for wall in walls:
        if wall.high:
            high[wall.axis] -= wall.thickness
        else:
            low[wall.axis] += wall.thickness
    return Space((low[0], low[1]), (high[0], high[1]))


def _within(walls: Iterable[Wall]) -> Space:
    """Return the space that four walls enclose in their current places."""
    faces = {(wall.axis, wall.high): _face(wall, outer=False) for wall in walls}
    return Space((faces[0, False], faces[1, False]), (faces[0, True], faces[1, True]))


def _face(wall: Wall, *, outer: bool) -> Fraction:
    half = wall.thickness / 2
    return wall.position[wall.axis] + (half if wall.high == outer else -half)


def _wall(identity: str, size: Vector, position: Vector, positions: tuple[Vector, ...]) -> Wall:
    """Return a wall; its side is given by its position relative to the middle of all walls."""
    axis = 0 if size[0] < size[1] else 1
    places = [place[axis] for place in positions]
    middle = (min(places) + max(places)) / 2
    if size[0] == size[1] or position[axis] == middle:
        raise TemplateError(f"{identity!r} is not a wall on one side; set walls in {TABLE} to an XPath that selects four boxes")
    return Wall(identity, axis, position[axis] > middle, position, size[axis], size[2], size[1 - axis])


def _off_the_edge(wall: Wall, arena: Space) -> str | None:
    """Return a description of a gap in a side of the arena that exceeds the wall's thickness; None if there is no gap."""
    along = 1 - wall.axis
    outside = _face(wall, outer=True)
    off = abs(outside - (arena.high if wall.high else arena.low)[wall.axis])
    if off > wall.thickness:
        return f"is {_plain(off)} m away from the edge"
    low, high = wall.position[along] - wall.length / 2, wall.position[along] + wall.length / 2
    gap = max(low - arena.low[along], arena.high[along] - high)
    return f"ends {_plain(gap)} m before the edge" if gap > wall.thickness else None


def _has_other_edges(document: Reader, template: Reader) -> bool:
    """Return True if changes gave the arena another size along x or y, or moved its centre."""
    paths = (f"{ARENA}/@size", f"{ARENA}/@center")
    if all(document.find(path) == template.find(path) for path in paths):
        return False
    return _space(_center(document), _arena_size(document)) != _edges(template)


def _device(name: str) -> str:
    """Return an XPath of all sensors, actuators and parts of robots with a tag."""
    devices = (f"{ROOT}/controllers/*/{kind}/{name}" for kind in ("sensors", "actuators"))
    return " | ".join((*devices, f"{ROBOTS}/{name}"))


def _only_engine(document: Reader, why: str) -> physics.Engine:
    """Return the one physics engine of an input. Raises TemplateError if it has properties that copies would lack."""
    known = "self::boundaries or self::spatial_hash"
    others = document.find(f"{ENGINES}/*[not({known})] | {ENGINES}/@*[name() != 'id' and name() != 'iterations']")
    if len(document.find(ENGINES)) != 1 or others or document.find(BOUNDARIES):
        raise TemplateError(
            f"{why}: {ROOT}/physics_engines must have one engine, with nothing but id, iterations and spatial_hash"
        )
    sizes, numbers = (_at_most_one(document, f"{ENGINES}/spatial_hash/@{name}") for name in ("cell_size", "cell_num"))
    tags = [tag for tag in ENGINE_TYPES if document.find(f"{ENGINES}/self::{tag}")]
    if not tags:
        raise TemplateError(f"{why}: the engine must be one of {', '.join(ENGINE_TYPES)}; set physics_type in {TABLE}")
    hashed = (sizes, numbers) if sizes is not None and numbers is not None else None
    return physics.Engine(tags[0], _at_most_one(document, f"{ENGINES}/@iterations"), hashed)


def _box(document: Reader, center: Vector | None = None) -> physics.Box:
    """Return the space of an arena."""
    x, y, z = center or _center(document)
    sides = _vector(document, f"{ARENA}/@size")
    return physics.Box(
        (x - sides[0] / 2, y - sides[1] / 2, z - sides[2] / 2), (x + sides[0] / 2, y + sides[1] / 2, z + sides[2] / 2)
    )


def _edges(template: Reader) -> Space | None:
    """Return the range of an arena; None if the template's arena is missing or invalid, which changes may correct."""
    try:
        return _space(_center(template), _arena_size(template))
    except TemplateError:
        return None


def _stretched(template: Reader, before: Space, after: Space, why: str) -> tuple[Change, ...]:
    """Return the changes that stretch each box of uniform positions with its surrounding space, and keep it inside."""
    changes: list[Change] = []
    corners = zip(template.find(f"{BOXES}/@min"), template.find(f"{BOXES}/@max"), strict=True)
    for number, (least, most) in enumerate(corners, 1):
        low, high = _parsed(least, f"{BOXES}/@min"), _parsed(most, f"{BOXES}/@max")
        new_low, new_high = _mapped(low, before, after), _mapped(high, before, after)
        if any(low[axis] < high[axis] and new_low[axis] == new_high[axis] for axis in (0, 1)):
            raise TemplateError(
                f"{why}: robots are distributed from {least!r} to {most!r}, outside the walls; move the robots or the walls"
            )
        for attribute, corner in (("min", new_low), ("max", new_high)):
            changes.append(Set(f"({BOXES})[{number}]/@{attribute}", _joined(corner), expect=1, why=why))
    return tuple(changes)


def _mapped(corner: Vector, before: Space, after: Space) -> Vector:
    """Return the corner at the same share of another space, in micrometres."""

    def along(axis: int) -> Fraction:
        share = (corner[axis] - before.low[axis]) / (before.high[axis] - before.low[axis])
        exact = after.low[axis] + share * (after.high[axis] - after.low[axis])
        return min(max(round(exact / physics.MICROMETRE) * physics.MICROMETRE, after.low[axis]), after.high[axis])

    return along(0), along(1), corner[2]


def _at_most_one(template: Reader, path: str) -> str | None:
    found = template.find(path)
    if len(found) > 1:
        raise TemplateError(f"{path} occurs {len(found)} times; use it once")
    return found[0] if found else None


def _vector(template: Reader, path: str) -> Vector:
    text = _at_most_one(template, path)
    if text is None:
        raise TemplateError(f"the template has no {path}; add it")
    return _parsed(text, path)


def _parsed(text: str, what: str) -> Vector:
    """Return three numbers that are separated by commas, the format of vectors in ARGoS."""
    parts = text.split(",")
    if len(parts) != 3:
        raise TemplateError(f"{what}: {text!r} is not three numbers; use a value such as 10,10,2")
    x, y, z = (_number(part, what) for part in parts)
    return x, y, z


def _number_at(document: Reader, path: str) -> Fraction:
    """Return the number in an attribute; 0 without it."""
    return _number(_at_most_one(document, path) or "0", path)


def _number(text: str, what: str) -> Fraction:
    if len(text) > 60 or not _NUMBER.fullmatch(text.strip()):
        raise TemplateError(f"{what}: {text!r} is not a number; use one such as 10 or 0.5")
    return Fraction(text.strip())


def _joined(numbers: Iterable[Fraction]) -> str:
    return ",".join(ranges.plain(number) for number in numbers)


def _plain(number: Fraction) -> str:
    """Return a number with at most four decimals, for messages."""
    return ranges.plain(round(number, 4))


def _step(number: Fraction) -> str:
    """Return a number, rounded up to two decimals and written like in criteria: 6p25."""
    return ranges.plain(Fraction(math.ceil(number * 100), 100)).replace(".", "p")


def _literal(text: str) -> str:
    """Return a text as a literal in an XPath 1.0 expression; XPath 1.0 has no escapes."""
    if "'" not in text:
        return f"'{text}'"
    if '"' not in text:
        return f'"{text}"'
    return "concat(" + ', "\'", '.join(f"'{part}'" for part in text.split("'")) + ")"
