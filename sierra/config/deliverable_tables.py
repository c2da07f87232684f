"""Tables of `sierra.toml` about deliverables: derived tables, the limits on their SQL, figures, comparisons."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Literal

from pydantic import AfterValidator, BeforeValidator, ConfigDict, Field, model_validator

from sierra.config.field_types import (
    OF_RUN,
    OF_WALL,
    Alpha,
    Experiments,
    Finite,
    Labels,
    ListOfWords,
    Measured,
    OfStatement,
    OfTable,
    Positive,
    RawTable,
    Table,
    Threshold,
    Where,
    check_threshold,
)
from sierra.config.field_types import Size as SizeInBytes
from sierra.model import Measure
from sierra.util.text import like

Size = Literal[
    "ieee-column", "ieee-page", "acm-column", "acm-page", "lncs", "elsevier-column", "elsevier-page", "neurips", "slide"
]
AROUND = {"sd": ("mean", "iqm"), "mad": ("median",)}
"""The bands that are distances from the center, and the centers that have them."""
WIDTHS = ("sd", "iqr", "mad", "range")
"""The centers that are no places among the runs."""
Palette = Literal["okabe-ito", "petroff", "viridis", "cividis", "grey"]
Format = Literal["png", "pdf", "svg", "html", "pgf", "txt", "tex"]
PRINTED: tuple[Format, ...] = ("png", "pdf", "svg")
DEFAULT_FORMATS: tuple[Format, ...] = (*PRINTED, "txt", "tex")
"""The formats in which figures are drawn by default."""


def _ascending(limits: tuple[float, float]) -> tuple[float, float]:
    if not limits[0] < limits[1]:
        raise ValueError(f"[{limits[0]:g}, {limits[1]:g}] should be the lower and the upper limit")
    return limits


def _different(formats: tuple[Format, ...]) -> tuple[Format, ...]:
    if twice := next((name for name in formats if formats.count(name) > 1), None):
        raise ValueError(f"{twice!r} is named twice")
    return formats


Unique = Field(min_length=1, json_schema_extra={"uniqueItems": True})
Formats = Annotated[tuple[Format, ...], Unique, AfterValidator(_different)]
Part = Annotated[float, Field(gt=0, lt=1)]


def _queries(words: tuple[str, ...]) -> tuple[str, ...]:
    for word in words:
        if not word.split() or any(part.startswith("-") for part in word.split()):
            raise ValueError(f"{word!r} is neither the name of a query nor criteria; options belong to [queries.NAME]")
    return words


Bound = Annotated[
    ListOfWords,
    AfterValidator(_queries),
    Field(
        description="the query whose last batch is shown, and no other: the name of one in `queries`, or a text as for `sierra "
        "run`; several are shown together, and a name may have a label: `LABEL=NAME`; default: the batch that is chosen"
    ),
]
LimitsOfAxis = Annotated[tuple[Finite, Finite], AfterValidator(_ascending)]
LimitsOfX = Annotated[LimitsOfAxis | None, Field(description="limits of the x axis; what is beyond them is cut off")]
LimitsOfY = Annotated[LimitsOfAxis | None, Field(description="limits of the y axis; what is beyond them is cut off")]
OF_SIZE = Field(
    description="width of the figure, by the name of a template of papers, or width and height in inches; `slide` is 5 × 2.8 "
    "inches, to be enlarged; default: a column of 3.5 inches, or a page for many panels"
)
Title = Annotated[str, Field(description="title above the figure or the frames")]
Layout = Annotated[
    Literal["spring", "kamada_kawai", "circular"],
    Field(description="layout if `place` is not given, of the edges of all times; the same in all panels and at all times"),
]
Footnote = Annotated[str, Field(description="text below the figure or table, after what SIERRA writes there")]
RowsOf = Annotated[str, Field(description="a SELECT statement instead of a `table`, as in `[tables.NAME]`")]


class DerivedTable(Table):
    """One table that SQL makes from outputs, the store's tables and other derived tables. It is used like an output."""

    sql: str = Field("", description="one SELECT statement (DuckDB's dialect); give either `sql` or `file`")
    file: OfStatement = None
    time: str = Field("", description="column that is the time axis; default: the first column, if it is named like a time")
    units: Mapping[str, str] = Field(default_factory=dict, description="unit of each column in figures")
    description: str = Field("", description="what the table contains, for readers")

    @model_validator(mode="after")
    def _fitting(self) -> DerivedTable:
        if bool(self.sql.strip()) == (self.file is not None):
            raise ValueError('give either "sql" or "file"')
        return self


class SqlLimits(Table):
    """Limits on the statements of `[tables.NAME]` and of figures, and on conditions (`where`)."""

    wall: Annotated[Positive, OF_WALL] = 300.0
    memory: SizeInBytes = Field(
        4_000_000_000,
        description="memory limit of all derived tables of a command, in bytes or as in `2 GiB`; four times as much may be "
        "written to the disk",
    )


FORMERLY_POSES = BeforeValidator(lambda kind: "trajectories" if kind == "poses" else kind)
"""Reads the former name of a kind of figures and videos."""


class Figure(Table):
    """One figure. If there are none, each numeric column of each output gets a time series and a summary.

    A kind may have keys of its own, which are beside these.
    """

    model_config = ConfigDict(extra="allow", frozen=True)

    kind: Annotated[str, Field(min_length=1), FORMERLY_POSES] = Field(
        "timeseries",
        description="over time: `timeseries`, `stacked`; over variables: `summary`, `bar`, `box`, `violin`, `strip`, "
        "`heatmap`; "
        "distributions of runs: `ecdf`, `histogram`, `ridge`, `survival`; ranks: `critical_difference`; several columns of "
        "runs: `scatter`, `pareto`, `embedding`; rows: `trajectories`, `density`, `matrix`, `network`, `confusion`, `roc`, "
        "`pr`, `risk_coverage`; or a plug-in",
    )
    inherit: str = Field(
        "", description="name of another figure, or of `figure_defaults`, whose keys are taken unless this figure has its own"
    )
    query: Bound = ()
    table: OfTable = ""
    sql: RowsOf = ""
    columns: ListOfWords = Field((), alias="column", description="column, or the columns that the kind needs")
    times: Literal["own", "carry", "linear"] | None = Field(
        None,
        description="times of values drawn over time: `own`: each run's own times; `carry`, `linear`: common times, with the "
        "last values carried forward or linear interpolation; default: `own`, or `carry` if most times differ between runs",
    )
    measure: Annotated[Measure, OF_RUN] = "final"
    threshold: Threshold = None
    center: str = Field(
        "mean",
        description="statistic that is shown, by its name in `sierra stats --statistic`: `mean`, `median`, `iqm`, a quantile "
        "such as `q90`, … or a plug-in; the mean of flags is a rate",
    )
    band: Literal["ci", "sd", "iqr", "mad", "range", "quantiles"] | None = Field(
        None,
        description="the interval around the center: `ci`: its 95 % interval, as in `sierra stats`; `sd`: one standard "
        "deviation; `iqr`: quartiles; `mad`: one median absolute deviation, around a median; `range`: the smallest and the "
        "largest value; `quantiles`: those of the key `quantiles`; default: `ci`, or `iqr` around a median",
    )
    quantiles: Annotated[tuple[Part, Part], AfterValidator(_ascending)] = Field(
        (0.05, 0.95), description='the two quantiles of `band = "quantiles"`, as parts between 0 and 1'
    )
    where: Where = ""
    controllers: ListOfWords = Field(
        (),
        description="controllers that are shown, in this order, by name, label or category (`depth0` stands for all names that "
        "begin with `depth0.`); default: all",
    )
    scenarios: ListOfWords = Field((), description="scenarios that are shown, in this order, as in `controllers`")
    x: str = Field("", description="variable of the x axis; default: the first")
    series: str = Field("", description="variable with a line, colour or mark for each value; default: the next one")
    facet: str = Field("", description="variable with a panel of its own for each value")
    title: Title = ""
    xlabel: str = Field("", description="label of the x axis; default: name and unit of the time or the variable")
    ylabel: str = Field("", description="label of the values; default: the column's name and unit")
    log_x: bool | None = Field(
        None,
        description="logarithmic or linear x axis; default: linear, but logarithmic for a variable with values such as 1, 2, 4",
    )
    log_y: bool = Field(False, description="logarithmic scale of the values (in a heatmap: of the colours)")
    xlim: LimitsOfX = None
    ylim: LimitsOfY = None
    size: Annotated[Size | tuple[Positive, Positive], OF_SIZE] = "ieee-column"
    legend: Literal["above", "right", "below"] = Field("above", description="place of the legend, never on the data")
    panel_titles: Literal["values", "letters"] = Field(
        "values", description="titles of panels: values of their variables, after (a), (b), … with `letters`"
    )
    small_print: bool = Field(
        True, description="write notes such as n and the interval below the figure; the caption (`txt`, `tex`) always has them"
    )
    palette: Palette | Annotated[tuple[str, ...], Field(min_length=1)] = Field(
        "okabe-ito", description="colours of categories: the name of a palette, or a list of colours such as `#0072B2`"
    )
    labels: Labels = Field(default_factory=dict)
    footnote: Footnote = ""
    formats: Formats | None = Field(None, description="formats of the files; default: `figure_formats`")

    @model_validator(mode="after")
    def _fitting(self) -> Figure:
        if self.table and self.sql:
            raise ValueError('give either "table" or "sql"')
        check_threshold(self.measure, self.threshold)
        if self.band in AROUND and self.center not in AROUND[self.band]:
            centers = " or ".join(f'"{name}"' for name in AROUND[self.band])
            raise ValueError(f'band "{self.band}" is a distance from the center {centers}, not from "{self.center}"')
        if self.center in WIDTHS and self.band not in (None, "ci"):
            raise ValueError(f'band "{self.band}" shows where runs are, but "{self.center}" is a width; use band = "ci"')
        if "quantiles" in self.model_fields_set and self.band != "quantiles":
            raise ValueError('"quantiles" needs band = "quantiles"')
        return self

    @model_validator(mode="after")
    def _known_center(self) -> Figure:
        from sierra.config.statistic_names import complaint

        if wrong := complaint(self.center):
            raise ValueError(f"center: {wrong}")
        return self

    @model_validator(mode="after")
    def _of_its_kind(self) -> Figure:
        from sierra.config.figure_options import complaint_if_shipped

        if wrong := complaint_if_shipped(self):
            raise ValueError(wrong)
        return self

    @property
    def own(self) -> RawTable:
        """Return the keys that only this kind has, as they are written."""
        return self.model_extra or {}


class TableForPaper(Table):
    """One table for papers: statistics of columns in each experiment, or the rows of an SQL statement."""

    query: Bound = ()
    table: OfTable = ""
    columns: ListOfWords = Field(
        (), alias="column", description="column, or columns, of which there are statistics; default: the only one"
    )
    sql: str = Field(
        "", description="a SELECT statement; each table that it reads has a column `batch`, with the label of the batch"
    )
    statistics: ListOfWords = Field(
        ("mean",), min_length=1, description="statistics, each with its interval, as in `sierra stats --statistic`"
    )
    measure: Annotated[Measure | None, OF_RUN] = None
    threshold: Threshold = None
    experiments: Experiments = ""
    across: str = Field(
        "",
        description="variable whose values are side by side, each with columns of its own; `batch`: the batches, which are so "
        "by default if there are several; with `sql`: a column, whose values get the columns after it",
    )
    digits: Annotated[int, Field(ge=0, le=15)] | Mapping[str, Annotated[int, Field(ge=0, le=15)]] = Field(
        default_factory=dict,
        description="with `sql`: digits after the decimal point, of all numbers or by column; default: those of the interval "
        "if there are columns `NAME_low` and `NAME_high` beside `NAME`, else four significant digits",
    )
    headers: Mapping[str, str] = Field(default_factory=dict, description="headers of columns, by their name")
    caption: str = Field("", description="caption of the table")
    latex: bool = Field(False, description="`caption` and `headers` are LaTeX, and are not escaped in this format")
    label: Annotated[str, Field(pattern=r"^[A-Za-z0-9:._-]*$")] = Field("", description="label, such as `tab:coverage`")
    footnote: Footnote = ""
    formats: Annotated[tuple[Literal["latex", "markdown", "html", "csv"], ...], Field(min_length=1)] = Field(
        ("latex",), description="formats of the files: `latex` (with booktabs), `markdown`, `html`, `csv`"
    )

    @model_validator(mode="after")
    def _fitting(self) -> TableForPaper:
        check_threshold(self.measure, self.threshold)
        names = {field.alias or name for name, field in TableForPaper.model_fields.items() if name in self.model_fields_set}
        if self.sql and (wrong := sorted(names & {"table", "column", "statistics", "measure", "experiments"})):
            raise ValueError(f'"{wrong[0]}" is for statistics; "sql" has the rows of the table as they are')
        if not self.sql and "digits" in names:
            raise ValueError('"digits" needs "sql"; statistics are rounded by their intervals')
        return self


def known_method(name: str) -> str:
    """Return the name of a comparison method. Raises ValueError for an unknown one."""
    from sierra.config.plugin_registry import COMPARISONS

    if name not in ("auto", *COMPARISONS.shipped) and name not in COMPARISONS.names():
        raise ValueError(f"unknown method {name!r}; {like(name, ['auto', *COMPARISONS.names()], 'known are')}")
    return name


class Comparison(Measured):
    """One comparison of groups of runs, for `sierra compare NAME`."""

    groups: ListOfWords = Field(
        (),
        description="with `by`: the values to compare, the first one first; default: all. Without `by`: two or more batches, "
        "each as the name of a query in `queries` or the prefix of an id, or as `LABEL=` and one of these",
    )
    query: Bound = ()
    by: ListOfWords = Field(
        (),
        description="the variable whose values are compared within one batch; several: a factorial comparison, with main "
        "effects and interactions; default: the batch's only variable",
    )
    over_time: bool = Field(
        False,
        description="draw the difference over time, with its interval at each time, which is no test; what is tested is "
        "the mean of each run's rows, or its `time_mean`",
    )
    method: Annotated[str, Field(min_length=1), AfterValidator(known_method)] = Field(
        "auto",
        description="how groups are tested: `signed_rank`, `friedman` (pairs), `rank_sum`, `kruskal` (no pairs), `mcnemar` "
        "(rates, pairs), `fisher` (rates, no pairs), `log_rank` (times that runs never reached), `aligned_ranks` (several "
        "variables in `by`), or a plug-in; `auto`: what suits the data",
    )
    paired: bool | Literal["auto"] = Field(
        "auto", description="whether runs with the same seed are compared as pairs; `auto`: if their values are correlated"
    )
    against: str | None = Field(
        None, description="the group that all others are compared with; default: each group is compared with each other one"
    )
    margin: Positive | None = Field(
        None, description="the largest difference that does not matter, in the column's unit: also test for equivalence"
    )
    alpha: Alpha = 0.05
    size: Annotated[Size | tuple[Positive, Positive] | None, OF_SIZE] = None
    labels: Labels = Field(default_factory=dict)

    @model_validator(mode="after")
    def _fitting(self) -> Comparison:
        if self.query and (len(self.query) > 1 or (self.groups and not self.by)):
            raise ValueError('"query" is one query, and needs "by"; "groups" without "by" are batches or names of queries')
        if self.over_time and self.measure not in (None, "mean", "time_mean"):
            raise ValueError(f'"over_time" tests the measure "mean" or "time_mean", not {self.measure!r}')
        if self.over_time and self.where:
            raise ValueError('"where" chooses rows, so it cannot be used with "over_time"')
        return self
