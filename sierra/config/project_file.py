"""The project: the whole of `sierra.toml`, which is validated once when it is read; its tables have their own modules.

The same table can be in `pyproject.toml` as `[tool.sierra]`. Unknown keys are errors that name the most similar valid key.
`schemas/sierra.toml.schema.json` is generated from these classes, and their docstrings are its descriptions.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterable, Mapping
from contextlib import AbstractContextManager
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import AfterValidator, BeforeValidator, Field, PositiveInt, create_model, model_validator

from sierra.config import current_project, extensions, group_names, targets
from sierra.config import forbidden_directives as directives
from sierra.config.change_tables import NO_CHANGE, OWN_PLACEHOLDERS, ChangeTable, Group, Seed, Variable, set_to
from sierra.config.claim_table import Claim
from sierra.config.cluster_table import ClusterTable, check_directives
from sierra.config.current_project import Plugins
from sierra.config.deliverable_tables import (
    DEFAULT_FORMATS,
    Comparison,
    DerivedTable,
    Figure,
    Formats,
    SqlLimits,
    TableForPaper,
)
from sierra.config.execution_tables import (
    BuildTable,
    Container,
    Determinism,
    Environment,
    LimitsTable,
    PluginsTable,
    ProgramsTable,
    ServiceTable,
    Source,
    StoreTable,
)
from sierra.config.field_types import (
    OF_RUNS,
    OF_TARGET,
    ONE_OR_MORE,
    Commands,
    Criteria,
    GroupName,
    InProject,
    Name,
    OfController,
    OfQuery,
    OfScenario,
    OutputName,
    RawTable,
    Scalar,
    Table,
    Words,
    as_words,
    check_distinct,
)
from sierra.config.find_project import ProjectFolder, content, find, settings_in
from sierra.config.model_table import Model
from sierra.config.number_table import Letters, NumberInText, Paper
from sierra.config.output_tables import STATUSES, Equivalence, Output, Success, file_once
from sierra.config.package_table import Package
from sierra.config.robots_table import ROBOT, RobotsTable
from sierra.config.validate import gathered, options
from sierra.errors import ConfigError, Missing, UsageError
from sierra.model import ACCEPTED, Axis, Value
from sierra.store.layout import CONFIG, PYPROJECT, RUN_STDERR, RUN_STDOUT
from sierra.util.lazy_definitions import dataclass, replace
from sierra.util.processors import ARCH
from sierra.util.regular_files import read_regular_text
from sierra.util.text import like

if TYPE_CHECKING:
    from sierra.store.derived_tables import Definition, Limits, Rules

OF_PACKAGES = "or import the package: its own [sql] cannot raise {} above the default"
"""The advice for somebody who needs larger limits for a received package."""


def _not_options(table: object) -> object:
    """Refuse options of formats, which an earlier version had under this name."""
    for name, value in table.items() if isinstance(table, dict) else ():
        if isinstance(value, dict):
            raise ValueError(f"the options of formats have another name now: [template_formats.{name}]")
    return table


def _only_own(tables: Mapping[str, RawTable]) -> Mapping[str, RawTable]:
    """Check that targets have no keys that are shared by all."""
    for name, key in ((name, key) for name, table in tables.items() for key in table if key in targets.SHARED):
        if key in targets.PER_TARGET:
            place = key if key == "seed" else f"{key}.…"
            raise ValueError(f"{name}.{key} cannot be in a target; write [{place}.targets.{name}]")
        raise ValueError(f"{name}.{key} cannot be in a target; it is the same for all targets")
    return tables


class QueryTable(OfQuery):
    """A named query, for `sierra run NAME`. What it does not say is as for all queries, at the top level."""

    criteria: Annotated[Criteria, Field(min_length=1)] = Field(
        description="criteria, one for each axis, as on the command line; text is split at spaces outside of double quotes"
    )


class Project(Table):
    """`sierra.toml`."""

    template: Annotated[str, Field(min_length=1)] | None = Field(
        None, description="the file from which the inputs of all runs are generated; default: none"
    )
    templates: Annotated[Mapping[Name, InProject], BeforeValidator(_not_options)] = Field(
        default_factory=dict,
        description="several files instead of one `template`, by name: changes select in `NAME:/…`, and {input.NAME} in the "
        "command is the path of the file",
    )
    files: Annotated[tuple[InProject, ...], ONE_OR_MORE] = Field(
        (),
        description="files, folders or globs of the project that lie beside the inputs of each run, with the same paths as in "
        "the project; part of the identity of runs",
    )
    template_format: str | None = Field(
        None,
        description="format of the template: `xml`, `json`, `yaml`, `toml`, `ini`, `properties`, `text` or a plug-in; "
        "default: by the ending of the file",
    )
    command: Annotated[tuple[str, ...], BeforeValidator(as_words, json_schema_input_type=Words)] = Field(
        (),
        description="the program and its arguments; {input}, {output}, {seed}, {project}, {python}, {arch}, {checkpoint} (a "
        "folder that outlives a run that is cut off), {port} (a free port; {port2} to {port16} are others) and the query's "
        "variables are filled in",
    )
    robots: RobotsTable | None = Field(None, description="the robots of each run; default: runs take no robots")
    before: Commands = Field(
        (),
        description="commands that are executed before the command in each run, one after the other; "
        "one line, or a list of lists of words",
    )
    after: Commands = Field(
        (), description="commands that are executed in each run after the command has succeeded; written like `before`"
    )
    services: Mapping[Name, ServiceTable] = Field(
        default_factory=dict, description="programs that run in the background of each run, by name; started in this order"
    )
    requires: tuple[Annotated[str, Field(pattern=r"^[A-Za-z0-9]")], ...] = Field(
        (), description="Python packages that `{python}` needs, as for pip; checked before anything executes"
    )
    platform: str = Field(
        "command",
        description="platform, which drives the simulator: "
        + "".join(f"`{name}`, " for name in ("command", *extensions.added("platforms")))
        + "or a plug-in",
    )
    runner: str = Field(
        "local", description="where runs execute unless `--on` says otherwise: `local`, or a cluster of `runners`"
    )
    target: Annotated[Name | None, OF_TARGET] = None
    targets: Annotated[Mapping[Name, RawTable], AfterValidator(_only_own)] = Field(
        default_factory=dict,
        description="targets, by name: other values of the keys that say how runs execute, for one platform; "
        "a table such as `limits` is merged key by key",
    )
    runs: Annotated[PositiveInt, OF_RUNS] = 10
    controller: OfController = None
    scenario: OfScenario = None
    seed: Annotated[Seed, BeforeValidator(set_to, json_schema_input_type=str | Seed)] = Seed.model_construct()
    variables: Mapping[Name, Annotated[Variable, BeforeValidator(set_to, json_schema_input_type=str | Variable)]] = Field(
        default_factory=dict, description="independent variables that queries vary, by name"
    )
    changes: tuple[ChangeTable, ...] = Field((), description="changes for every run of every batch")
    per_run: Mapping[Name, Annotated[tuple[Scalar, ...], Field(min_length=1)]] = Field(
        default_factory=dict, description="lists of values, by name: `{name}` in `run_changes` is item n for run number n"
    )
    run_changes: tuple[ChangeTable, ...] = Field(
        (), description="changes for each single run; may use {seed}, {run} and the lists of per_run"
    )
    controllers: Mapping[GroupName, Group] = Field(
        default_factory=dict,
        description="controllers for `controller` and --controller, by name; `{controller}` in changes is the name. The "
        'changes of `depth0` come before those of `"depth0.CRW"`',
    )
    scenarios: Mapping[GroupName, Group] = Field(
        default_factory=dict,
        description='scenarios for `scenario` and --scenario, by name; `"LowBlockCount.{x}x{y}"` stands for all names with '
        "numbers in these places, and `{x}` in its changes is such a number",
    )
    outputs: Annotated[Mapping[OutputName, Output], AfterValidator(file_once)] = Field(
        default_factory=dict,
        description="files that runs write, by the table's name; default: each .csv, .tsv, .parquet, .jsonl and "
        ".ndjson of the output folder, but not of its subfolders",
    )
    success: Success = Success.model_construct()
    limits: LimitsTable = LimitsTable.model_construct()
    environment: Environment = Environment.model_construct()
    container: Container | None = Field(None, description="the image in which runs execute; default: no container")
    source: Source = Source.model_construct()
    build: BuildTable | None = Field(None, description="the build of products from the source; default: nothing is built")
    store: StoreTable = StoreTable.model_construct()
    determinism: Determinism = Determinism.model_construct()
    equivalence: Mapping[Name, Equivalence] = Field(
        default_factory=dict, description="metrics that must be equivalent in a replay of nondeterministic runs, by name"
    )
    programs: ProgramsTable = ProgramsTable.model_construct()
    observe: Literal["none", "first", "all"] = Field(
        "first",
        description="the runs of which SIERRA records all files that they execute, read, look for and write: `first` is the "
        "first run that executes, the first of each experiment, and a sample of the others. Needs strace (on a cluster on its "
        "nodes), else it sees only files that are mapped into memory; not in containers",
    )
    observe_budget: float = Field(
        0.02,
        ge=0,
        allow_inf_nan=False,
        description='the time that observing the sample may take with observe = "first", as a part of the time that the runs '
        "take; 0: only the first run of each experiment is observed",
    )
    queries: Mapping[Name, QueryTable] = Field(default_factory=dict, description="named queries")
    tables: Mapping[Name, DerivedTable] = Field(default_factory=dict, description="derived tables, by name")
    sql: SqlLimits = SqlLimits()
    figure_formats: Formats = Field(
        DEFAULT_FORMATS,
        description="formats of the files of figures: `png`, `pdf`, `svg`; `html`: an interactive page in one file; `pgf`: "
        "drawing commands for LaTeX; `txt`, `tex`: the caption",
    )
    figures: Mapping[Name, Figure] = Field(default_factory=dict, description="figures, by name")
    figure_defaults: Mapping[Name, RawTable] = Field(
        default_factory=dict, description="keys that figures take with `inherit`, by name; they are no figures themselves"
    )
    paper_tables: Mapping[Name, TableForPaper] = Field(
        default_factory=dict, description="tables for papers, by name; they are drawn with the figures"
    )
    models: Mapping[Name, Model] = Field(
        default_factory=dict,
        description="predictions that are drawn with the data, by name, for figures and `sierra stats --models`",
    )
    comparisons: Mapping[Name, Comparison] = Field(
        default_factory=dict, description="comparisons of groups of runs, by name, for `sierra compare`"
    )
    claims: Mapping[Name, Claim] = Field(
        default_factory=dict, description="claims of a paper that recorded runs decide, by name, for `sierra claims`"
    )
    numbers: Mapping[Letters, NumberInText] = Field(
        default_factory=dict, description="numbers in the text of a paper, by name, for `sierra paper`; names are letters only"
    )
    paper: Paper = Paper()
    package: Package = Package()
    plugins: PluginsTable = PluginsTable.model_construct()
    platforms: Mapping[str, RawTable] = Field(default_factory=dict, description="options of platforms, by name")
    runners: Mapping[str, RawTable] = Field(
        default_factory=dict,
        description="clusters for `--on`, by name: `slurm`, `pbs`, or your own name with a `scheduler`; and `robots`",
    )
    links: Mapping[str, RawTable] = Field(default_factory=dict, description="options of links to hosts over SSH, by name")
    template_formats: Mapping[str, RawTable] = Field(default_factory=dict, description="options of template formats, by name")
    engines: Mapping[str, RawTable] = Field(default_factory=dict, description="options of container engines, by name")
    readers: Mapping[str, RawTable] = Field(
        default_factory=dict, description="options of the readers of output formats, by name"
    )
    statistics: Mapping[str, RawTable] = Field(default_factory=dict, description="options of statistics, by name")
    criteria: Mapping[str, RawTable] = Field(
        default_factory=dict, description="options of the ranges of criteria that plug-ins compute, by name"
    )
    comparison_methods: Mapping[str, RawTable] = Field(
        default_factory=dict, description="options of comparison methods, by name"
    )

    @property
    def template_paths(self) -> tuple[str, ...]:
        """Return the paths of all templates; `templates` has paths in the project only."""
        return (self.template,) if self.template is not None else tuple(self.templates.values())

    @model_validator(mode="before")
    @classmethod
    def _inherited(cls, table: object) -> object:
        if not isinstance(table, Mapping):
            return table
        figures, defaults = table.get("figures"), table.get("figure_defaults", {})
        if not isinstance(figures, Mapping) or not isinstance(defaults, Mapping):
            return table
        from sierra.config.inherited_figures import resolved

        return {**table, "figures": resolved(figures, defaults)}

    @model_validator(mode="after")
    def _templates(self) -> Project:
        if self.template is not None and self.templates:
            raise ValueError('"template" and "templates" exclude each other; give the file a name in "templates"')
        if self.template_format is not None and self.template is None:
            raise ValueError('"template_format" needs "template"; the endings of "templates" say their formats')
        paths = [os.path.normpath(path) for path in self.templates.values()]
        if twice := [name for name, path in zip(self.templates, paths, strict=True) if paths.count(path) > 1]:
            raise ValueError(f"templates: {twice[0]} and {twice[1]} are the same file; changes to it need one name")
        return self

    @model_validator(mode="after")
    def _distinct_names(self) -> Project:
        for key, tables in self:
            if isinstance(tables, Mapping):
                check_distinct(tables, key)
        if both := {name.lower() for name in self.figures} & {name.lower() for name in self.paper_tables}:
            name, other = (next(one for one in tables if one.lower() in both) for tables in (self.figures, self.paper_tables))
            raise ValueError(f"[figures.{name}] and [paper_tables.{other}] would have files of the same name; rename one")
        return self

    @model_validator(mode="after")
    def _free_table_names(self) -> Project:
        if not self.tables:
            return self
        from sierra.store.derived_tables import is_free

        outputs = {name.lower() for name in self.outputs}
        for name in self.tables:
            if name.lower() in outputs:
                raise ValueError(f"tables.{name}: an output has this name")
            if not is_free(name):
                raise ValueError(f"tables.{name}: SIERRA's own table has this name; use another name")
        return self

    @model_validator(mode="after")
    def _useful(self) -> Project:
        if "arch" in self.variables and any(ARCH in word for word in self._words):
            raise ValueError(f"variables.arch: in commands, {ARCH} is the processor of the host; use another name")
        for name, variable in self.variables.items():
            if variable.argument and name in OWN_PLACEHOLDERS:
                raise ValueError(f"variables.{name}: in a command, {{{name}}} has another meaning; use another name")
            if not (self.targets or self.target) and not self.changes_with(name):
                raise ValueError(f"variables.{name}: {NO_CHANGE}, or write {{{name}}} in the command")
            if variable.start and not (variable.repeat or self.targets or self.target):
                raise ValueError(f'variables.{name}: poses are those of the copies that "repeat" makes; give it "repeat"')
        return self

    @model_validator(mode="after")
    def _robots(self) -> Project:
        taken = [name for name in (*self.variables, *self.per_run) if name == ROBOT]
        if self.robots and taken:
            raise ValueError(f"{ROBOT}: in runs on robots, {{{ROBOT}}} is the robot's place; use another name")
        return self

    @model_validator(mode="after")
    def _possible_ends(self) -> Project:
        if impossible := [status for status in self.success.exit_status if status not in STATUSES]:
            raise ValueError(
                f"success.exit_status: {impossible[0]} should be from 0 to 255, or from -64 to -1 for a signal "
                "(-11 or 139 for signal 11)"
            )
        for key, names in (("outputs", self.outputs), ("tables", self.tables)) if self.success.accept else ():
            if taken := [name for name in names if name.lower().endswith(ACCEPTED)]:
                raise ValueError(f"{key}.{taken[0]}: with accept in [success], such names are those of tables of accepted ends")
        marker, needs = self.success.marker, self.limits.after_marker is not None and not self.targets
        if needs and not marker:
            raise ValueError("limits.after_marker: give the marker in [success]")
        if needs and marker in (RUN_STDOUT, RUN_STDERR) and not self.success.contains:
            raise ValueError(f'limits.after_marker: give the text of {marker} that shows the end in "contains" of [success]')
        return self

    @model_validator(mode="after")
    def _shown_claims(self) -> Project:
        for name, claim in self.claims.items():
            for key, shown in (("figures", claim.figure), ("paper_tables", claim.table)):
                known = getattr(self, key)
                if shown and shown not in known:
                    raise ValueError(f"claims.{name}: there is no [{key}.{shown}]; {like(shown, list(known), 'there are')}")
        return self

    @model_validator(mode="after")
    def _one_value_each(self) -> Project:
        given = [("seed", self.seed.environment), *((name, one.environment) for name, one in self.variables.items())]
        setters = dict.fromkeys((*self.environment.set, *self.environment.pass_), "[environment]")
        for name, variable in given:
            if variable is not None and (other := setters.setdefault(variable, name)) != name:
                raise ValueError(f"{other} and {name} both set the environment variable {variable}; use one of them")
        return self

    def added(self, key: str, default: Any) -> Any:
        """Return the value of a key that an extension adds."""
        return getattr(self, key, default)

    def labels(self, axis: Axis) -> dict[Value, Value]:
        """Return the labels of the values of a variable; none for labels that do not tell the values apart."""
        if axis.name in self.variables:
            given = self.variables[axis.name].labels
            labels: dict[Value, Value] = {value: given.get(str(value), str(value)) if given else value for value in axis.values}
            return labels if len({*labels.values()}) == len(labels) else {}
        groups = {"controller": self.controllers, "scenario": self.scenarios}.get(axis.name, {})
        labels = {}
        for value in axis.values:
            matching = group_names.resolve(str(value), groups)
            labels[value] = (groups[matching[0].declared[-1]].label if len(matching) == 1 else "") or value
        shown = list(labels.values())
        return {value: label for value, label in labels.items() if shown.count(label) == 1}

    def declared(self, table: str) -> Output | DerivedTable | None:
        """Return the declaration of an output or of a derived table; None if there is none."""
        return self.outputs.get(table) or self.tables.get(table)

    def for_target(self, name: str) -> Project:
        """Return the project with one target merged over its other keys, and without targets. Raises UsageError."""
        if name not in self.targets:
            raise UsageError(self._unknown(name))
        return _validated(targets.merged(self._written(), name), f"target {name!r}")

    def changes_with(self, name: str) -> bool:
        """Return True if the values of a variable change something in runs."""
        return self.variables[name].is_given or self._uses(name)

    def _written(self) -> RawTable:
        outputs = {name: output.model_dump(exclude_unset=True, by_alias=True) for name, output in self.outputs.items()}
        table = self.model_dump(exclude_unset=True, by_alias=True, exclude={"outputs"})
        return {**table, "outputs": outputs} if outputs else table

    def _unknown(self, name: str) -> str:
        known = f"known are {', '.join(self.targets)}" if self.targets else "sierra.toml declares no [targets.NAME]"
        return f"unknown target {name!r}; {known}"

    @property
    def _words(self) -> tuple[str, ...]:
        """Return all words of the commands of a run, and its variables."""
        services = (word for one in self.services.values() for word in (*one.command, *one.ready.words))
        around = (word for command in (*self.before, *self.after) for word in command)
        variables = (*self.environment.set.values(), *(self.container.variables.values() if self.container else ()))
        return (*self.command, *around, *services, *(self.robots.words if self.robots else ()), *variables)

    def _uses(self, name: str) -> bool:
        """Return True if a command uses a variable, or if a change does that does not belong to a variable."""
        robots = self.robots
        if name not in OWN_PLACEHOLDERS and any(f"{{{name}}}" in word for word in self._words):
            return True
        if robots and robots.count == name:
            return True
        groups = (*self.controllers.values(), *self.scenarios.values(), *(robots.groups.values() if robots else ()))
        tables = (*self.changes, *self.run_changes, *(change for group in groups for change in group.changes))
        texts = (text or "" for table in tables for text in (table.value, table.xml, table.json_, table.to))
        return any(re.search(rf"\{{[^}}]*\b{name}\b", text) for text in texts)

    @model_validator(mode="after")
    def _readable_names(self) -> Project:
        taken = {*self.variables, *self.per_run}
        for name in (*self.controllers, *self.scenarios):
            if wrong := group_names.complaint(name):
                raise ValueError(wrong)
            if both := next((one for one in group_names.parameters(name) if one in taken), None):
                raise ValueError(f"{name!r}: {{{both}}} is also a variable; use another name for one of them")
        return self


def model_of(keys: object) -> type[Project]:
    """Return the model of `sierra.toml` with those of the keys that extensions add. Only their modules are imported."""
    unknown = sorted(set(keys) - KEYS) if isinstance(keys, Iterable) else []
    return _with(tuple(key for key in unknown if key in extensions.added("tables"))) if unknown else Project


KEYS = frozenset(field.alias or name for name, field in Project.model_fields.items())
"""The keys of the core."""


@cache
def _with(keys: tuple[str, ...]) -> type[Project]:
    """Return the model with keys of extensions."""
    if not keys:
        return Project
    fields: dict[str, Any] = {key: extensions.load("tables", key) for key in keys}
    return create_model("Project", __base__=Project, __module__=__name__, __doc__=Project.__doc__, **fields)


@dataclass(frozen=True, slots=True)
class LoadedProject:
    """A project: its root (absolute), its file, and its configuration."""

    root: Path
    file: Path
    config: Project
    """The configuration: that of the default target, or of the one that was chosen."""
    written: bool = True
    """True if the file exists. A store without a file can be read too."""
    declared: Project | None = None
    """The content of the file, with all targets; None if it has no targets."""
    received: bool = False
    """True for the verified copy of a package that somebody else may have made."""
    content: bytes = b""
    """The bytes of the file from which this was read; none if it was made from a table."""
    notes: tuple[str, ...] = ()
    """Notes on keys of a package that are ignored."""
    lacking: str | None = None
    """Why the runs of a package cannot be executed here: see `sierra.config.extensions.lacking`."""

    @property
    def targets(self) -> tuple[str, ...]:
        """Return the names of the targets."""
        return tuple(self.declared.targets) if self.declared else ()

    @property
    def robot_groups(self) -> tuple[str, ...]:
        """Return the names in `[robots.groups]`, without duplicates: of the project and of all of its targets."""
        of_project = [config.robots.groups for config in (self.config, self.declared) if config and config.robots]
        tables_of_targets = self.declared.targets.values() if self.declared else ()
        of_targets = (targets.inner_table(table, "robots", "groups") for table in tables_of_targets)
        return tuple(dict.fromkeys(name for groups in (*of_project, *of_targets) for name in groups))

    def for_target(self, name: str | None) -> LoadedProject:
        """Return the project for another target; with None, the project itself. Raises UsageError for an unknown name."""
        if name is None or name == self.config.target:
            return self
        return replace(self, config=(self.declared or self.config).for_target(name))

    def rules(self) -> Rules:
        """Return the derived tables with their statements, and the limits on these; at most the default ones for a package."""
        from sierra.store.derived_tables import Rules

        tables = {name.lower(): self.definition(name, table, f"[tables.{name}]") for name, table in self.config.tables.items()}
        return Rules({**self._outcomes(), **tables}, self._sql_limits())

    def _outcomes(self) -> dict[str, Definition]:
        """Return the table with a flag for each outcome of a run, if some ends are accepted, also by a target only."""
        declared = (self.declared or self.config).targets.values()
        inner = [targets.inner_table(table, "success").get("accept") for table in declared]
        ends = [*self.config.success.accept, *(end for some in inner if isinstance(some, list | tuple) for end in some)]
        if not ends:
            return {}
        from sierra.config.output_tables import end_of
        from sierra.store.derived_tables import Definition
        from sierra.store.sql_names import identifier, quote

        outcomes = dict.fromkeys(("success", *(end_of(str(end)) for end in ends)))
        flags = ", ".join(f"outcome = {quote(outcome)} AS {identifier(outcome)}" for outcome in outcomes)
        text = f"FROM runs SELECT run, {flags} WHERE outcome IS NOT NULL"
        return {"outcomes": Definition("outcomes", text, "the table outcomes", implicit=True)}

    def _sql_limits(self) -> Limits:
        from sierra.store.derived_tables import Limits

        wanted = Limits(self.config.sql.wall, self.config.sql.memory)
        received = self.received or ProjectFolder(self.root, self.file).is_package
        return wanted.within(Limits(remedy=OF_PACKAGES)) if received else wanted

    def definition(self, name: str, table: DerivedTable | Model, origin: str) -> Definition:
        """Return the statement of a table or a model, which may be in a file; messages call it `origin`."""
        from sierra.store.derived_tables import Definition

        if table.file is None:
            return Definition(name, table.sql, origin)
        try:
            return Definition(name, read_regular_text(self.root / table.file), f"{origin} file {table.file}")
        except (OSError, UnicodeDecodeError) as error:
            why = (error.strerror or str(error)) if isinstance(error, OSError) else "it is not UTF-8 text"
            return Definition(name, "", origin, f"cannot read {table.file}: {why}")

    def plugins(self, refused: str = "") -> AbstractContextManager[None]:
        """Return a context in which the names of plug-ins in files of the project count.

        They are imported when they are used, but never from a package, and not with `refused`, which is a reason.
        """
        return current_project.within((self.root, refused), lambda: self.declared_plugins(refused))

    def declared_plugins(self, refused: str = "") -> Plugins:
        """Return the plug-ins in files of the project. Nothing is read or imported yet."""
        if self.received or ProjectFolder(self.root, self.file).is_package:
            refused = "it is Python code of a package, and nothing of a package is imported"
        if not (declared := self.config.plugins.declared):
            return Plugins(self.root, refused)
        from sierra.config import project_plugins

        return project_plugins.Declared(self.root, declared, refused)

    def plugin_files(self, kinds: Iterable[str] = ()) -> Mapping[str, bytes]:
        """Return the files of plug-ins of these kinds, by default of all, and those that they import, by path.

        Raises ConfigError, PluginError.
        """
        with self.plugins():
            plugins = current_project.plugins()
            return plugins.files(kinds) if plugins else {}

    def check_written(self) -> None:
        """Raise Missing if there is no `sierra.toml`, so that nothing can be executed."""
        if not self.written:
            raise Missing(f"no {CONFIG} in {self.root}, only a store, which can be read; create one with: sierra init")


def load(folder: Path) -> LoadedProject:
    """Return the project that contains `folder`. Raises ConfigError if its file is invalid, Missing if there is none."""
    return read(find(folder))


def read(found: ProjectFolder) -> LoadedProject:
    """Return a project with its configuration; a store alone is a project without declarations. Raises ConfigError."""
    if not found.written:
        return LoadedProject(found.root, found.file, Project(), written=False)
    data = content(found.file)
    return replace(of_table(found, settings_in(data, found.file) or {}), content=data)


def of_table(folder: ProjectFolder, table: Mapping[str, object]) -> LoadedProject:
    """Return a project with the configuration in a table, which is that of its file or was made from it. Raises ConfigError."""
    root, file, _ = folder
    notes: tuple[str, ...] = ()
    lacking = extensions.lacking(table) if folder.is_package else None
    if folder.is_package:
        table, notes = extensions.without_absent(table)
    origin = f"{file} [tool.sierra]" if file.name == PYPROJECT else str(file)
    whole = parse(table, origin)
    if not whole.targets:
        return LoadedProject(root, file, whole, notes=notes, lacking=lacking)
    chosen = whole.for_target(whole.target) if whole.target else whole
    return LoadedProject(root, file, chosen, declared=whole, notes=notes, lacking=lacking)


def check_plugins(project: Project) -> None:
    """Check the tables of plug-ins in `sierra.toml` that could change results, and all classes of `[plugins]`.

    Raises ConfigError, PluginError.
    """
    from sierra.config import figure_options
    from sierra.config.plugin_registry import (
        COMPARISONS,
        CRITERIA,
        ENGINES,
        KINDS,
        LINKS,
        PLATFORMS,
        READERS,
        STATISTICS,
        TEMPLATES,
    )

    kinds = {kind.key: kind for kind in KINDS}
    checks: tuple[Callable[[], object], ...] = (
        *(partial(kinds[key].load, name) for key, name in project.plugins.names),
        partial(PLATFORMS.check, project.platforms),
        partial(TEMPLATES.check, project.template_formats),
        partial(ENGINES.check, project.engines),
        partial(LINKS.check, project.links),
        partial(READERS.check, project.readers),
        partial(figure_options.check, project.figures),
        partial(STATISTICS.check, project.statistics),
        partial(COMPARISONS.check, project.comparison_methods),
        partial(CRITERIA.check, project.criteria),
    )
    gathered(checks)


def parse(table: object, origin: str) -> Project:
    """Validate a table from TOML; messages call it `origin`.

    The tables of plug-ins are validated when they are used (see `sierra.config.plugin_registry`),
    those of shipped schedulers here too.
    """
    project = _validated(table, origin)
    gathered(partial(check, project, origin) for check in (_check_clusters, _check_names_of_targets))
    resolved = gathered(partial(_resolved, project, name, origin) for name in project.targets)
    each = dict(zip(project.targets, resolved, strict=True))
    for name in project.variables if each else ():
        if not any(candidate.changes_with(name) for candidate in (project, *each.values())):
            raise ConfigError(f"{origin}: variables.{name}: {NO_CHANGE}, here or in [variables.{name}.targets.{min(each)}]")
    return project


def _validated(table: object, origin: str, within: tuple[str, ...] = ()) -> Project:
    with current_project.declaring(table):
        return options(model_of(table), table, origin, within)


def _check_names_of_targets(project: Project, origin: str) -> None:
    """Raise ConfigError if a key names a target that is not declared."""
    given = [("target", (project.target,))] if project.target else []
    for place, names in (*given, *((f"{place}.targets", names) for place, names in targets.named(project._written()))):
        if unknown := [name for name in names if name not in project.targets]:
            raise ConfigError(f"{origin}: {place}: {project._unknown(unknown[0])}")


def _resolved(project: Project, name: str, origin: str) -> Project:
    """Return a target of a project after checking its keys. Raises ConfigError."""
    within = ("targets", name)
    found = _validated(targets.merged(project._written(), name), origin, within)
    _check_clusters(found, origin, within)
    return found


def _check_clusters(project: Project, origin: str, within: tuple[str, ...] = ()) -> None:
    """Check the tables of clusters of shipped schedulers. Raises ConfigError."""

    def check(name: str) -> None:
        scheduler = project.runners[name].get("scheduler", name)
        if isinstance(scheduler, str) and scheduler in directives.CHECKED:
            cluster = options(ClusterTable, project.runners[name], origin, (*within, "runners", name))
            where = ".".join((*within, "runners"))
            check_directives(cluster, partial(directives.complaint, scheduler), f"{origin}: {where}", name)

    gathered(partial(check, name) for name in project.runners)
