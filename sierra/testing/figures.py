"""Conformance suite for kinds of figures, as functions that a plug-in's author calls in tests.

    from sierra.testing import figures as conformance

    def test_it_is_a_kind_of_figure():
        conformance.check("mykind", {"bins": 20})

The package must be installed, because kinds are found by their name. The suite makes batches in memory: two experiments of
some runs with some rows each. `keys` are those of `[figures.NAME]`. `values` gives the columns of one row from the number
of its experiment, run and row; by default these are the two numbers `energy` and `distance`. Each claim is one function of a
`Trial`, and can be called alone. A broken claim raises AssertionError with one line, even if Python runs with `-O`.
"""

from __future__ import annotations

import itertools
import math
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING, TypeAlias

from sierra.config.deliverable_tables import DEFAULT_FORMATS, Figure
from sierra.config.field_types import RawTable
from sierra.config.plugin_registry import FIGURES
from sierra.config.validate import options
from sierra.deliverables.figures.drawing import Drawing, noted, painted, rendered
from sierra.deliverables.figures.drawing import check as enough
from sierra.deliverables.figures.formats import named
from sierra.deliverables.figures.gather import Batch, gather
from sierra.deliverables.record import ORIGIN
from sierra.errors import SierraError, UsageError
from sierra.model import Axis
from sierra.stats import aggregate as stats
from sierra.stats.base import Parameter
from sierra.store.sql_names import identifier
from sierra.testing.assertions import holds, is_one_line, says_what_its_options_are

if TYPE_CHECKING:
    import pyarrow as pa

    from sierra.store.connections import Database

Row: TypeAlias = Mapping[str, "float | str | None"]
Values: TypeAlias = Callable[[int, int, int], Row]
LONG = "a rather long name of a scenario with obstacles, number {}"
HEAVY = ("matplotlib", "seaborn", "pandas", "scipy", "networkx", "sklearn")
RUNS = 6
ROWS = 8


def numbers(experiment: int, run: int, row: int) -> Row:
    """Return two numbers above 0 that look random but are always the same."""
    noise = math.modf(math.sin(12.9898 * (experiment * 97 + run * 31 + row + 1)) * 43758.5453)[0]
    energy = 10.0 * (experiment + 1) + row + abs(noise)
    return {"energy": energy, "distance": 2.0 + energy / 7 + abs(noise)}


@dataclass(frozen=True)
class Trial:
    """A kind to test, its keys, and the values of rows."""

    kind: str
    keys: RawTable = field(default_factory=dict)
    values: Values = numbers
    axes: tuple[Axis, ...] = (Axis("size", (1, 2)),)

    def figure(self, **more: object) -> Figure:
        table = {"kind": self.kind, "column": tuple(self.values(0, 0, 0))[:1], **self.keys, **more}
        return options(Figure, table, "[figures.trial]")

    def drawing(
        self,
        axes: Sequence[Axis] | None = None,
        runs: Callable[[int], int] = lambda experiment: RUNS,
        values: Values | None = None,
        **more: object,
    ) -> Drawing:
        """Return the drawing of a batch with these axes, and with as many runs for each experiment as `runs` says."""
        figure = self.figure(**more)
        used = self.axes if axes is None else axes
        points = list(itertools.product(*(axis.values for axis in used)))
        cells = {k: dict(zip((axis.name for axis in used), point, strict=True)) for k, point in enumerate(points)}
        memory = _Memory(_rows(values or self.values, len(cells), runs))
        batch = Batch(tuple(used), cells, {k: runs(k) for k in cells}, "0" * 64)
        seen = stats.coverage(memory.samples(figure.columns[0]), several=True)
        return gather("trial", figure, figure.columns, batch, memory, seen)

    def drawn(self, drawing: Drawing, formats: Sequence[str] = ("svg",)) -> Mapping[str, bytes]:
        enough(drawing)
        return dict(rendered(replace(drawing, formats=named(formats))))

    def drawn_or_refused(self, make: Callable[[], Drawing]) -> tuple[Drawing | None, str]:
        """Draw; return the drawing and its small print, or None and the message of one line why it cannot be drawn."""
        from sierra.deliverables.figures import style

        try:
            drawing = make()
            enough(drawing)
            drawing = noted(drawing)
            with style.applied(drawing.figure):
                painted(drawing)
            return drawing, drawing.note
        except SierraError as error:
            is_one_line(str(error))
            return None, str(error)


class _Memory:
    """A source of figures in memory."""

    def __init__(self, rows: pa.Table) -> None:
        from sierra.store.connections import connect

        self._connection = connect()
        self._connection.register("data", rows)
        self._columns = [name for name in rows.column_names if name != "run" and not name.startswith("#")]

    def check(self, columns: Sequence[str], *, numeric: bool) -> None:
        for column in columns:
            if column not in self._columns:
                raise UsageError(f"there is no column {column!r}; there is {', '.join(self._columns)}")

    def samples(self, column: str) -> stats.Column:
        return _Samples(self._connection, column)

    def rows(self, statement: str) -> pa.Table:
        return self._connection.sql(statement).to_arrow_table()

    def seeds(self) -> Mapping[tuple[int, str], int]:
        rows = self._connection.sql('SELECT DISTINCT "# experiment", run, "# number" FROM data').fetchall()
        return {(experiment, run): 1000 + number for experiment, run, number in rows}


@dataclass(frozen=True)
class _Samples:
    """One column for statistics."""

    connection: Database
    column: str

    def sql(self, text: str, /, **parameters: Parameter) -> pa.Table:
        number = f"TRY_CAST({identifier(self.column)} AS DOUBLE) AS value"
        keys = '"# experiment" AS experiment, run, "# number" AS number, "# t" AS t, "# t" AS shared_t'
        keys += ", NULL::VARCHAR AS file, NULL::BIGINT AS place"
        self.connection.sql(f"SELECT {keys}, {number} FROM data").create_view("samples")  # noqa: S608 - quoted names only
        return self.connection.sql(text, params=parameters).to_arrow_table()


def _rows(values: Values, experiments: int, runs: Callable[[int], int]) -> pa.Table:
    """Return the rows of all runs, as the relation `data` has them."""
    import pyarrow as pa

    places = [(e, run, row) for e in range(experiments) for run in range(runs(e)) for row in range(ROWS)]
    cells = [values(*ids) for ids in places]
    own = {f"# {name}": pa.array([ids[k] for ids in places], pa.int32()) for k, name in enumerate(("experiment", "number"))}
    times = [row for _, _, row in places]
    own |= {"# place": pa.array(times, pa.int64()), "# t": pa.array(map(float, times), pa.float64())}
    own["run"] = pa.array([f"{e:02}-{run:02}" for e, run, _ in places], pa.string())
    return pa.table(own | {name: pa.array([row[name] for row in cells]) for name in values(0, 0, 0)})


def check(
    kind: str, keys: RawTable | None = None, values: Values = numbers, axes: Sequence[Axis] = (Axis("size", (1, 2)),)
) -> None:
    """Check all claims about a kind of figures, by its name.

    `keys` are those of `[figures.NAME]` beside `kind`; the default of `column` is the first one of `values`, which returns the
    columns of one row from the number of its experiment, run and row. `axes` are the variables of an ordinary batch; see the
    module for the others.
    """
    trial = Trial(kind, keys or {}, values, tuple(axes))
    for claim in CLAIMS:
        claim(trial)


def declares_options(trial: Trial) -> None:
    says_what_its_options_are(FIGURES.load(trial.kind))


def loads_nothing_heavy(trial: Trial) -> None:
    """Check that the class can be loaded without a library that draws or computes."""
    code = (
        "import sys; from sierra.config.plugin_registry import FIGURES; FIGURES.load(sys.argv[1]); "
        f"print(*(name for name in {HEAVY!r} if name in sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", code, trial.kind], capture_output=True, text=True, check=False)
    holds(done.returncode == 0, f"it cannot be loaded: {done.stderr.strip().splitlines()[-1:]}")
    holds(not done.stdout.split(), f"importing its module imports {done.stdout.strip()}; import it in `draw`")


def gives_the_same_bytes_again(trial: Trial) -> None:
    """Check that the same data give the same bytes, in each format."""
    first, again = (trial.drawn(trial.drawing(), (*DEFAULT_FORMATS, "html")) for _ in range(2))
    for ending, data in first.items():
        holds(data == again[ending], f"the same data give other bytes of {ending} when they are drawn again")
    other = trial.drawn(trial.drawing(values=lambda e, run, row: trial.values(e, run + 1, row)))
    shown, before = (ORIGIN.sub(b"", files["svg"]) for files in (other, first))  # each file names the hash of its data
    holds(shown != before, "other data give the same figure")


def draws_few_and_unequal_runs(trial: Trial) -> None:
    """Check that one run, and experiments with different numbers of runs, are drawn or refused in one line."""
    trial.drawn_or_refused(lambda: trial.drawing(runs=lambda experiment: 1))
    drawing, text = trial.drawn_or_refused(lambda: trial.drawing(runs=lambda experiment: RUNS - 3 * experiment))
    holds(drawing is not None, f"experiments with {RUNS} and {RUNS - 3} runs are refused: {text}")


def draws_one_experiment(trial: Trial) -> None:
    """Check that a batch without a variable is drawn, or refused in one line."""
    trial.drawn_or_refused(lambda: trial.drawing(axes=()))


def refuses_data_without_values(trial: Trial) -> None:
    """Check that values that are all missing are refused in one line."""

    def nothing(experiment: int, run: int, row: int) -> Row:
        return {name: math.nan if isinstance(value, float) else None for name, value in trial.values(0, 0, 0).items()}

    drawing, _ = trial.drawn_or_refused(lambda: trial.drawing(values=nothing))
    holds(drawing is None, "values that are all missing are drawn")


def draws_values_that_are_missing(trial: Trial) -> None:
    """Check that data with holes are drawn or refused in one line, and that the small print counts the holes."""

    def holes(experiment: int, run: int, row: int) -> Row:
        given = trial.values(experiment, run, row)
        missing = {name: math.nan if isinstance(value, float) else None for name, value in given.items()}
        return missing if (run + row) % 3 == 1 else given

    drawing, text = trial.drawn_or_refused(lambda: trial.drawing(values=holes))
    if drawing is not None:
        holds("left out" in text, "missing values are left out without a word in the small print")


def draws_many_series_and_long_names(trial: Trial) -> None:
    """Check that 64 series, and long names, are drawn within the figure or refused in one line."""
    many = Axis("number", tuple(range(64)))
    names = Axis("a_long_name_of_a_variable" * 3, tuple(LONG.format(k) for k in range(3)))
    first = (trial.axes or (Axis("size", (1, 2)),))[0]
    for axes in ((many,), (first, many), (names,), (first, names)):
        trial.drawn_or_refused(partial(trial.drawing, axes=axes, runs=lambda experiment: 3))


def keeps_text_within_the_figure(trial: Trial) -> None:
    """Check that title, labels, legends and small print neither leave the figure nor cover each other."""
    from sierra.deliverables.figures import style

    names = Axis("terrain", tuple(LONG.format(k) for k in range(3)))
    axes = (names, *trial.axes[1:]) if trial.axes else ()
    drawing = trial.drawing(axes=axes, title="A title " * 12)
    with style.applied(drawing.figure):
        figure = painted(drawing)
        figure.canvas.draw()
        outer = figure.bbox.padded(2)
        around = [item.get_window_extent() for item in (*figure.legends, *figure.texts)]
        boxes = [*around, *(box for plot in figure.axes if (box := plot.get_tightbbox()) is not None)]
        for box in boxes:
            inside = outer.x0 <= box.x0 and box.x1 <= outer.x1 and outer.y0 <= box.y0 and box.y1 <= outer.y1
            holds(inside, f"something leaves the figure: {box} is not in {outer}")
        for box, other in itertools.combinations(around, 2):
            holds(not box.overlaps(other), "title, legend or small print cover each other")


def notes_what_a_log_axis_cannot_show(trial: Trial) -> None:
    """Check that values below 0 on a logarithmic axis are noted or refused in one line."""

    def shifted(experiment: int, run: int, row: int) -> Row:
        given = trial.values(experiment, run, row)
        return {name: value - 22.0 if isinstance(value, float) else value for name, value in given.items()}

    if "log_y" in FIGURES.load(trial.kind).uses:
        drawing, text = trial.drawn_or_refused(lambda: trial.drawing(values=shifted, log_y=True))
        holds(drawing is None or "log scale" in text, "a logarithmic axis leaves values out without a word in the small print")


CLAIMS: tuple[Callable[[Trial], None], ...] = (
    declares_options,
    loads_nothing_heavy,
    gives_the_same_bytes_again,
    draws_few_and_unequal_runs,
    draws_one_experiment,
    refuses_data_without_values,
    draws_values_that_are_missing,
    draws_many_series_and_long_names,
    keeps_text_within_the_figure,
    notes_what_a_log_axis_cannot_show,
)
