"""Kinds of figures are plug-ins: a package adds one with keys of its own, and SIERRA computes what it needs."""

from __future__ import annotations

import subprocess
import sys
from functools import cache
from pathlib import Path
from xml.etree import ElementTree

import pytest
from PIL import Image

import sierra
from tests import plugins, projects

SVG = "{http://www.w3.org/2000/svg}"
COVERAGE = ('table = "swarm"', 'column = "coverage"')

DOTS = """
from typing import ClassVar
from pydantic import Field
from sierra.plugin import Needs, Table, UsageError

class Keys(Table):
    most: int = Field(5, ge=1, description="largest number of rows")

class Dots:
    contract = 1
    Options: ClassVar[type[Table]] = Keys
    uses: ClassVar[frozenset[str]] = frozenset()

    def __init__(self, options):
        self._most = options.most

    def needs(self, request):
        if not request.axes:
            raise UsageError("dots need a variable")
        sql = f'SELECT "# experiment", "# t", "{request.columns[0]}" AS y FROM data ORDER BY ALL LIMIT {self._most}'
        return Needs(rows={"dots": sql}, shows="each dot a row")

    def notes(self, drawing):
        return [f"{drawing.rows['dots'].num_rows} rows"]

    def draw(self, drawing):
        from sierra.deliverables.figures import style
        figure = style.blank()
        rows = drawing.rows["dots"]
        figure.add_subplot().plot(style.column(rows, "# t"), style.column(rows, "y"), "o")
        return figure
"""


SIMULATOR = """\
import math, sys

arena = open(sys.argv[1]).read()
count = int(arena.split('<swarm count="')[1].split('"')[0])
seed = int(arena.split('<random seed="')[1].split('"')[0])
noise = float(arena.split("<noise>")[1].split("<")[0])
with open("swarm.csv", "w") as swarm, open("poses.csv", "w") as poses, open("guesses.csv", "w") as guesses:
    print("tick,coverage,energy", file=swarm)
    print("tick,robot,x,y", file=poses)
    print("truth,predicted,score", file=guesses)
    for tick in range(6):
        print(tick, count * tick + noise * (seed % 100), 5 + tick + seed % 7, sep=",", file=swarm)
        for robot in range(count):
            angle = tick / 3 + robot + seed % 5
            print(tick, robot, 3 * math.cos(angle), 2 * math.sin(angle), sep=",", file=poses)
        truth = (seed + tick) % 2
        score = truth * 0.4 + (seed * (tick + 3)) % 61 / 100
        print("ab"[truth], "ab"[score > 0.5], score, sep=",", file=guesses)
"""
"""A simulator that writes a series, poses of robots, and guesses of a classifier."""


@pytest.fixture(scope="module")
def batch(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A project with one batch of two variables; tests declare figures of it."""
    folder = projects.make(tmp_path_factory.mktemp("kinds") / "project", simulator=SIMULATOR)
    done = projects.quick(folder, "run", "population_size=1,2,4", "noise=0.1,0.5", "--runs", "3", "--no-figures")
    assert done.returncode == 0, done.stderr
    return folder


@pytest.fixture
def dots(batch: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The project, where a package with the kind `dots` is installed."""
    place = plugins.write(tmp_path / "site", "dotted", {"sierra.figures dots": "Dots"}, DOTS)
    monkeypatch.syspath_prepend(str(place))
    return batch


def declare(folder: Path, *lines: str) -> None:
    """Write the project's file with one figure `f`."""
    (folder / "sierra.toml").write_text("\n".join([projects.CONFIG, "[figures.f]", *lines, ""]))


@cache
def batch_of(folder: Path) -> str:
    """Return the id of the only batch of a project."""
    return projects.quick(folder, "sql", "SELECT batch FROM batches").stdout.split()[-1]


def draw(folder: Path, *lines: str) -> Path:
    """Draw one figure; return the path of the PNG."""
    declare(folder, *lines)
    done = projects.quick(folder, "figures", batch_of(folder), "f")
    assert done.returncode == 0, done.stderr
    return folder / done.stdout.splitlines()[0]


def refusal(folder: Path, *lines: str) -> str:
    """Return the one line that says why a figure cannot be drawn."""
    declare(folder, *lines)
    done = projects.quick(folder, "figures", batch_of(folder), "f")
    assert done.returncode in (1, 2), done.stdout
    (line,) = done.stderr.splitlines()
    return line


def words(png: Path) -> list[str]:
    """Return the texts of a figure."""
    return ["".join(item.itertext()) for item in ElementTree.parse(png.with_suffix(".svg")).iter(f"{SVG}text")]  # noqa: S314


def said(png: Path) -> str:
    with Image.open(png) as image:
        image.load()
        held: dict[str, str] = image.text  # type: ignore[attr-defined]
    return held["Description"]


@pytest.mark.integration
def test_a_kind_of_another_package_draws_rows_that_it_queried(dots: Path) -> None:
    assert said(draw(dots, 'table = "swarm"', 'kind = "dots"', "most = 3")) == "each dot a row, n = 3; 3 rows"


@pytest.mark.parametrize(
    ("lines", "complaint"),
    [
        (("mots = 3",), "unknown key 'mots'; did you mean 'most'?"),
        (("most = 0",), "kind 'dots': most should be greater than or equal to 1, not 0"),
        (('measure = "mean"',), '"measure" needs kind "summary", "box", "violin"'),
    ],
)
def test_wrong_keys_of_an_added_kind_are_refused_before_anything_executes(
    dots: Path, lines: tuple[str, ...], complaint: str
) -> None:
    declare(dots, 'table = "swarm"', 'kind = "dots"', *lines)
    for command in (("run", "population_size=4"), ("figures",)):
        done = projects.quick(dots, *command)
        assert (done.returncode, complaint in done.stderr) == (2, True), done.stderr
        assert "Traceback" not in done.stderr


@pytest.mark.nightly
def test_doctor_and_schema_list_the_keys_of_an_added_kind(dots: Path) -> None:
    assert "figure dots" in projects.quick(dots, "doctor").stdout
    assert "most  whole number  5" in projects.quick(dots, "schema", "most").stdout


@pytest.mark.integration
@pytest.mark.parametrize(
    ("lines", "shown"),
    [
        (('band = "sd"',), "mean, ± one standard deviation, n = 3"),
        (('band = "range"', 'center = "median"'), "median, smallest to largest value, n = 3"),
        (('band = "iqr"',), "mean, quartiles, n = 3"),
        (('band = "ci"',), "mean, 95 % CI (Student's t), n = 3"),
    ],
)
def test_the_small_print_names_the_band(batch: Path, lines: tuple[str, ...], shown: str) -> None:
    assert said(draw(batch, *COVERAGE, 'kind = "summary"', *lines)) == shown


def test_a_band_that_does_not_belong_to_the_center_is_refused(batch: Path) -> None:
    for keys, complaint in (
        (('center = "median"', 'band = "sd"'), 'band "sd" is a distance from the center "mean" or "iqm", not from "median"'),
        (("quantiles = [0.1, 0.9]",), '"quantiles" needs band = "quantiles"'),
        (('band = "quantiles"', "quantiles = [0.9, 0.1]"), "[0.9, 0.1] should be the lower and the upper limit"),
        (('center = "q9"',), "center: statistic 'q9' is ambiguous; write q09"),
        (('center = "meen"',), "center: unknown statistic 'meen'; known are mean, median"),
    ):
        assert complaint in refusal(batch, *COVERAGE, *keys)


@pytest.mark.integration
def test_variables_are_chosen_for_the_x_axis_for_series_and_for_panels(batch: Path) -> None:
    by_noise = words(draw(batch, *COVERAGE, 'kind = "summary"', 'x = "noise"'))
    assert "noise" in by_noise
    assert "population size" in by_noise, "the legend's title"
    panels = words(draw(batch, *COVERAGE, 'kind = "box"', 'facet = "noise"'))
    assert {"noise = 0.1", "noise = 0.5", "population size"} <= set(panels)
    assert "did you mean 'noise'" in refusal(batch, *COVERAGE, 'kind = "box"', 'x = "nois"')
    assert "name each once" in refusal(batch, *COVERAGE, 'kind = "box"', 'x = "noise"', 'facet = "noise"')


@pytest.mark.integration
def test_where_chooses_rows_by_columns_and_variables(batch: Path) -> None:
    shown = words(draw(batch, *COVERAGE, 'kind = "box"', 'where = "population_size > 1 AND tick < 3"'))
    assert {"2", "4"} <= set(shown)
    assert "1" not in shown
    png = draw(batch, *COVERAGE, 'kind = "box"', 'where = "population_size > 1"')
    with Image.open(png) as image:
        assert "-- only rows where population_size > 1" in image.info["sierra:sql"]
    assert said(png).endswith("; only rows where population_size > 1")


@pytest.mark.nightly
def test_large_whole_numbers_have_all_digits(tmp_path: Path) -> None:
    root = projects.make(tmp_path / "project")
    assert projects.quick(root, "run", "population_size=1000001,1000002,2000000", "--runs", "2", "--no-figures").returncode == 0
    assert {"1000001", "1000002", "2e6"} <= set(words(draw(root, *COVERAGE, 'kind = "bar"')))
    ticks = set(words(draw(root, *COVERAGE, 'kind = "summary"')))
    assert {"1000001", "2e6"} <= ticks, "1000002 has no room beside 1000001"


@pytest.mark.integration
def test_a_condition_does_not_hide_experiments_whose_runs_all_failed(tmp_path: Path) -> None:
    simulator = projects.SIMULATOR + "sys.exit(count == 4)\n"
    root = projects.make(tmp_path / "project", simulator=simulator)
    assert projects.quick(root, "run", "population_size=1,2,4", "--runs", "3", "--no-figures").returncode == 1
    missing = said(draw(root, *COVERAGE, 'kind = "box"', 'where = "population_size > 1 AND tick >= 0"'))
    assert "; 3 of 6 runs missing or without such rows; only rows where" in missing
    assert "missing" not in said(draw(root, *COVERAGE, 'kind = "box"', 'where = "population_size < 4"'))


@pytest.mark.parametrize(
    ("where", "complaint"),
    [
        ("speed > 1", "where = 'speed > 1': "),
        ("tick > 100", "no row of output 'swarm' fulfils where = 'tick > 100'"),
        ("true; DROP TABLE x", "it is no SQL condition"),
        ("coverage IN (SELECT content FROM read_text('/etc/hostname'))", "where = "),
    ],
)
def test_a_condition_that_cannot_be_used_is_one_line(batch: Path, where: str, complaint: str) -> None:
    assert complaint in refusal(batch, *COVERAGE, 'kind = "box"', f'where = "{where}"')


@pytest.mark.nightly
def test_sizes_are_those_of_templates_of_papers(batch: Path) -> None:
    for size, inches in (('"acm-column"', 3.33), ('"ieee-page"', 7.16), ("[4.0, 3.0]", 4.0)):
        with Image.open(draw(batch, *COVERAGE, 'kind = "summary"', f"size = {size}")) as image:
            assert image.width == pytest.approx(inches * 300, abs=1)
    with Image.open(draw(batch, *COVERAGE, "size = [4.0, 3.0]", 'title = "T"')) as image:
        assert image.height == 900


@pytest.mark.integration
def test_palette_labels_limits_and_footnote_are_used(batch: Path) -> None:
    keys = ('palette = ["#112233", "#445566"]', "labels = { '0.1' = 'calm', '0.5' = 'windy' }", 'footnote = "after Smith"')
    png = draw(batch, *COVERAGE, 'kind = "summary"', *keys, "ylim = [0, 123]")
    assert {"calm", "windy", "after Smith", "100"} <= set(words(png))
    assert "#445566" in png.with_suffix(".svg").read_text()
    assert "palette: 'blu' is not a colour" in refusal(batch, *COVERAGE, 'palette = ["blu"]')
    assert "[2, 1] should be the lower and the upper limit" in refusal(batch, *COVERAGE, "ylim = [2, 1]")
    assert "two values of noise would have the same name" in refusal(batch, *COVERAGE, "labels = { '0.1' = 'a', '0.5' = 'a' }")


POSES = ('table = "poses"', 'column = ["x", "y"]')


@pytest.mark.nightly
def test_paths_of_robots_are_drawn_although_times_have_several_rows(batch: Path) -> None:
    where = 'where = "population_size = 4 AND noise = 0.1"'
    png = draw(batch, *POSES, 'kind = "trajectories"', 'robot = "robot"', "run = 1", where)
    assert said(png).startswith("paths, ○ start, □ end, run 1 of 3; noise = 0.1; only rows where")
    assert {"x", "y", "0", "1", "2", "3"} <= set(words(png)), "the legend has each robot"
    assert "no row is what the keys of the figure ask for" in refusal(batch, *POSES, 'kind = "trajectories"', "run = 7")
    assert "two columns, x and y" in refusal(batch, 'table = "poses"', 'column = "x"', 'kind = "trajectories"')
    assert "more than one row at the same time" in refusal(batch, 'table = "poses"', 'column = "x"', 'kind = "box"')
    reach = ('kind = "survival"', 'measure = "time_to"', "threshold = 1")
    assert "more than one row at the same time" in refusal(batch, 'table = "poses"', 'column = "x"', *reach)
    assert "has no column 'robots'; it has" in refusal(batch, *POSES, 'kind = "trajectories"', 'robot = "robots"')


@pytest.mark.integration
def test_rows_of_a_table_without_times_are_not_reduced_and_can_be_checked(batch: Path) -> None:
    statement = 'sql = "SELECT run, truth, score FROM guesses"'
    png = draw(batch, statement, 'column = ["truth", "score"]', 'kind = "roc"', 'positive = "b"')
    done = projects.quick(batch, "show", str(png))
    assert done.returncode == 0, done.stderr
    assert "follow" in done.stdout, done.stdout


@pytest.mark.integration
def test_a_density_counts_the_rows_beyond_its_limits(batch: Path) -> None:
    png = draw(batch, *POSES, 'kind = "density"', "bins = 10", "xlim = [0, 3]", "ylim = [-2, 2]", 'where = "noise = 0.1"')
    assert "; 0.4 wide cells; " in said(png)
    assert " rows beyond the limits left out" in said(png)


@pytest.mark.nightly
def test_default_figures_of_two_variables_are_maps_and_summaries_without_pandas_and_seaborn(batch: Path) -> None:
    (batch / "sierra.toml").write_text(projects.CONFIG)
    code = (
        "import sys, sierra; from pathlib import Path; "
        "project = sierra.open(Path(sys.argv[1])); "
        "print([len(project.deliverables.figures(sys.argv[2], 'swarm_energy_' + kind)) for kind in sys.argv[3:]]); "
        "print([name for name in ('pandas', 'seaborn', 'networkx') if name in sys.modules])"
    )
    words = [sys.executable, "-c", code, str(batch), batch_of(batch), "timeseries", "heatmap", "summary"]
    done = subprocess.run(words, capture_output=True, text=True, check=True)
    assert done.stdout == "[5, 5, 5]\n[]\n"


@pytest.mark.nightly
def test_columns_whose_names_differ_in_signs_only_have_a_figure_each(tmp_path: Path) -> None:
    writes = "open('t.csv', 'w').write('v(m),v[m]\\n1,2\\n')\n"
    project = sierra.open(projects.make(tmp_path / "p", simulator=writes))
    summary = project.run("population_size=1,2", figures=False)
    drawn = {path.stem: path.read_text() for path in project.deliverables.figures(summary.batch, formats=["svg"])}
    shown = {stem: [name for name in ("v(m)", "v[m]") if name in text] for stem, text in drawn.items()}
    assert shown == {"t_v_m__summary": ["v(m)"], "t_v_m__summary_2": ["v[m]"]}
