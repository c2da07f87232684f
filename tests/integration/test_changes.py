"""Five changes, each made in exactly the files that CONTRIBUTING names, to a copy of SIERRA: each works at once."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

from tests import plugins, projects

ROOT = Path(__file__).parents[2]
TORTOISE = plugins.SOURCE / "tortoise"
HOMES = {
    "from sierra.plugin import Bounds, ClusterTable, Missing, Request, State, Task": (
        "from sierra.config.cluster_table import ClusterTable\nfrom sierra.errors import Missing\n"
        "from sierra.runners.schedulers.base import Bounds, Request, State, Task"
    ),
    "from sierra.plugin import Change, ConfigError, Rendered, Renderer, Set, Table, TemplateError, Value, fill": (
        "from sierra.config.field_types import Table\nfrom sierra.errors import ConfigError, TemplateError\n"
        "from sierra.model import Change, Set, Value\nfrom sierra.templates.arithmetic import fill\n"
        "from sierra.templates.base import Rendered, Renderer"
    ),
}
"""Modules within SIERRA import from the modules that define a name, those of other packages from `sierra.plugin`."""
NEWEST = '''"""`sierra newest`: print the query of the newest batch."""

from __future__ import annotations

from sierra.cli.arguments import AsJson
from sierra.cli.output import print_json, readable


def newest(as_json: AsJson = False) -> None:
    """Print the query of the newest batch."""
    from sierra.cli.open_project import project

    batch = project().batches[-1]
    print_json(batch) if as_json else print(readable(batch.query))
'''

COUNTS = '''"""The kind `counts`: a bar for each experiment, as high as its number of runs."""

from __future__ import annotations

from typing import ClassVar

from sierra.config.plugin_registry import NoOptions
from sierra.deliverables.figures.base import DrawnBy, DrawnKind, Request
from sierra.stats.needs import Needs


class Counts(DrawnKind[NoOptions]):
    """The number of runs of each experiment."""

    uses: ClassVar[frozenset[str]] = frozenset({"measure"})

    def needs(self, request: Request) -> Needs:
        return Needs(("mean",), shows="number of runs")

    def drawn_by(self) -> DrawnBy:
        from sierra.extensions.figures.counts_drawing import counts

        return DrawnBy(counts)
'''
COUNTS_DRAWING = '''"""Figures of numbers of runs."""

from __future__ import annotations

from matplotlib.figure import Figure

from sierra.deliverables.figures.drawing import Drawing


def counts(drawing: Drawing) -> Figure:
    """Draw a bar for each experiment."""
    [table] = drawing.tables.values()
    figure = Figure()
    numbers = table.column("n").to_pylist()
    figure.add_subplot().bar(range(len(numbers)), numbers)
    return figure
'''


class Edit(NamedTuple):
    """A text of a file, and the text in its place."""

    old: str
    new: str


def copied(folder: Path) -> Path:
    """Return a copy of SIERRA's package whose files may be replaced."""
    return shutil.copytree(ROOT / "sierra", folder / "sierra", copy_function=os.link)


def change(folder: Path, kind: str, changes: Mapping[str, str | Edit]) -> None:
    """Make new files, with their text, and edit others; all of them are named by CONTRIBUTING's row for the kind of change."""
    copied(folder)
    named = named_for(kind)
    for path, text in changes.items():
        file = folder / path
        is_new = not file.exists() and any(f"{parent}/" in named for parent in Path(path).parents)
        assert path in named or is_new, (path, named)
        if isinstance(text, Edit):
            before = file.read_text()
            assert before.count(text.old) == 1, path
            text = before.replace(*text)
            file.unlink()  # the file of the original is the same one
        file.write_text(text)


def named_for(kind: str) -> set[str]:
    """Return the files and folders that CONTRIBUTING names for a kind of change, and the files with the names to register."""
    [row] = re.findall(rf"^\| {re.escape(kind)} \|.*$", (ROOT / "CONTRIBUTING.md").read_text(), re.MULTILINE)
    registries = {"sierra/config/plugin_registry.py"} if ", or `sierra." in row else set()
    return registries | set(re.findall(r"`(sierra/[a-z_0-9/.]+)`", row))


def of_plugin(name: str) -> str:
    """Return the text of a module of the package with plug-ins, as a module of SIERRA has it."""
    text = (TORTOISE / name).read_text()
    for line, homes in HOMES.items():
        text = text.replace(line, homes)
    assert "sierra.plugin" not in text
    return text


def sierra(copy: Path, root: Path, *words: str) -> str:
    """Execute a command of the copy; return what it printed."""
    variables = os.environ | {"PYTHONPATH": str(copy), "SIERRA_FIGURES": "no"}
    program = "import sierra.cli.main; sierra.cli.main.program()"
    done = subprocess.run(
        [sys.executable, "-c", program, *words], cwd=root, env=variables, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_a_scheduler(tmp_path: Path) -> None:
    copy, spool = tmp_path / "copy", tmp_path / "jobs"
    spool.mkdir()
    pbs, spool_class = '"sierra.runners.schedulers.pbs:Pbs"', '"sierra.runners.schedulers.spool:Spool"'
    change(
        copy,
        "a scheduler",
        {
            "sierra/runners/schedulers/spool.py": of_plugin("scheduler.py"),
            "sierra/config/plugin_registry.py": Edit(pbs, f'{pbs}, "spool": {spool_class}'),
        },
    )
    root = projects.make(tmp_path / "p", f'{projects.CONFIG}[runners.spool]\nspool = "{spool}"\narray_tasks = 1\n')
    summary = json.loads(sierra(copy, root, "run", "population_size=1,2", "--on", "spool", "--json"))
    assert (summary["executed"], summary["failed"]) == (4, 0)
    ran_by = json.loads(sierra(copy, root, "sql", "SELECT DISTINCT runner FROM sessions", "--json"))
    assert ran_by == [{"runner": "spool"}]


def test_a_figure_kind(tmp_path: Path) -> None:
    copy = tmp_path / "copy"
    registered = Edit('            "ridge": ', '            "counts": "counts:Counts",\n            "ridge": ')
    change(
        copy,
        "a figure kind",
        {
            "sierra/extensions/figures/counts.py": COUNTS,
            "sierra/extensions/figures/counts_drawing.py": COUNTS_DRAWING,
            "sierra/config/extensions.py": registered,
        },
    )
    config = f'{projects.CONFIG}[figures.numbers]\nkind = "counts"\ntable = "swarm"\ncolumn = "coverage"\nmeasure = "final"\n'
    root = projects.make(tmp_path / "p", config)
    sierra(copy, root, "run", "population_size=1,2")
    sierra(copy, root, "figures", "numbers")
    [drawn] = root.rglob("numbers.pdf")
    assert "state: follows from the store" in sierra(copy, root, "show", str(drawn))
    sierra(copy, root, "figures", "--check")


def test_a_template_format(tmp_path: Path) -> None:
    copy = tmp_path / "copy"
    change(
        copy,
        "a template format",
        {
            "sierra/templates/conf.py": of_plugin("template.py"),
            "sierra/config/plugin_registry.py": Edit(
                '        "ini": "sierra', '        "conf": "sierra.templates.conf:Conf",\n        "ini": "sierra'
            ),
        },
    )
    config = 'template = "herd.conf"\ncommand = "cp {input} herd.csv"\nseed = "seed"\nruns = 1\n[variables]\nspeed = "speed"\n'
    root = projects.make(tmp_path / "p", config)
    (root / "herd.conf").write_text("# herd\nseed = 0\nspeed = 1\n")
    sierra(copy, root, "inputs", "speed=3", "--to", "in")
    [written] = (root / "in").rglob("input.conf")
    assert re.fullmatch(r"# herd\nseed = \d+\nspeed = 3\n", written.read_text())


def test_a_column(tmp_path: Path) -> None:
    copy = tmp_path / "copy"
    root = projects.make(tmp_path / "p")
    sierra(ROOT, root, "run", "population_size=1")
    last = 'sampled in the same way; NULL if unknown", "bytes", LATER\n    ] = None\n'
    column = '    niceness: Annotated[int | None, "how far it gives way to other programs", "1", LATER] = None\n'
    behind = "\n\nclass AttemptRow"
    change(
        copy,
        "a table or a column",
        {
            "sierra/store/row_types.py": Edit(last + behind, last + column + behind),
            "sierra/ingest/recorder.py": Edit(
                "gpu_memory_bytes=result.gpu_memory_bytes,\n        )\n\n\ndef _keeps",
                "gpu_memory_bytes=result.gpu_memory_bytes,\n            niceness=7,\n        )\n\n\ndef _keeps",
            ),
        },
    )
    sierra(copy, root, "run", "population_size=1,2")
    rows = json.loads(sierra(copy, root, "sql", "SELECT niceness FROM executions ORDER BY lamport", "--json"))
    assert [row["niceness"] for row in rows] == [None, None, 7, 7]
    assert "how far it gives way to other programs" in sierra(copy, root, "schema", "executions")
    execution = json.loads(sierra(copy, root, "sql", "SELECT execution FROM executions WHERE niceness = 7 LIMIT 1", "--json"))
    assert json.loads(sierra(copy, root, "show", execution[0]["execution"], "--json"))["niceness"] == 7
    sierra(copy, root, "fsck")
    assert json.loads(sierra(ROOT, root, "sql", "SELECT count(*) AS n FROM executions", "--json")) == [{"n": 4}]


def test_a_command(tmp_path: Path) -> None:
    copy = tmp_path / "copy"
    registered = Edit('    "show": ', '    "newest": "sierra.cli.newest:newest",\n    "show": ')
    change(copy, "a command", {"sierra/cli/newest.py": NEWEST, "sierra/cli/app.py": registered})
    root = projects.make(tmp_path / "p")
    sierra(copy, root, "run", "population_size=1")
    assert sierra(copy, root, "newest") == "population_size=1\n"
    assert json.loads(sierra(copy, root, "newest", "--json"))["runs"] == 2
    assert re.search(r"^  newest +Print the query of the newest batch\.$", sierra(copy, root, "--help"), re.MULTILINE)
