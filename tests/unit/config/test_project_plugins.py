"""Plug-ins in files of the project are code: always source, never mixed up, and imported only by commands that use them."""

from __future__ import annotations

import importlib
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

import sierra
from sierra.design import platforms
from sierra.errors import PluginError, SierraError
from sierra.packages.reading import received
from sierra.provenance import source
from tests import plugins, projects
from tests.tiers import at_night

PLATFORM = """
from sierra.plugin import Axis, NoOptions, Point, Set, values

FACTOR = 2

class RoboSim:
    contract = 1
    Options = NoOptions
    def __init__(self, project, options): self.words = project.command
    def changes(self, template): return ()
    def seed_changes(self): return ()
    def criterion(self, criterion, template):
        if criterion.name != "herd": return None
        axis = Axis("herd", values(criterion.scale), "Herd", "robots")
        return axis, tuple(Point(n, (Set("//swarm/@count", str(n * FACTOR), why="herd"),)) for n in axis.values)
    def criteria(self): return {"herd": "how many pairs of robots"}
    def check(self, document, template): pass
    def command(self): return self.words
    def files(self, document): return (("input.xml", document),)
    def environment(self): return {}
"""
IMPORTING = PLATFORM.replace("FACTOR = 2", "from .tools.factors import FACTOR")
TABLE = '[plugins]\nplatforms = ["robosim.py:RoboSim"]\n'
CONFIG = 'platform = "RoboSim"\n' + projects.CONFIG
RUN = ("run", "herd=1,2", "--runs", "1", "--no-figures")


def make(folder: Path, code: str = PLATFORM, more: str = "") -> Path:
    """Write a project with a platform of its own; return its folder."""
    projects.make(folder, CONFIG + more + TABLE)
    (folder / "robosim.py").write_text(code)
    return folder


def with_factors(folder: Path, more: str = "") -> Path:
    """Write a project whose platform imports another file; return its folder."""
    make(folder, IMPORTING, more)
    (folder / "tools").mkdir()
    (folder / "tools" / "factors.py").write_text("FACTOR = 2\n")
    return folder


def counts(folder: Path) -> list[str]:
    """Return the numbers of robots in the inputs of a query, as it is planned."""
    plan = sierra.open(folder).plan("herd=1,2", runs=1)
    texts = [dict(plan.files(run))["input.xml"].decode() for run in plan.batch.runs]
    return [text.split('count="')[1].split('"')[0] for text in texts]


def files_of(folder: Path) -> set[str]:
    planned = sierra.open(folder).plan("herd=1").source
    assert planned is not None
    return {os.fsdecode(path) for path in source.paths(planned.manifest)}


def refused(folder: Path, *words: str, code: int = 2) -> str:
    """Return the one line that a failing command prints."""
    done = projects.quick(folder, *words)
    assert done.returncode == code, done.stdout + done.stderr
    lines = [line for line in done.stderr.splitlines() if not line.startswith("note: ")]
    assert len(lines) == 1, done.stderr
    return lines[0].removeprefix("sierra: ")


def executed(folder: Path) -> str:
    """Run the query; return the line with its counts."""
    done = projects.quick(folder, *RUN)
    assert done.returncode == 0, done.stderr
    [line] = [line for line in done.stdout.splitlines() if line.startswith("2 runs: ")]
    return line


# Use


@pytest.mark.integration
def test_platform_of_the_project_executes_a_batch_and_writes_no_byte_code(tmp_path: Path) -> None:
    folder = with_factors(tmp_path / "p")
    assert executed(folder) == "2 runs: 2 executed, 0 reused"
    assert executed(folder) == "2 runs: 0 executed, 2 reused"
    rows = projects.sql(folder, "SELECT herd, max(coverage) AS most FROM swarm GROUP BY 1 ORDER BY 1")
    assert [(row["herd"], int(row["most"] / 8)) for row in rows] == [(1, 1), (2, 2)]
    assert projects.quick(folder, "fsck").returncode == 0
    assert not list(folder.rglob("*.pyc"))


def make_own(folder: Path) -> Path:
    """Write a project with a template format and a range of its own; return its folder."""
    projects.make(folder, projects.CONFIG.replace('template = "', 'template_format = "Arena"\ntemplate = "'))
    (folder / "own.py").write_text(
        "from sierra.plugin import Computed, NoOptions\n"
        "from sierra.templates.xml import XmlTemplate\n"
        "class Arena(XmlTemplate):\n    contract = 1\n"
        "class Squares:\n    contract = 1\n    Options = NoOptions\n    example = '3'\n"
        "    def __init__(self, options): pass\n"
        "    def scale(self, text): return Computed.of(*(n * n for n in range(1, int(text) + 1)))\n"
    )
    with (folder / "sierra.toml").open("a") as file:
        file.write('[plugins]\ntemplates = ["own.py:Arena"]\ncriteria = ["own.py:Squares"]\n')
    return folder


def test_platform_of_the_project_has_options(tmp_path: Path) -> None:
    code = PLATFORM.replace("Options = NoOptions", "Options = RoboOptions").replace("n * FACTOR", "n * self.options.factor")
    code = code.replace("self.words = project.command", "self.words, self.options = project.command, options")
    code = code.replace("class RoboSim", "class RoboOptions(Table):\n    factor: int = 1\n\nclass RoboSim")
    folder = make(tmp_path / "p", code.replace("import Axis", "import Table, Axis"), "[platforms.RoboSim]\nfactor = 7\n")
    assert counts(folder) == ["7", "14"]
    file = folder / "sierra.toml"
    file.write_text(file.read_text().replace("factor = 7", "factr = 7"))
    assert refused(folder, *RUN) == "[platforms.RoboSim]: unknown key 'factr'; did you mean 'factor'?"


def test_template_format_and_range_of_the_project_are_chosen_by_the_names_of_their_classes(tmp_path: Path) -> None:
    plan = sierra.open(make_own(tmp_path / "p")).plan("population_size.Squares3")
    assert [experiment.values["population_size"] for experiment in plan.batch.experiments] == [1, 4, 9]


@pytest.mark.integration
def test_batch_of_a_range_and_a_template_format_of_the_project_is_executed_and_found_by_its_name(tmp_path: Path) -> None:
    folder = make_own(tmp_path / "p")
    with (folder / "sierra.toml").open("a") as file:
        file.write(
            '[queries.main]\ncriteria = "population_size.Squares2"\nruns = 1\n'
            '[paper_tables.means]\nquery = "main"\ncolumn = "coverage"\nformats = ["csv"]\n'
        )
    done = projects.quick(folder, "run", "main")
    assert "2 runs: 2 executed, 0 reused" in done.stdout, done.stderr
    assert "means" in done.stdout
    assert projects.quick(folder, "show", "main").returncode == 0
    done = projects.quick(folder, "figures", "--check")
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.integration
def test_doctor_lists_plugins_of_the_project(tmp_path: Path) -> None:
    folder = make(tmp_path / "p")
    found = {check["name"]: check for check in json.loads(projects.quick(folder, "doctor", "--json").stdout)}
    assert (found["platform RoboSim"]["state"], found["platform RoboSim"]["found"]) == ("ok", "from robosim.py, options: none")
    (folder / "robosim.py").write_text("def f(:")
    found = {check["name"]: check for check in json.loads(projects.quick(folder, "doctor", "--json").stdout)}
    assert "robosim.py is not Python: SyntaxError" in found["plug-ins of the project"]["found"]


# The source


@pytest.mark.parametrize("git", [False, True])
def test_plugins_are_source_although_paths_leave_them_out(tmp_path: Path, git: bool) -> None:
    folder = with_factors(tmp_path / "p", '[source]\npaths = ["sim.py"]\n')
    if git:
        projects.commit(folder)
    assert files_of(folder) == {"sim.py", "robosim.py", "tools/factors.py"}


@pytest.mark.integration
@pytest.mark.parametrize("more", ["", '[source]\npaths = ["sim.py"]\n'])
def test_changed_plugin_or_imported_file_executes_runs_again(tmp_path: Path, more: str) -> None:
    folder = with_factors(tmp_path / "p", more)
    assert executed(folder) == "2 runs: 2 executed, 0 reused"
    for name in ("robosim.py", "tools/factors.py"):
        with (folder / name).open("a") as file:
            file.write("# a comment\n")
        assert executed(folder) == "2 runs: 2 executed, 0 reused", name
    (folder / "tools" / "notes.txt").write_text("no code")
    assert executed(folder) == "2 runs: 0 executed, 2 reused"


@pytest.mark.integration
def test_plugin_that_cannot_be_in_the_source_is_refused(tmp_path: Path) -> None:
    folder = make(tmp_path / "p")
    (folder / ".gitignore").write_text("robosim.py\n.sierra\n")
    projects.commit(folder)
    told = "[plugins]: robosim.py must be part of the source of runs, but git ignores it"
    assert refused(folder, *RUN).startswith(told)
    (folder / "sierra.toml").write_text(CONFIG + "[source]\ngit = false\n" + TABLE)
    assert "robosim.py" in files_of(folder)
    (folder / ".gitignore").write_text(".sierra\n")
    (folder / "docs").mkdir()
    (folder / "robosim.py").rename(folder / "docs" / "robosim.py")
    (folder / "sierra.toml").write_text(CONFIG + TABLE.replace("robosim.py", "docs/robosim.py"))
    assert refused(folder, *RUN).startswith("[plugins]: docs/robosim.py must be part of the source of runs, but ")
    (folder / "sierra.toml").write_text(CONFIG + '[source]\npaths = ["sim.py"]\n' + TABLE.replace("robo", "docs/robo"))
    assert "docs/robosim.py" in files_of(folder)


@pytest.mark.integration
def test_plugin_that_differs_from_the_executed_commit_is_refused(tmp_path: Path) -> None:
    folder = projects.commit(make(tmp_path / "p", more='[source]\ndirty = "ignore"\n'))
    assert counts(folder) == ["2", "4"]
    (folder / "arena.xml").write_text(projects.TEMPLATE.replace("0.1", "0.2"))
    assert counts(folder) == ["2", "4"]
    (folder / "robosim.py").write_text(PLATFORM.replace("FACTOR = 2", "FACTOR = 3"))
    assert refused(folder, *RUN) == (
        "[plugins]: robosim.py must be part of the source of runs, but the file on disk is not the commit's, which [source] "
        'dirty = "ignore" executes; commit it'
    )


def test_plugin_with_converted_line_endings_is_source(tmp_path: Path) -> None:
    folder = make(tmp_path / "p", PLATFORM.replace("\n", "\r\n"))
    (folder / "robosim.py").write_bytes(PLATFORM.replace("\n", "\r\n").encode())
    (folder / ".gitattributes").write_text("*.py text=auto\n")
    projects.commit(folder)
    assert counts(folder) == ["2", "4"]
    assert "robosim.py" in files_of(folder)


@pytest.mark.integration
def test_runs_elsewhere_and_in_a_checkout_have_the_same_plugins(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    installed = plugins.install(tmp_path / "package")
    monkeypatch.syspath_prepend(str(installed))
    monkeypatch.setenv("PYTHONPATH", str(installed))
    (tmp_path / "spool").mkdir()
    cluster = f'[runners.here]\nscheduler = "spool"\nspool = "{tmp_path}/spool"\narray_tasks = 2\n'
    folder = projects.commit(with_factors(tmp_path / "p", f'[source]\ndirty = "ignore"\n{cluster}'))
    done = projects.quick(folder, *RUN, "--on", "here")
    assert "2 runs: 2 executed, 0 reused" in done.stdout, done.stdout + done.stderr
    (folder / "arena.xml").write_text(projects.TEMPLATE.replace('size="10"', 'size="11"'))
    assert executed(folder) == "2 runs: 2 executed, 0 reused"
    (folder / "sim.py").write_text("raise SystemExit('not the commit')")
    assert executed(folder) == "2 runs: 0 executed, 2 reused"


# Modules


@pytest.mark.integration
def test_projects_and_their_states_never_share_modules(tmp_path: Path) -> None:
    first, second = with_factors(tmp_path / "first"), with_factors(tmp_path / "second")
    (second / "tools" / "factors.py").write_text("FACTOR = 5\n")
    assert [counts(first), counts(second), counts(first)] == [["2", "4"], ["5", "10"], ["2", "4"]]
    (first / "tools" / "factors.py").write_text("FACTOR = 7\n")
    assert [counts(first), counts(second)] == [["7", "14"], ["5", "10"]]
    assert not {"robosim", "tools", "factors"} & sys.modules.keys()
    with pytest.raises(SierraError, match="unknown platform 'RoboSim'"):
        platforms.find("RoboSim", sierra.open(first).config)


def test_plugin_imports_its_own_files_by_relative_imports_only(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = with_factors(tmp_path / "p")
    code = IMPORTING.replace("from .tools.factors", "from tools.factors")
    (folder / "robosim.py").write_text(code)
    told = (
        "robosim.py, line 4: imports 'tools.factors', which is tools of the project; only relative imports of its files are "
        "recorded with the plug-in: write it as in `from . import tools`"
    )
    monkeypatch.syspath_prepend(str(folder))
    assert refused(folder, *RUN) == told
    (folder / "factors.py").write_text("FACTOR = 3\n")
    monkeypatch.undo()
    (folder / "robosim.py").write_text(PLATFORM.replace("FACTOR = 2", "def late():\n    import factors"))
    assert "robosim.py, line 5: imports 'factors', which is factors.py of the project" in refused(folder, *RUN)
    (folder / "robosim.py").write_text(
        PLATFORM.replace("FACTOR = 2", f"import importlib, sys\nsys.path.insert(0, {str(folder)!r})\n"
        "FACTOR = importlib.import_module('factors').FACTOR\nsys.path.pop(0)")
    )  # fmt: skip
    for _ in range(2):
        assert refused(folder, *RUN).startswith(f"[plugins]: robosim.py has loaded {folder}/factors.py by other means than ")
    monkeypatch.syspath_prepend(str(folder))
    importlib.import_module("factors")
    monkeypatch.undo()
    dynamic = "import importlib\nfactors = importlib.import_module('factors')\nFACTOR = factors.FACTOR"
    (folder / "robosim.py").write_text(PLATFORM.replace("FACTOR = 2", dynamic))
    for _ in range(2):
        assert refused(folder, *RUN).startswith(f"[plugins]: robosim.py has loaded {folder}/factors.py by other means than ")
    del sys.modules["factors"]
    (folder / "robosim.py").write_text(IMPORTING.replace("from .tools.factors", "from ..other.factors"))
    assert refused(folder, *RUN) == "robosim.py, line 4: a relative import leads out of the project; import files in it"


@pytest.mark.integration
def test_project_without_plugins_imports_nothing_for_them(tmp_path: Path) -> None:
    folder = projects.make(tmp_path / "p")
    code = "import sierra, sys; sierra.open('.').plan('noise=1'); sys.exit('sierra.config.project_plugins' in sys.modules)"
    subprocess.run([sys.executable, "-c", code], cwd=folder, check=True, timeout=60)


# Records and packages


@pytest.fixture
def marked(tmp_path: Path) -> tuple[Path, Path]:
    """A project with a recorded batch, and a file that its plug-in writes when it is imported."""
    mark = tmp_path / "imported"
    folder = make(tmp_path / "p", f"open({str(mark)!r}, 'w').close()\n{PLATFORM}")
    assert executed(folder) == "2 runs: 2 executed, 0 reused"
    mark.unlink()
    return folder, mark


@pytest.mark.integration
def test_commands_that_only_read_import_no_plugin(marked: tuple[Path, Path]) -> None:
    folder, mark = marked
    batch = sierra.open(folder).batches[-1].batch
    (folder / "robosim.py").write_text((folder / "robosim.py").read_text() + "# changed\n")
    for words in (
        ("ls",),
        ("show", batch),
        ("sql", "FROM runs"),
        ("stats", "swarm", "coverage"),
        ("outputs", batch),
        ("files", batch),
    ):
        assert projects.quick(folder, *words).returncode == 0, words
    assert not mark.exists()
    (folder / "robosim.py").unlink()
    for words in (("ls",), ("show", batch), ("sql", "FROM runs"), ("stats", "swarm", "coverage"), ("fsck",)):
        assert projects.quick(folder, *words).returncode == 0, words


@pytest.mark.integration
def test_replay_uses_the_recorded_source_and_missing_runs_too(marked: tuple[Path, Path]) -> None:
    folder, mark = marked
    batch = sierra.open(folder).batches[-1].batch
    (folder / "robosim.py").write_text(PLATFORM.replace("FACTOR = 2", "FACTOR = 9"))
    assert "identical" in projects.quick(folder, "replay", batch, "--keep").stdout
    [kept] = (folder / ".sierra").rglob("robosim.py")
    assert "FACTOR = 2" in kept.read_text()
    (folder / "robosim.py").unlink()
    assert "identical" in projects.quick(folder, "replay", batch).stdout
    assert projects.quick(folder, "run", batch, "--no-figures").returncode == 0
    assert not mark.exists()


@pytest.mark.integration
def test_package_brings_the_plugin_and_nobody_imports_it(marked: tuple[Path, Path], tmp_path: Path) -> None:
    folder, mark = marked
    batch = sierra.open(folder).batches[-1].batch
    with (folder / "sierra.toml").open("a") as file:
        file.write('[package]\ntitle = "x"\nauthors = [{ name = "A B" }]\nlicense = "MIT"\n')
    packed = projects.quick(folder, "package", batch, "--yes", "-o", str(tmp_path / "x.zip"))
    assert packed.returncode == 0, packed.stderr
    for words in (("ls",), ("show", batch), ("sql", "FROM runs"), ("stats", "swarm", "coverage"), ("report", "--to", "r.html")):
        done = projects.quick(tmp_path, "open", "x.zip", *words)
        assert done.returncode == 0, (words, done.stderr)
    project = received.open_package(tmp_path / "x.zip").project
    told = r"^\[plugins\]: robosim.py:RoboSim is not imported: it is Python code of a package, and nothing of a package is "
    with project.plugins(), pytest.raises(PluginError, match=told):
        platforms.find("RoboSim", project.config)
    done = projects.quick(tmp_path, "reproduce", "x.zip", "--into", "new", "--yes")
    assert done.returncode == 0, done.stdout + done.stderr
    assert "plugins of the package is ignored: Python code of a package is never imported" in done.stdout + done.stderr
    assert not mark.exists()


# Mistakes


@pytest.mark.parametrize(
    ("code", "told"),
    [
        ("def f(:", "[plugins] platforms: robosim.py:RoboSim: robosim.py is not Python: SyntaxError: invalid syntax"),
        ("1 / 0", "[plugins]: robosim.py cannot be imported: ZeroDivisionError: division by zero; correct it"),
        ("raise SystemExit('no\\nlicence')", "[plugins]: robosim.py cannot be imported: SystemExit: no licence; correct it"),
        ("import nothing_of_this_name", "cannot be imported: ModuleNotFoundError: No module named 'nothing_of_this_name'"),
        ("from .nothing import x", "cannot be imported: ModuleNotFoundError: No module named 'nothing'; correct it"),
        ("", "[plugins]: robosim.py has no class RoboSim; correct robosim.py or sierra.toml"),
        ("def RoboSim(): pass", "declares no version of the contract, but this SIERRA has version 1; correct robosim.py"),
        ("\0", "[plugins] platforms: robosim.py:RoboSim: robosim.py is not Python: "),
        (PLATFORM.replace("def files", "def file"), "the platform 'RoboSim' of robosim.py lacks files; correct robosim.py"),
        (PLATFORM.replace("Options = NoOptions", "Options = dict"), "Options is not a subclass of Table; correct robosim.py"),
        (PLATFORM.replace("self.words = ", "self.words = 1 / 0 + "), "cannot be made: ZeroDivisionError: division by zero"),
    ],
)
def test_unusable_plugin_is_reported_in_one_line(tmp_path: Path, code: str, told: str) -> None:
    folder = make(tmp_path / "p", code)
    assert told in refused(folder, *RUN)


def test_fault_in_a_plugin_is_reported_with_its_file(tmp_path: Path) -> None:
    folder = make(tmp_path / "p", PLATFORM.replace("return self.words", "return self.wrods"))
    told = "a fault in the platform 'RoboSim' of robosim.py: AttributeError: 'RoboSim' object has no attribute 'wrods'"
    assert refused(folder, *RUN, code=1).startswith(told)


def test_files_that_are_no_regular_files_of_the_project_are_refused(tmp_path: Path) -> None:
    folder = make(tmp_path / "p")
    origin = "[plugins] platforms: robosim.py:RoboSim: "
    (folder / "robosim.py").rename(tmp_path / "elsewhere.py")
    assert refused(folder, *RUN) == f"{origin}{folder}/robosim.py does not exist"
    (folder / "robosim.py").symlink_to(tmp_path / "elsewhere.py")
    assert refused(folder, *RUN) == f"{origin}{folder}/robosim.py is a symbolic link; name a file of the project itself"
    (folder / "robosim.py").unlink()
    os.mkfifo(folder / "robosim.py")
    assert "this is a named pipe" in refused(folder, *RUN) or "cannot read" in refused(folder, *RUN)
    (folder / "robosim.py").unlink()
    (folder / "tools").symlink_to(tmp_path)
    (folder / "robosim.py").write_text("from .tools.elsewhere import RoboSim\n")
    assert refused(folder, *RUN).endswith("tools is a symbolic link; name a file of the project itself")


@pytest.mark.parametrize(
    ("table", "told"),
    [
        ('platforms = ["robosim:RoboSim"]', "'robosim:RoboSim' should be a Python file of the project and a class in it"),
        *at_night(
            [
                ('platforms = ["robosim.py"]', "should be a Python file of the project and a class in it, such as robosim.py:"),
                ('platforms = ["../robosim.py:RoboSim"]', "should be a Python file of the project"),
                ('platforms = ["/robosim.py:RoboSim"]', "should be a Python file of the project"),
                ('platforms = ["a-b/robosim.py:RoboSim"]', "should be a Python file of the project"),
                ('platforms = [":"]', "should be a Python file of the project"),
            ]
        ),
        ('platforms = ["a.py:RoboSim", "b.py:RoboSim"]', "two classes are called RoboSim; rename one"),
        ('videos = ["a.py:A"]', "unknown key 'plugins.videos'"),
        ('readers = ["robosim.py:Track"]', "[plugins]: robosim.py has no class Track; correct robosim.py or sierra.toml"),
        ('readers = ["robosim.py:csv"]', "SIERRA itself has a reader 'csv' already; give robosim.py:csv another name"),
        ('platform = ["a.py:A"]', "unknown key 'plugins.platform'; did you mean 'platforms'?"),
        (
            'platforms = ["robosim.py:argos"]',
            "SIERRA itself has a platform 'argos' already; give robosim.py:argos another name",
        ),
    ],
)
def test_mistakes_in_the_table_are_reported_in_one_line(tmp_path: Path, table: str, told: str) -> None:
    folder = make(tmp_path / "p")
    (folder / "sierra.toml").write_text(f"{CONFIG}[plugins]\n{table}\n")
    assert told in refused(folder, *RUN)


def test_name_of_an_installed_plugin_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = make(tmp_path / "p")
    lib = plugins.write(tmp_path / "lib", "sonar", {"sierra.platforms RoboSim": "RoboSim"}, PLATFORM)
    monkeypatch.syspath_prepend(str(lib))
    told = "[plugins] platforms: sonar 1 has a platform 'RoboSim' already; give robosim.py:RoboSim another name"
    assert refused(folder, *RUN) == told
