"""The expansion of a design to a batch with ids, and to the input files of its runs.

The expansion is a pure function: it always gives the same bytes, and so the same ids. All ids are computed first. The input
files are generated again later, lazily, and only for the runs that execute.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace

from sierra.config.robots_table import ROBOT, RobotsTable
from sierra.design import robots, run_values, seeds
from sierra.design.factorial_design import PlanningProgress, changes, ignore_progress, mentions
from sierra.design.overwritten import draws_poses
from sierra.design.platforms.base import Platform
from sierra.errors import ConfigError, QueryError
from sierra.model import Batch, Cell, Change, Design, Experiment, Run, RunSpec, Value
from sierra.store.layout import RUN_NAMES
from sierra.templates.base import Files, Renderer, Template
from sierra.util.hashing import canonical, canonical_plain, digest, merkle, sha256
from sierra.util.text import counted

Renderers = Mapping[str, Renderer]
"""Functions that make the inputs of runs, by the group of a robot's place; without robots, there is one."""


class Expansion:
    """A design with everything that its runs are made from."""

    def __init__(
        self,
        design: Design,
        template: Template,
        platform: Platform,
        spec: RunSpec,
        given: run_values.Used = run_values.Used(),  # noqa: B008 - it is immutable
        folder: str = "",
        on_robots: RobotsTable | None = None,
    ) -> None:
        """`given` are the values that commands and environments get. `folder` is that of the template's file in a run.

        `on_robots`: the robots of each run; None if runs take none.
        """
        self._robots = on_robots
        self._alike = on_robots is not None and not (
            any(mentions(change, robots.VALUE) for change in design.per_run)
            or any(group.changes for group in on_robots.groups.values())
        )
        """True if all robots of a run get the same input."""
        self._folder = f"{folder}/" if folder else ""
        self._design = design
        self._given = given
        self._template = template
        self._platform = platform
        self._numbers = tuple(range(design.query.runs))
        self._names: dict[tuple[str, ...], tuple[str, ...]] = {}
        self._spec = self._naming(spec)
        self.spec_id = digest("recipe", self._spec.preimage())
        if any(cell.stream for cell in design.cells):
            _check_streams(max(cell.stream for cell in design.cells), design.query.runs, design.largest_seed)
        elif design.query.runs > design.largest_seed:
            raise QueryError(
                f"[seed] max allows {counted(design.largest_seed, 'different seed')}, and this query requests "
                f"{design.query.runs} runs per experiment; raise max, or request fewer runs"
            )

    def batch(self, report: PlanningProgress = ignore_progress) -> Batch:
        """Return the batch with all ids. Raises TemplateError for a change that does not fit the template."""
        count = len(self._design.cells)
        experiments: list[Experiment] = []
        for cell in self._design.cells:
            report(len(experiments), count, count * self._design.query.runs)
            experiments.append(self._experiment(cell))
        if len(self._names) > 1:
            first, other = (", ".join(names) for names in itertools.islice(self._names, 2))
            raise ConfigError(f"the runs of a batch need input files of the same names; these differ: {first}; {other}")
        identity = merkle("batch", (experiment.id for experiment in experiments))
        return Batch(identity, self._design.axes, tuple(experiments), self._spec, self.spec_id)

    def files(self, batch: Batch, wanted: Callable[[Run], bool]) -> Iterator[tuple[Run, Files]]:
        """Yield the wanted runs with their input files, in the batch's order; each is generated on demand."""
        for experiment in batch.experiments:
            runs = [run for run in experiment.runs if wanted(run)]
            if runs:
                cell = self._design.cells[experiment.ordinal]
                render = self._renderers(cell)
                for run in runs:
                    yield run, self._files(cell, render, run.number, run.seed)

    def seeded(self, run: Run, seed: int) -> tuple[Run, Files]:
        """Return the run that another seed makes of a run of the batch, with its input files."""
        cell = self._design.cells[run.experiment]
        return self._run(cell, self._renderers(cell), run.number, seed)

    def _naming(self, spec: RunSpec) -> RunSpec:
        """Return the specification with the names that the platform gives, unless they are those of every project with it."""
        cell = self._design.cells[0]
        files = self._files(cell, self._renderers(cell), 0, self._seed(cell, 0))
        own = tuple(name for name in (name.removeprefix(self._folder) for name, _ in files) if name not in spec.named_inputs)
        usual = (vars(type(self._platform)).get("usual_files"), ())
        return spec if own in usual else replace(spec, named_inputs=(*spec.named_inputs, *own))

    def _experiment(self, cell: Cell) -> Experiment:
        render = self._renderers(cell)
        runs = tuple(self._run(cell, render, number, self._seed(cell, number))[0] for number in self._numbers)
        values = {axis.name: cell.values[axis.name] for axis in self._design.axes}
        shown = {name: exact(value) for name, value in values.items()}
        return Experiment(merkle("experiment", (run.id for run in runs), {"values": shown}), cell.ordinal, values, runs)

    def _run(self, cell: Cell, render: Renderers, number: int, seed: int) -> tuple[Run, Files]:
        files = self._files(cell, render, number, seed)
        inputs = [(name, sha256(content)) for name, content in files]
        names = tuple(name for name, _ in inputs)
        if names not in self._names:
            _check_names(names)
        digests = bytes.fromhex("".join(digest for _, digest in inputs))
        identity = run_id(self.spec_id, inputs, seed)
        return Run(identity, cell.ordinal, number, seed, self._names.setdefault(names, names), digests), files

    def _renderers(self, cell: Cell) -> Renderers:
        """Return the functions that make the inputs of an experiment's runs, by the group of the robot's place."""
        render = (
            self._with_poses(cell) if draws_poses(cell.changes) else self._template.changed(cell.changes, cell.values).per_run
        )
        groups = self._robots.groups if self._robots else {}
        own = {
            name: changes(group.changes, f"[robots.groups.{name}] changes") for name, group in groups.items() if group.changes
        }
        return {
            ROBOT: render(self._design.per_run),
            **{name: render((*self._design.per_run, *theirs)) for name, theirs in own.items()},
        }

    def _with_poses(self, cell: Cell) -> Callable[[Sequence[Change]], Renderer]:
        """Return a function like `Document.per_run`, for copies whose poses differ between runs."""
        return lambda per_run: lambda values: self._template.changed((*cell.changes, *per_run), values).render()

    def _files(self, cell: Cell, render: Renderers, number: int, seed: int) -> Files:
        lists = {name: values[number % len(values)] for name, values in self._design.lists.items()}
        values = {**cell.values, **lists, "seed": seed, "run": number}
        files = (
            self._files_of_input(render[ROBOT], values)
            if self._robots is None
            else self._of_robots(self._robots, render, values)
        )
        return (*files, *given) if (given := self._given.files(values)) else files

    def _files_of_input(self, render: Renderer, values: Mapping[str, Value]) -> Files:
        """Return the files of one input."""
        rendered = render(values)
        files = self._platform.files(rendered) if isinstance(rendered, bytes) else _named(rendered, self._platform)
        return tuple((self._folder + name, content) for name, content in files) if self._folder else files

    def _of_robots(self, table: RobotsTable, render: Renderers, values: Mapping[str, Value]) -> Files:
        """Return the input files of a run on robots."""
        if self._alike:
            files = self._files_of_input(render[ROBOT], {**values, robots.VALUE: 1})
            return robots.inputs(robots.places(table, values), lambda place: files)

        def made(place: robots.Place) -> Files:
            return self._files_of_input(render.get(place.group, render[ROBOT]), {**values, robots.VALUE: place.number})

        return robots.inputs(robots.places(table, values), made)

    def _seed(self, cell: Cell, number: int) -> int:
        stream = ""
        if self._design.independent_seeds:
            stream = canonical({axis.name: exact(cell.values[axis.name]) for axis in self._design.axes}).decode()
        largest = self._design.largest_seed
        first = cell.stream * seeds.streams(largest)[0]
        return seeds.seed(self._design.query.base_seed, first + number, stream, largest)


def _named(rendered: Files, platform: Platform) -> Files:
    """Return the files of a document, with those that the platform makes from the file without a name first."""
    main = [file for name, content in rendered if not name for file in platform.files(content)]
    return (*main, *(file for file in rendered if file[0]))


def _check_names(names: tuple[str, ...]) -> None:
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise ConfigError(f"{twice} would be written twice in the folder of a run; rename the file")
    for name in names:
        if name.split("/")[0] in RUN_NAMES:
            raise ConfigError(
                f"{name}: the folder of a run has its own {name.split('/')[0]!r}; move the file to another folder"
            )


def _check_streams(last: int, runs: int, largest: int) -> None:
    width, most = seeds.streams(largest)
    cause = "" if largest == seeds.LARGEST else f" with [seed] max = {largest}"
    if runs > width:
        raise QueryError(f"montecarlo allows at most {width} runs per experiment{cause}; this query requests {runs}")
    if last >= most:
        raise QueryError(f"montecarlo allows at most {most} experiments{cause}; this query requests {last + 1}")


def run_id(spec: str, inputs: Iterable[tuple[str, str]], seed: int) -> str:
    """Return a run's id, the hash of its batch's run specification, its input files and its seed."""
    named = [list(item) for item in inputs]
    return sha256(canonical_plain({"sierra": "run", "format": 1, "recipe": spec, "inputs": named, "seed": seed}))


def exact(value: Value) -> Value:
    """Return a value as written in a pre-image: numbers that JSON cannot represent exactly become text."""
    return str(value) if isinstance(value, int) and abs(value) >= 2**53 else value
