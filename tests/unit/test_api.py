"""The Python interface: its names, its examples, and how notebooks show its values."""

from __future__ import annotations

import ast
import doctest
import re
import subprocess
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import duckdb
import pytest

import sierra
from sierra.api.noun import FORMER
from sierra.errors import UsageError
from sierra.execution import progress_display
from sierra.execution.observer import Progress
from tests import projects
from tests.support.characters import MIXED, SHOWN
from tests.support.pages import DOCS

WITHOUT_EXAMPLE = {
    *("images.pin", "images.pin_all", "images.build", "images.import_archive", "images.export"),  # need a container image
    *("images.contents", "images.known"),
    *("sources.push", "sources.fetch"),  # need a git remote
    *("root", "config", "store", "stored"),
}
NOUNS = sierra.Project.__annotations__
OPTIONS = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return projects.make(tmp_path_factory.mktemp("api") / "project")


@pytest.fixture(scope="module")
def project(root: Path) -> sierra.Project:
    return sierra.open(root)


@pytest.fixture(scope="module")
def summary(project: sierra.Project) -> sierra.Summary:
    return project.run("population_size=1,2", runs=2, figures=False)


def public() -> dict[str, Any]:
    """Return the public methods and properties of Project and, as `noun.method`, of its nouns."""
    kinds = {"": sierra.Project} | {f"{noun}.": getattr(sierra.Project, noun) for noun in NOUNS}
    members = {f"{prefix}{name}": member for prefix, kind in kinds.items() for name, member in vars(kind).items()}
    return {name: member for name, member in members.items() if name not in NOUNS and not re.match(r"(\w+\.)?_", name)}


@pytest.mark.parametrize("name", sierra.__all__)
def test_every_public_name_exists_and_is_documented(name: str) -> None:
    member = getattr(sierra, name)
    assert name == "__version__" or member.__doc__
    assert name in dir(sierra)


def test_unknown_name_in_the_package_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="no attribute 'Projct'"):
        _ = sierra.Projct  # type: ignore[attr-defined]


def test_importing_sierra_imports_no_third_party_library() -> None:
    program = "import sys; before = set(sys.modules); import sierra; print({n.partition('.')[0] for n in sys.modules} - before)"
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert not {"duckdb", "pyarrow", "pydantic", "lxml", "numpy", "git", "pandas"} & ast.literal_eval(ended.stdout)


def test_every_method_of_a_project_has_a_docstring_with_an_example() -> None:
    documented = {name for name, member in public().items() if member.__doc__ and ">>>" in member.__doc__}
    assert public().keys() - WITHOUT_EXAMPLE - documented == set()
    assert all(member.__doc__ for member in public().values())


def test_every_noun_is_documented() -> None:
    assert {noun for noun in NOUNS if not getattr(sierra.Project, noun).__doc__} == set()


@pytest.mark.parametrize("name", sorted(FORMER))
def test_former_name_of_a_method_works_and_warns_once(
    project: sierra.Project, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    noun, _, new = FORMER[name].partition(".")
    monkeypatch.setattr(getattr(sierra.Project, noun), new, lambda owner, *words, **options: (owner, words, options))
    with pytest.warns(DeprecationWarning, match=rf"^project\.{name} is now project\.{noun}\.{new};") as warned:
        called = getattr(project, name)("word", option=1)
    assert called == (getattr(project, noun), ("word",), {"option": 1})
    assert [Path(warning.filename) for warning in warned] == [Path(__file__)]


def test_project_lists_only_new_names(project: sierra.Project) -> None:
    assert not set(dir(project)) & (FORMER.keys() - NOUNS.keys())
    assert set(dir(project)) >= NOUNS.keys()


def test_documentation_lists_all_former_names() -> None:
    page = (DOCS / "how-to" / "python.md").read_text("utf-8")
    assert dict(re.findall(r"^\| `project\.(\w+)` \| `project\.([\w.]+)` \|$", page, re.MULTILINE)) == FORMER


def test_unknown_name_of_a_method_is_an_attribute_error(project: sierra.Project) -> None:
    with pytest.raises(AttributeError, match="'Project' object has no attribute 'rnu'"):
        _ = project.rnu  # type: ignore[attr-defined]


@pytest.mark.integration
def test_all_examples_in_docstrings_are_correct(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    root = projects.make(tmp_path / "project")
    monkeypatch.chdir(root)
    finder, runner = doctest.DocTestFinder(recurse=False), doctest.DocTestRunner(optionflags=OPTIONS)
    project = sierra.open()
    names: dict[str, Any] = {"sierra": sierra, "open": sierra.open, "project": project}
    for thing in (sierra, sierra.open, sierra.Project):
        _run(finder, runner, thing, names)
    names["summary"] = project.run("population_size=1,2", runs=2, figures=False)
    for member in public().values():
        _run(finder, runner, member, names)
    assert runner.summarize(verbose=False).failed == 0
    assert runner.tries > 30


def _run(finder: doctest.DocTestFinder, runner: doctest.DocTestRunner, thing: Any, names: dict[str, Any]) -> None:
    name = getattr(thing, "__name__", "thing")
    target = getattr(thing, "fget", getattr(thing, "func", thing))
    for test in finder.find(target, name, module=False, globs=dict(names)):  # type: ignore[arg-type]
        runner.run(test)


@pytest.mark.integration
def test_frame_accepts_a_table_name_or_a_statement(project: sierra.Project, summary: sierra.Summary) -> None:
    frame = project.frame("swarm", within=summary.batch)
    assert frame.shape[0] == 20
    assert {"tick", "coverage", "population_size"} <= set(frame.columns)
    assert project.frame("SELECT $x AS x", x=3)["x"].tolist() == [3]
    assert project.frame("SELECT $batch AS x", batch="a")["x"].tolist() == ["a"]
    with pytest.raises(UsageError, match="to query one batch, write within='4fc1'"):
        project.frame("swarm", batch="4fc1")
    with pytest.raises(sierra.SqlError, match="swrm"):
        project.frame("swrm")


@pytest.mark.nightly
def test_missing_pandas_is_reported_with_the_extra_to_install(root: Path, summary: sierra.Summary) -> None:
    program = (
        "import sys\n"
        "class No:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        "        if name == 'pandas': raise ModuleNotFoundError(name)\n"
        "sys.meta_path.insert(0, No())\n"
        "import importlib.util, sierra\n"
        "real = importlib.util.find_spec\n"
        "importlib.util.find_spec = lambda name, *more: None if name == 'pandas' else real(name, *more)\n"
        "try: sierra.open().frame('swarm')\n"
        "except sierra.Missing as error: print(error)\n"
    )
    ended = subprocess.run([sys.executable, "-c", program], cwd=root, capture_output=True, text=True, check=True)
    assert ended.stdout == "pandas is not installed; pip install 'sierra-experiments[figures]'\n"


def test_results_are_usable_as_arrow_tables_by_other_libraries(project: sierra.Project, summary: sierra.Summary) -> None:
    result = project.sql("SELECT run, tick FROM swarm WHERE tick < 2", within=summary.batch)
    assert (len(result), result.num_rows, result.column_names) == (8, 8, ["run", "tick"])
    assert result["tick"].to_pylist() == result.column("tick").to_pylist()
    assert duckdb.sql("SELECT sum(tick) FROM result").fetchall() == [(4,)]
    assert result == project.sql("SELECT run, tick FROM swarm WHERE tick < 2", within=summary.batch)


HOSTILE = "<script>alert('x')</script>"


@pytest.mark.integration
def test_notebook_html_is_escaped_and_shortened(project: sierra.Project, summary: sierra.Summary) -> None:
    shown = project.sql('SELECT $x AS "<b>", range AS n FROM range(1000)', x=f"{HOSTILE}{MIXED}")._repr_html_()
    assert "<script" not in shown
    assert "<b>" not in shown
    assert f"&lt;/script&gt;{SHOWN}" in shown
    assert "1000 rows, 20 of them shown" in shown
    assert shown.count("<tr>") == 21
    assert "population_size=1,2" in project._repr_html_()
    assert "4 runs: 4 executed" in summary._repr_html_()
    assert "<td>2</td>" in project.plan("population_size=1,2", runs=2)._repr_html_()
    assert "identical" in project.replay(summary.batch, runs=1)._repr_html_()


def test_project_without_a_store_has_escaped_notebook_html(tmp_path: Path) -> None:
    assert "SIERRA project" in sierra.open(projects.make(tmp_path / "<i>"))._repr_html_()
    assert "<i>" not in sierra.open(tmp_path / "<i>")._repr_html_()


class Handle:
    """The display handle of a notebook, through which a shown text is updated."""

    def __init__(self, shown: list[str]) -> None:
        self._shown = shown

    def update(self, told: dict[str, str], *, raw: bool) -> None:
        assert raw
        self._shown.append(told["text/plain"])


@pytest.fixture
def notebook(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Install fake modules of a notebook's kernel; return the list of texts that it shows."""
    shown: list[str] = []

    def display(told: dict[str, str], *, raw: bool, display_id: bool) -> Handle:
        assert raw
        assert display_id
        shown.append(told["text/plain"])
        return Handle(shown)

    for name, content in (
        ("IPython", {"get_ipython": lambda: SimpleNamespace(kernel=object())}),
        ("IPython.display", {"display": display}),
        ("ipykernel", {}),
    ):
        module = ModuleType(name)
        vars(module).update(content)
        monkeypatch.setitem(sys.modules, name, module)
    return shown


@pytest.mark.nightly
def test_notebook_shows_progress_unless_it_is_disabled(
    tmp_path: Path, notebook: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    project = sierra.open(projects.make(tmp_path))
    project.run("population_size=1", figures=False)
    assert notebook[-1].startswith("2/2 runs")
    count = len(notebook)
    project.run("population_size=2", figures=False, progress=False)
    assert len(notebook) == count
    assert capsys.readouterr() == ("", "")


@pytest.mark.nightly
def test_script_shows_progress_only_if_it_is_enabled(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    project = sierra.open(projects.make(tmp_path))
    project.run("population_size=1", figures=False)
    assert capsys.readouterr() == ("", "")
    project.run("population_size=2", figures=False, progress=True)
    out, err = capsys.readouterr()
    assert out == ""
    assert err.splitlines()[-1].startswith("2/2 runs")


def test_progress_is_printed_in_a_notebook_without_display(
    notebook: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.delitem(sys.modules, "IPython.display")
    progress_display.observer().progress(Progress(total=2, reused=0, done=2, failed=0, running=0))
    assert capsys.readouterr().err.startswith("2/2 runs")
    assert notebook == []
