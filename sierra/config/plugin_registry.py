"""The registry of plug-ins: classes of several kinds that are found by name, shipped with SIERRA or added by other packages.

A package adds a class by an entry point of the group of its kind. The shipped classes are written here and in
`sierra.config.extensions`, so that no metadata is read for them. A plug-in is imported when its name is used, and not before.
A command that uses no plug-in imports none. A plug-in that cannot be used is an error of one line, only for commands that use
it.

A class of another package has `contract = 1`, the version of the contracts that it was made for, and `Options`, the model of
its table in `sierra.toml`. Tables stay as they are until their plug-in is used. Then `options` validates them.

Files of the project have plug-ins too, if `[plugins]` names them: see `sierra.config.project_plugins`. Their names count only
within `sierra.config.current_project`.
"""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Callable, Iterable, Mapping
from functools import cache, cached_property, partial
from importlib import import_module
from typing import TYPE_CHECKING, Any, Protocol

from sierra.config import current_project, extensions
from sierra.config.cluster_table import ClusterTable
from sierra.config.field_types import RawTable, Table
from sierra.config.validate import gathered, options
from sierra.errors import ConfigError, PluginError, SierraError
from sierra.util.hashing import digest, sha256
from sierra.util.lazy_definitions import dataclass

if TYPE_CHECKING:
    from types import TracebackType

SIERRA = __name__.partition(".")[0]
VERSION = 1
"""The version of all contracts. It increases when a plug-in for an earlier version would not work any more."""

Tables = Mapping[str, RawTable]
"""The tables of one kind in `sierra.toml`, by the names of plug-ins."""

_loaded: dict[str, str] = {}
"""The plug-ins of other packages that were loaded, in words, by the name of their top-level module."""


class NoOptions(Table):
    """A plug-in without options."""


class Point(Protocol):
    """The place of a class: an entry point, or a file of the project."""

    @property
    def value(self) -> str:
        """The module, or the file, and the name of the class."""

    def load(self) -> Any:
        """Import the class."""


@dataclass(frozen=True, slots=True)
class Offer:
    """One entry point: a name for a class, and the package that offers it."""

    name: str
    point: Point
    package: str
    """Name and version of the package, as in `sonar 1.2`; or a file of the project."""
    files: Callable[[], Mapping[str, bytes]] | None = None
    """Returns the file of the project and those that it imports, by path; None for an installed package."""

    @property
    def recorded(self) -> str:
        """Return the package as it is recorded: with its version, or the file of the project with a hash of its code."""
        if self.files is None:
            return self.package
        return f"{self.package} {digest('plug-in', {path: sha256(data) for path, data in self.files().items()})[:32]}"

    @property
    def remedy(self) -> str:
        if self.files:
            return f"correct {self.package}"
        return f"install a version of {self.package.partition(' ')[0]} that works, or uninstall it"


Offers = Mapping[str, Mapping[str, tuple[Offer, ...]]]
"""Offers by group of entry points and name."""


@dataclasses.dataclass(frozen=True)
class Kind:
    """One kind of plug-in."""

    word: str
    """The singular word that messages use."""
    protocol: str
    """The contract, as `module:Protocol`."""
    core: Mapping[str, str]
    """The classes by name that are no extensions, as `module:Class`."""
    options_base: type[Table] = Table
    """The class that the `Options` of these plug-ins inherit from."""
    tables: str = ""
    """The name of the tables with options in `sierra.toml`; empty: the plural of `word`."""

    @property
    def group(self) -> str:
        """Return the group of entry points."""
        return f"sierra.{self.key}"

    @property
    def key(self) -> str:
        """Return the key of `[plugins]`, which is also the last part of the group of entry points."""
        return _plural(self.word)

    @property
    def table(self) -> str:
        """Return the name of the tables with options in `sierra.toml`."""
        return self.tables or _plural(self.word)

    @cached_property
    def shipped(self) -> dict[str, str]:
        """The shipped classes by name, those of extensions included, as `module:Class`."""
        return {**self.core, **extensions.added(_plural(self.word))}

    def names(self) -> tuple[str, ...]:
        """Return the names of all plug-ins of this kind, the shipped ones first."""
        return (*self.shipped, *sorted(self._others().keys() - self.shipped.keys()))

    def added(self) -> tuple[str, ...]:
        """Return the names that other packages offer, shipped names included."""
        return tuple(sorted(self._others()))

    def installed(self) -> Mapping[str, tuple[Offer, ...]]:
        """Return the offers of installed packages by name, without those of files of a project."""
        return _offers(tuple(sys.path))[self.group]

    def packages(self, name: str) -> tuple[str, ...]:
        """Return the other packages that offer a name."""
        return tuple(offer.package for offer in self._others().get(name, ()))

    def recorded(self, name: str) -> tuple[str, ...]:
        """Return the other packages that offer a name, as they are recorded."""
        return tuple(offer.recorded for offer in self._others().get(name, ()))

    def offer(self, name: str) -> Offer:
        """Return the offer of a name that another package has. Raises ConfigError, and PluginError if it cannot be used."""
        self.load(name)
        return self._others()[name][0]

    def load(self, name: str) -> Any:
        """Return the class of that name. Raises ConfigError if there is none, and PluginError if the class cannot be used."""
        others = self._others().get(name, ())
        shipped = self.shipped.get(name)
        if len(others) + (shipped is not None) > 1:
            packages = sorted([*(offer.package for offer in others), *(["SIERRA itself"] if shipped else [])])
            raise PluginError(
                f"the {self.word} {name!r} is offered by {' and by '.join(packages)}; uninstall all but one of these packages"
            )
        if shipped is not None:
            return _attribute(shipped)
        if not others:
            raise ConfigError(self.unknown(name))
        return self._checked(others[0])

    def unknown(self, name: str) -> str:
        """Return the message that no plug-in has a name, with the extension that has it, or with all known names."""
        if home := extensions.home(_plural(self.word), name):
            return f"the {self.word} {extensions.belongs(name, home)}"
        return f"unknown {self.word} {name!r}; known are {', '.join(self.names()) or 'none'}"

    def options(self, name: str, table: RawTable) -> Table:
        """Return the options of a plug-in from its table. Raises ConfigError."""
        model: type[Table] = self.load(name).Options
        return options(model, table, f"[{self.table}.{name}]")

    def make(self, name: str, tables: Tables, *arguments: object) -> Any:
        """Return a new object of a plug-in's class, made from `arguments` and from its options in `tables`."""
        plugin, chosen = self.load(name), self.options(name, tables.get(name, {}))
        try:
            return plugin(*arguments, chosen)
        except SierraError:
            raise
        except Exception as error:
            if not (others := self._others().get(name)):
                raise
            raise _broken(self, others[0], "made", error) from error

    def check(self, tables: Tables) -> None:
        """Check all tables of this kind. Raises ConfigError for an unknown name, or options that are invalid."""

        def check(name: str) -> None:
            if name not in self.names():
                raise ConfigError(f"[{self.table}.{name}]: {self.unknown(name)}")
            self.options(name, tables[name])

        gathered(partial(check, name) for name in tables)

    def _checked(self, offer: Offer) -> type:
        """Return the class of another package. Raises PluginError if it cannot be loaded or breaks the contract."""
        try:
            loaded: Any = offer.point.load()
        except SierraError:
            raise
        except (Exception, SystemExit) as error:
            raise _broken(self, offer, "loaded", error) from error
        plugin = f"the {self.word} {offer.name!r} of {offer.package}"
        version = getattr(loaded, "contract", None)
        if version != VERSION:
            declared = "declares no version" if version is None else f"is made for version {version}"
            raise PluginError(f"{plugin} {declared} of the contract, but this SIERRA has version {VERSION}; {offer.remedy}")
        if not isinstance(loaded, type):
            raise PluginError(f"{plugin} is not a class ({offer.point.value}); {offer.remedy}")
        if lacking := [name for name in _members(_attribute(self.protocol)) if not hasattr(loaded, name)]:
            raise PluginError(f"{plugin} lacks {', '.join(lacking)}; {offer.remedy}")
        model = loaded.Options  # type: ignore[attr-defined]
        if not (isinstance(model, type) and issubclass(model, self.options_base)):
            raise PluginError(f"{plugin}: Options is not a subclass of {self.options_base.__name__}; {offer.remedy}")
        called = getattr(loaded, "name", offer.name)
        if offer.files and isinstance(called, str) and called != offer.name:
            raise PluginError(f"{plugin} calls itself {called!r}; set name = {offer.name!r}, because its class has that name")
        if (module := loaded.__module__.partition(".")[0]) != SIERRA:
            _loaded.update({module: plugin, loaded.__module__: plugin})
        return loaded

    def _others(self) -> Mapping[str, tuple[Offer, ...]]:
        installed, plugins = self.installed(), current_project.plugins()
        return {**installed, **plugins.offers.get(self.group, {})} if plugins else installed


PLATFORMS = Kind(
    "platform",
    "sierra.design.platforms.base:Platform",
    {"command": "sierra.design.platforms.command:Command"},
)
TEMPLATES = Kind(
    "template",
    "sierra.templates.base:Template",
    {
        "xml": "sierra.templates.xml:XmlTemplate",
        "json": "sierra.templates.json:JsonTemplate",
        "yaml": "sierra.templates.yaml:YamlTemplate",
        "toml": "sierra.templates.toml:TomlTemplate",
        "ini": "sierra.templates.ini:IniTemplate",
        "properties": "sierra.templates.ini:PropertiesTemplate",
        "text": "sierra.templates.text:TextTemplate",
    },
    tables="template_formats",
)
RUNNERS = Kind(
    "runner",
    "sierra.runners.base:Runner",
    {"local": "sierra.runners.local:Local"},
)
SCHEDULERS = Kind(
    "scheduler",
    "sierra.runners.schedulers.base:Scheduler",
    {"slurm": "sierra.runners.schedulers.slurm:Slurm", "pbs": "sierra.runners.schedulers.pbs:Pbs"},
    ClusterTable,
)
ENGINES = Kind(
    "engine",
    "sierra.containers.engines.base:Engine",
    {
        "none": "sierra.containers.engines.base:NoEngine",
        "podman": "sierra.containers.engines.podman:Podman",
        "apptainer": "sierra.containers.engines.apptainer:Apptainer",
    },
)
READERS = Kind(
    "reader",
    "sierra.ingest.base:OutputReader",
    {
        "csv": "sierra.ingest.csv:Csv",
        "parquet": "sierra.ingest.parquet:Parquet",
        "jsonl": "sierra.ingest.jsonl:Jsonl",
        "json": "sierra.ingest.json_rows:JsonDocument",
        "xml": "sierra.ingest.xml_rows:XmlRows",
    },
)
_KINDS = "sierra.deliverables.figures.kinds"
FIGURES = Kind(
    "figure",
    "sierra.deliverables.figures.base:FigureKind",
    {
        "timeseries": f"{_KINDS}.over_time:Timeseries",
        "summary": f"{_KINDS}.over_variable:Summary",
        "box": f"{_KINDS}.over_variable:Box",
        "violin": f"{_KINDS}.over_variable:Violin",
        "strip": f"{_KINDS}.over_variable:Strip",
        "bar": f"{_KINDS}.over_variable:Bar",
        "heatmap": f"{_KINDS}.over_variable:Heatmap",
        "stacked": f"{_KINDS}.over_time:Stacked",
        "ecdf": f"{_KINDS}.distributions:Ecdf",
        "histogram": f"{_KINDS}.distributions:Histogram",
        "scatter": f"{_KINDS}.pairs:Scatter",
        "trajectories": f"{_KINDS}.arena:Trajectories",
        "density": f"{_KINDS}.arena:Density",
        "matrix": f"{_KINDS}.arena:Matrix",
    },
)
"""Kinds of figures. Their options are in the table of each figure that has this `kind`."""
STATISTICS = Kind(
    "statistic",
    "sierra.stats.base:Statistic",
    {
        "mean": "sierra.stats.shipped:Mean",
        "median": "sierra.stats.shipped:Median",
        "iqm": "sierra.stats.shipped:InterquartileMean",
        "sd": "sierra.stats.shipped:StandardDeviation",
        "iqr": "sierra.stats.resampled:InterquartileRange",
        "mad": "sierra.stats.resampled:MedianAbsoluteDeviation",
        "range": "sierra.stats.shipped:Range",
    },
)
_COMPARISON = "sierra.stats.comparison"
COMPARISONS = Kind(
    "comparison",
    f"{_COMPARISON}.base:ComparisonMethod",
    {
        "signed_rank": f"{_COMPARISON}.shipped:SignedRank",
        "rank_sum": f"{_COMPARISON}.shipped:RankSum",
        "friedman": f"{_COMPARISON}.shipped:Friedman",
        "kruskal": f"{_COMPARISON}.shipped:Kruskal",
        "mcnemar": f"{_COMPARISON}.shipped:McNemar",
        "fisher": f"{_COMPARISON}.shipped:Fisher",
        "log_rank": f"{_COMPARISON}.shipped:LogRank",
        "aligned_ranks": f"{_COMPARISON}.shipped:AlignedRanks",
    },
    tables="comparison_methods",
)
"""Methods of comparisons; `[comparisons.NAME]` are comparisons, so the options have tables of another name."""
CRITERIA = Kind(
    "criterion",
    "sierra.design.query.base:Range",
    {"Log": "sierra.design.query.named_ranges:LogRange", "Linear": "sierra.design.query.named_ranges:LinearRange"},
)
LINKS = Kind(
    "link",
    "sierra.runners.links.base:Link",
    {},
)
KINDS = (PLATFORMS, TEMPLATES, RUNNERS, LINKS, SCHEDULERS, ENGINES, READERS, STATISTICS, FIGURES, COMPARISONS, CRITERIA)


def culprit(error: BaseException) -> str | None:
    """Return the plug-in, in words, in whose code an error arose; None if it arose in SIERRA."""
    owner: str | None = None
    at: TracebackType | None = error.__traceback__
    while at is not None:
        name = str(at.tb_frame.f_globals.get("__name__", ""))
        module = name.partition(".")[0]
        if module == SIERRA or module in _loaded:
            owner = _loaded.get(name, _loaded.get(module))
        at = at.tb_next
    return owner


@cache
def _offers(path: tuple[str, ...]) -> Offers:
    """Return the installed entry points by group and name. They are cached, because a search on `path` takes 6 ms."""
    from importlib.metadata import entry_points

    installed = entry_points()
    by_group: dict[str, dict[str, tuple[Offer, ...]]] = {}
    for group in (kind.group for kind in KINDS):
        offers = by_group[group] = {}
        for point in installed.select(group=group):
            package = f"{point.dist.name} {point.dist.version}" if point.dist else point.value
            offers[point.name] = (*offers.get(point.name, ()), Offer(point.name, point, package))
    return by_group


def _plural(word: str) -> str:
    return "criteria" if word == "criterion" else f"{word}s"


def _attribute(name: str) -> type:
    """Return what `module:name` names."""
    module, _, attribute = name.partition(":")
    found: type = getattr(import_module(module), attribute)
    return found


def _members(protocol: type) -> Iterable[str]:
    """Yield the names that a class must have to fulfil a protocol: its methods, properties and class variables."""
    for name, value in vars(protocol).items():
        if not name.startswith("_") and (callable(value) or isinstance(value, property | staticmethod | classmethod)):
            yield name
    yield from (name for name, kind in vars(protocol).get("__annotations__", {}).items() if "ClassVar" in str(kind))


def _broken(kind: Kind, offer: Offer, what: str, error: BaseException) -> PluginError:
    reason = " ".join(f"{type(error).__name__}: {error}".split())
    return PluginError(
        f"the {kind.word} {offer.name!r} of {offer.package} ({offer.point.value}) cannot be {what}: {reason}; {offer.remedy}"
    )
