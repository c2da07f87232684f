"""All that a package needs to add to SIERRA: the contracts of plug-ins, the records they get and return, and the errors.

A plug-in is a class of one of several kinds. A package offers it by an entry point in its `pyproject.toml`. The name of the
entry point is the name by which users choose the plug-in:

    [project.entry-points."sierra.platforms"]
    sonar = "sonar_sierra.platform:Sonar"

=========================  =================  =========================================  ============================
group of entry points      contract           chosen by                                  options
=========================  =================  =========================================  ============================
`sierra.platforms`         `Platform`         `platform = "NAME"`                        `[platforms.NAME]`
`sierra.templates`         `Template`         `template_format`, or the ending           `[template_formats.NAME]`
`sierra.runners`           `Runner`           `sierra run … --on NAME`                   `[runners.NAME]`
`sierra.links`             `Link`             `link = "NAME"` of a runner                `[links.NAME]`
`sierra.schedulers`        `Scheduler`        `[runners.…] scheduler = "NAME"`           the same table
`sierra.engines`           `Engine`           `[container] engine = "NAME"`, `--engine`  `[engines.NAME]`
`sierra.readers`           `OutputReader`     `[outputs.…] format`, or the ending        `[readers.NAME]`
`sierra.figures`           `FigureKind`       `[figures.…] kind = "NAME"`                the same table
`sierra.statistics`        `Statistic`        `sierra stats … --statistic NAME`          `[statistics.NAME]`
`sierra.comparisons`       `ComparisonMethod` `sierra compare … --method NAME`           `[comparison_methods.NAME]`
`sierra.criteria`          `Range`            `VARIABLE.NAME…` in a query                `[criteria.NAME]`
=========================  =================  =========================================  ============================

Each class has two class attributes beside what its contract says:

- `contract = 1`: the version of the contracts that it was made for, as a number. SIERRA refuses any other than `VERSION`.
- `Options`: a model of its table in `sierra.toml`: a subclass of `Table`, `NoOptions` if there are none, or `ClusterTable` (or
  a subclass) for schedulers. Unknown keys are errors. The class gets a valid object of it as the last argument when it is made.
  `sierra schema sierra.toml` and `sierra doctor` list the options of each installed plug-in.

**Identity.** A run's id is the hash of its inputs, command, environment, source and image. The options of a platform and of a
template format are part of it as far as they change these. The options of a reader, and its package's version, are part of the
hash of the rules by which executions are evaluated. The options of a runner, a scheduler, a link and an engine are part of no
id, so they must not change results. The options of a statistic change the numbers of tables and figures, and no id. A kind of
figure and a comparison method are part of no id either. The values and changes that a range of a criterion computes are part of
ids as if they were written in the query; its options are not.

**In the project.** A plug-in can be in a Python file of the project instead. `[plugins]` in `sierra.toml` names the file and
the class, and the name of the class is that of the plug-in. The file is part of the source.

**Errors.** Raise `ConfigError` for invalid settings, `TemplateError` for a template, `Missing` for something that does not
exist on this machine, `UnreadableError` for an output file, with one line: what is wrong, which one, what would be right. Any
other error counts as a fault of the plug-in, and SIERRA says so in one line that names the package.

**Loading.** A plug-in is imported when a command uses its name. An import that fails breaks only these commands. Two packages
that offer the same name for one kind are an error that names both; the shipped names cannot be replaced.

`sierra.testing` has a conformance suite for each kind: `platforms`, `templates`, `runners` (for schedulers too), `links`,
`engines`, `readers`, `statistics`, `figures`, `comparisons` and `criteria`. The contracts are the docstrings of the classes
below.
"""

from __future__ import annotations

from sierra.config.capture_table import Capture
from sierra.config.cluster_table import ClusterTable
from sierra.config.deliverable_tables import Figure
from sierra.config.field_types import Table
from sierra.config.plugin_registry import KINDS, VERSION, Kind, NoOptions
from sierra.config.project_file import Project
from sierra.config.validate import options
from sierra.containers.engines.base import Capabilities, ContainerSpec, Engine, Mount, Process
from sierra.containers.images.image import Image
from sierra.deliverables.figures.base import FigureKind
from sierra.deliverables.figures.base import Request as FigureRequest
from sierra.deliverables.figures.drawing import Drawing
from sierra.design.platforms.base import Following, Placing, Platform, Rendering, Renders, population_size
from sierra.design.platforms.base import Reader as TemplateView
from sierra.design.query.base import Range
from sierra.design.query.ranges import values
from sierra.errors import ConfigError, Full, Missing, PluginError, QueryError, SierraError, TemplateError, UsageError
from sierra.ingest.base import Columns, OutputReader, UnreadableError
from sierra.model import (
    Add,
    Axis,
    Change,
    Client,
    Computed,
    Criterion,
    Job,
    Limits,
    Member,
    OutputFile,
    Point,
    Pose,
    Remove,
    Rename,
    Repeat,
    Requirement,
    Result,
    Scale,
    Set,
    Times,
    Value,
)
from sierra.runners.base import Beat, ContainsMembers, Look, NamesRobots, Runner, RunsMembers, Work
from sierra.runners.links.base import (
    LIMIT,
    Channel,
    Ended,
    Folder,
    Link,
    LinkOptions,
    NoSession,
    Overdue,
    Unreachable,
    UntrustedHost,
)
from sierra.runners.links.commands import Commands, Stream
from sierra.runners.links.process_stream import ProcessStream
from sierra.runners.local import Local
from sierra.runners.schedulers.base import NAME_LENGTH, Bounds, Limit, NodeVariables, Request, Scheduler, State, Task
from sierra.stats.base import Estimate, Formula, Function, Parameter, Statistic
from sierra.stats.bootstrap import BootstrapOptions
from sierra.stats.bootstrap import estimate as bootstrap
from sierra.stats.comparison.base import CellResult, ComparisonMethod, pairs_of
from sierra.stats.comparison.model import Cell, Effect, Omnibus, Pair, Question, RunValue, Sample
from sierra.stats.needs import Needs
from sierra.store.layout import SessionPaths, StorePaths
from sierra.templates.arithmetic import fill
from sierra.templates.base import ARGUMENTS, Document, Files, Rendered, Renderer, Template

__all__ = [
    "ARGUMENTS",
    "KINDS",
    "LIMIT",
    "NAME_LENGTH",
    "VERSION",
    "Add",
    "Axis",
    "Beat",
    "BootstrapOptions",
    "Bounds",
    "Capabilities",
    "Capture",
    "Cell",
    "CellResult",
    "Change",
    "Channel",
    "Client",
    "ClusterTable",
    "Columns",
    "Commands",
    "ComparisonMethod",
    "Computed",
    "ConfigError",
    "ContainerSpec",
    "ContainsMembers",
    "Criterion",
    "Document",
    "Drawing",
    "Effect",
    "Ended",
    "Engine",
    "Estimate",
    "Figure",
    "FigureKind",
    "FigureRequest",
    "Files",
    "Folder",
    "Following",
    "Formula",
    "Full",
    "Function",
    "Image",
    "Job",
    "Kind",
    "Limit",
    "Limits",
    "Link",
    "LinkOptions",
    "Local",
    "Look",
    "Member",
    "Missing",
    "Mount",
    "NamesRobots",
    "Needs",
    "NoOptions",
    "NoSession",
    "NodeVariables",
    "Omnibus",
    "OutputFile",
    "OutputReader",
    "Overdue",
    "Pair",
    "Parameter",
    "Placing",
    "Platform",
    "PluginError",
    "Point",
    "Pose",
    "Process",
    "ProcessStream",
    "Project",
    "QueryError",
    "Question",
    "Range",
    "Remove",
    "Rename",
    "Rendered",
    "Renderer",
    "Rendering",
    "Renders",
    "Repeat",
    "Request",
    "Requirement",
    "Result",
    "RunValue",
    "Runner",
    "RunsMembers",
    "Sample",
    "Scale",
    "Scheduler",
    "SessionPaths",
    "Set",
    "SierraError",
    "State",
    "Statistic",
    "StorePaths",
    "Stream",
    "Table",
    "Task",
    "Template",
    "TemplateError",
    "TemplateView",
    "Times",
    "Unreachable",
    "UnreadableError",
    "UntrustedHost",
    "UsageError",
    "Value",
    "Work",
    "bootstrap",
    "fill",
    "options",
    "pairs_of",
    "population_size",
    "values",
]
