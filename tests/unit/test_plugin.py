"""A package with one plug-in of each kind is installed and used; unusable plug-ins are reported in one line."""

from __future__ import annotations

import json
import os
import tomllib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jsonschema
import pytest

import sierra
from sierra import plugin
from sierra.config.plugin_registry import READERS
from sierra.containers import engines
from sierra.design.query import grammar
from sierra.ingest.model import PLAIN, Form
from sierra.runners import schedulers
from sierra.templates.xml import XmlTemplate
from sierra.testing import comparisons, criteria, links, platforms, readers, runners, statistics, templates
from sierra.testing import engines as engine_conformance
from tests import images, plugins, projects, stores
from tests.support import lsf
from tests.tiers import at_night

SHIPPED = ", ".join(READERS.shipped)
PLATFORM = """
from sierra.plugin import NoOptions
class Made:
    contract = 1
    Options = NoOptions
    def __init__(self, project, options): self.words = project.command
    def changes(self, template): return ()
    def seed_changes(self): return ()
    def criterion(self, criterion, template): return None
    def criteria(self): return {}
    def check(self, document, template): pass
    def command(self): return self.words
    def files(self, document): return (("input.xml", document),)
    def environment(self): return {}
"""
"""The module of a platform, which tests break in one place."""
FLAGS = """
import hashlib, json
from sierra.plugin import ARGUMENTS, NoOptions, TemplateError, fill
class Made:
    contract = 1
    Options = NoOptions
    def __init__(self, data, name, options):
        self.sha256, self.name = hashlib.sha256(data).hexdigest(), name
        self.given = dict(line.split(" ", 1) for line in data.decode().splitlines())
    def reread(self, rendered, name):
        words = json.loads(dict(rendered)[ARGUMENTS])
        lines = (f"{name} {value}\\n" for name, value in zip(words[::2], words[1::2]))
        return Made("".join(lines).encode(), name, None)
    def find(self, path):
        return (self.given[path],) if path in self.given else ()
    def attributes(self):
        return tuple(self.given.items())
    def changed(self, changes, values):
        made = Made(b"", self.name, None)
        made.given = dict(self.given)
        for change in changes:
            if change.path not in made.given:
                raise TemplateError(f"{self.name}: {change.why}: there is no {change.path}")
            made.given[change.path] = fill(change.value, values)
        return made
    def render(self):
        words = [word for pair in self.given.items() for word in pair]
        return ((ARGUMENTS, json.dumps(words).encode()), ("notes.txt", " ".join(words).encode()))
    def per_run(self, changes):
        return lambda values: self.changed(changes, values).render()
"""
"""A template format that renders arguments and a second file."""


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The package in tests/plugin, on the path of this process and of its child processes."""
    place = plugins.install(tmp_path_factory.mktemp("plugin"))
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(place))
        patch.setenv("PYTHONPATH", str(place))
        yield place


@pytest.fixture
def project(installed: Path, tmp_path: Path) -> Path:
    return plugins.project(tmp_path / "project")


@pytest.fixture
def plain(tmp_path: Path) -> Path:
    """A project that uses shipped plug-ins only, with a batch."""
    folder = projects.make(tmp_path / "plain")
    stores.ask(folder, "population_size=1", runs=1)
    return folder


def succeed(folder: Path, *words: str) -> str:
    done = projects.quick(folder, *words)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def refused(folder: Path, *words: str, code: int = 2) -> str:
    """Return the one line that a failing command prints."""
    done = projects.quick(folder, *words)
    assert done.returncode == code, done.stdout + done.stderr
    lines = [line for line in done.stderr.splitlines() if not line.startswith("note: ")]
    assert len(lines) == 1, done.stderr
    return lines[0]


def rows(folder: Path, query: str) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = sierra.open(folder).sql(query).to_pylist()
    return found


def change(folder: Path, old: str, new: str) -> None:
    file = folder / "sierra.toml"
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new))


def append(folder: Path, text: str) -> None:
    with (folder / "sierra.toml").open("a") as file:
        file.write(text)


def nice_simulator(folder: Path) -> None:
    """Let the simulator write its niceness."""
    (folder / "tortoise.py").write_text(
        "import os\nopen('walk.track', 'w').write(f'track 1\\ntick niceness\\n0 {os.nice(0)}\\nend\\n')\n"
    )
    change(folder, "scale = 100.0", "scale = 1.0")


def nicer(more: int) -> int:
    """Return this process's niceness and some more, up to the largest one that there is."""
    return min(os.nice(0) + more, 19)


# Use of each kind of plug-in


@pytest.mark.integration
def test_platform_template_format_and_reader_of_another_package_execute_a_batch(project: Path) -> None:
    run = ("run", "herd=1,3", "--no-figures")
    statement = "SELECT herd, count(*) AS n, max(tick) AS last, max(distance) AS far FROM walk GROUP BY 1 ORDER BY 1"
    assert "4 runs: 4 executed" in succeed(project, *run)
    found = rows(project, statement)
    assert [(row["herd"], row["n"], row["last"]) for row in found] == [(1, 10, 4), (3, 10, 4)]
    assert 25 < found[0]["far"] < 125, "five steps of at most 25 cm"
    assert "4 runs: 0 executed, 4 reused" in succeed(project, *run)
    change(project, "scale = 100.0", "scale = 1.0")
    assert "4 runs: 0 executed, 4 reused" in succeed(project, *run), "an option of a reader changes only tables"
    assert [row["far"] for row in rows(project, statement)] == pytest.approx([row["far"] / 100 for row in found])
    assert projects.quick(project, "fsck").returncode == 0
    change(project, "steps = 5", "steps = 6")
    assert "4 runs: 4 executed" in succeed(project, *run), "an option of a platform changes inputs"


READER = """
from sierra.plugin import NoOptions
class Made:
    contract = 1
    Options = NoOptions
    def __init__(self, options): pass
    def read(self, path): return {"length": [len(path.read_bytes())], "version": [VERSION]}
"""


@pytest.mark.nightly
def test_new_version_of_a_reader_reads_recorded_files_again(plain: Path, tmp_path: Path) -> None:
    with (plain / "sim.py").open("a") as file:
        file.write("open('notes.text', 'w').write('four')\n")
    append(plain, '[outputs.notes]\nfile = "notes.text"\n')
    told = []
    for version in ("1", "2", "1"):
        lib = tmp_path / version
        if not lib.exists():
            plugins.write(lib, "texts", {"sierra.readers text": "Made"}, f"VERSION = {version}\n{READER}", version)
        run = ("run", "population_size=1", "--runs", "2", "--no-figures")
        done = projects.sierra(plain, *run, environment={"PYTHONPATH": str(lib)})
        [counts] = [line for line in done.stdout.splitlines() if line.startswith("2 runs: ")]
        told.append((done.returncode, counts.partition(" (")[0]))
        assert {(row["length"], row["version"]) for row in rows(plain, "SELECT * FROM notes")} == {(4, int(version))}
    assert told == [(0, "2 runs: 2 executed, 0 reused"), *[(0, "2 runs: 0 executed, 2 reused")] * 2]
    assert "unknown reader 'text'" in refused(plain, "replay", sierra.open(plain).batches[-1].batch)


@pytest.mark.integration
def test_damaged_file_of_a_plugin_format_fails_only_its_own_run(project: Path) -> None:
    script = project / "tortoise.py"
    script.write_text(
        script.read_text().replace('print("end", file=track)', 'int(given["tortoises"]) > 1 or print("end", file=track)')
    )
    done = projects.quick(project, "run", "herd=1,2", "--no-figures")
    assert done.returncode == 1
    assert "walk.track: line 8: is cut short; the last line is not 'end'" in done.stdout + done.stderr
    assert [row["herd"] for row in rows(project, "SELECT DISTINCT herd FROM walk")] == [1]


@pytest.mark.integration
def test_runner_of_another_package_is_configured_by_its_table(project: Path) -> None:
    nice_simulator(project)
    succeed(project, "run", "herd=1", "--no-figures", "--on", "niced")
    assert {row["niceness"] for row in rows(project, "SELECT niceness FROM walk")} == {nicer(5)}


@pytest.fixture
def spool(project: Path, tmp_path: Path) -> Path:
    """A project with a cluster of the scheduler `spool`."""
    (tmp_path / "spool").mkdir()
    append(project, f'[runners.here]\nscheduler = "spool"\nspool = "{tmp_path}/spool"\narray_tasks = 2\nniceness = 3\n')
    return project


@pytest.mark.integration
def test_scheduler_of_another_package_executes_a_batch(spool: Path) -> None:
    nice_simulator(spool)
    assert "4 runs: 4 executed" in succeed(spool, "run", "herd=1,2", "--no-figures", "--on", "here")
    assert {row["niceness"] for row in rows(spool, "SELECT niceness FROM walk")} == {nicer(3)}


@pytest.mark.integration
def test_a_plugin_for_lsf_tells_what_a_node_gives(project: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", f"{lsf.install(tmp_path / 'lsf')}{os.pathsep}{os.environ['PATH']}")
    append(project, '[runners.farm]\nscheduler = "lsf"\narray_tasks = 2\ncpus = 2\n')
    succeed(project, "run", "herd=1,2", "--no-figures", "--on", "farm")
    given = rows(project, "SELECT job, cpus, memory, gpus FROM attempts ORDER BY job")
    assert [row["job"] for row in given] == ["101[1]", "101[2]"], "the job before them has checked the nodes"
    assert {(row["cpus"], row["memory"], row["gpus"]) for row in given} == {(2, 512 << 20, "3")}


@pytest.mark.nightly
def test_detached_jobs_of_a_plugin_scheduler_can_be_attached(spool: Path) -> None:
    succeed(spool, "run", "herd=1", "--no-figures", "--on", "here", "--detach")
    [standing] = json.loads(succeed(spool, "status", "--json"))
    assert standing["runs"] == 2
    succeed(spool, "attach", standing["batch"])
    assert len(rows(spool, "SELECT DISTINCT run FROM walk")) == 2


@pytest.mark.nightly
def test_jobs_of_a_plugin_scheduler_can_be_cancelled(spool: Path) -> None:
    (spool / "tortoise.py").write_text("import time\ntime.sleep(600)\n")
    succeed(spool, "run", "herd=1", "--no-figures", "--on", "here", "--detach")
    [standing] = json.loads(succeed(spool, "status", "--json"))
    succeed(spool, "cancel", standing["batch"])
    assert json.loads(succeed(spool, "status", "--json")) == []


@pytest.mark.nightly
def test_plugin_scheduler_refuses_forbidden_directives_and_unknown_keys(spool: Path) -> None:
    succeed(spool, "run", "herd=2", "--no-figures")
    run = ("run", "herd=1", "--no-figures", "--on", "here")
    append(spool, 'directives = ["--note=a paper"]\n')
    assert "#SPOOL --note=a paper" in succeed(spool, *run, "--dry-run")
    change(spool, "--note=a paper", "--array=9")
    told = "sierra: [runners.here]: directive '--array=9' of 'here' cannot be added: use array_tasks = N"
    assert refused(spool, *run) == told
    change(spool, "niceness = 3", "nicenes = 3")
    assert refused(spool, *run) == "sierra: [runners.here]: unknown key 'nicenes'; did you mean 'niceness'?"
    succeed(spool, "ls")


@pytest.mark.integration
def test_engine_of_another_package_starts_runs(project: Path) -> None:
    nice_simulator(project)
    layer = images.layer(("bin/python3", b"#!/bin/sh\n"))
    images.docker_archive(project / "image.tar", [layer])
    append(project, '[container]\nimage = "image.tar"\nengine = "direct"\n[engines.direct]\nniceness = 4\n')
    succeed(project, "image", "pin")
    done = projects.quick(project, "run", "herd=1", "--no-figures")
    assert done.returncode == 0, done.stderr
    assert "NOT ISOLATED: containers of direct have network access here (direct 1)" in done.stdout + done.stderr
    assert {row["niceness"] for row in rows(project, "SELECT niceness FROM walk")} == {nicer(4)}
    assert [row["engine"] for row in rows(project, "SELECT engine FROM sessions")] == ["direct"]


# Plug-ins in doctor and schema


@pytest.mark.nightly
def test_doctor_lists_plugins_and_their_options(project: Path) -> None:
    found = {check["name"]: check for check in json.loads(projects.quick(project, "doctor", "--json").stdout)}
    for name, option in (
        ("platform tortoise", "steps"),
        ("template conf", "comment"),
        ("reader track", "scale"),
        ("comparison welch", "fewest"),
        ("criterion Primes", "above"),
        ("runner niced", "niceness"),
        ("link burrow", "burrows"),
        ("scheduler spool", "niceness"),
        ("engine direct", "niceness"),
    ):
        assert found[name]["state"] == "ok"
        assert found[name]["found"].startswith("from sierra-tortoise 1.0, options: ")
        assert option in found[name]["found"]
    assert found["options"]["state"] == "ok"
    change(project, "niceness = 5", "niceness = 50")
    broken = {check["name"]: check for check in json.loads(projects.quick(project, "doctor", "--json").stdout)}
    assert broken["options"]["found"].startswith("[runners.niced]: niceness should be less than or equal to 19")


def test_schema_contains_the_options_of_each_plugin(project: Path) -> None:
    schema = json.loads(succeed(project, "schema", "sierra.toml", "--json"))
    settings = tomllib.loads((project / "sierra.toml").read_text())
    jsonschema.Draft202012Validator(schema).validate(settings)
    for place, key in (
        ("platforms.tortoise", "steps"),
        ("readers.track", "scale"),
        ("runners.niced", "niceness"),
        ("comparison_methods.welch", "fewest"),
        ("criteria.Primes", "above"),
    ):
        kind, name = place.split(".")
        wrong = {**settings, kind: {name: {f"{key}_": 1}}}
        assert list(jsonschema.Draft202012Validator(schema).iter_errors(wrong)), place
    text = succeed(project, "schema", "sierra.toml")
    tables = (
        "platforms.tortoise",
        "template_formats.conf",
        "readers.track",
        "runners.niced",
        "runners.spool",
        "engines.direct",
    )
    assert all(f"[{table}]: " in text for table in tables)


def test_published_schema_contains_only_shipped_plugins(project: Path) -> None:
    succeed(project, "schema", "--write", "written")
    assert "tortoise" not in (project / "written" / "sierra.toml.schema.json").read_text()


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ("steps = 5", "step = 5", "[platforms.tortoise]: unknown key 'step'; did you mean 'steps'?"),
        ("scale = 100.0", "scal = 1.0", "[readers.track]: unknown key 'scal'; did you mean 'scale'?"),
        ("scale = 100.0", "scale = -1", "[readers.track]: scale should be greater than 0, not -1"),
        ("[readers.track]", "[readers.trak]", f"[readers.trak]: unknown reader 'trak'; known are {SHIPPED}, track"),
        ("[readers.track]", "[template_formats.conf]", "[template_formats.conf]: unknown key 'scale'; known are comment"),
        ("[readers.track]", "[engines.direct]", "[engines.direct]: unknown key 'scale'; known are niceness"),
        (
            'time = "tick"',
            'time = "tick"\nformat = "trac"',
            f"[outputs.walk] format: unknown format 'trac'; known are {SHIPPED}, track, file",
        ),
    ],
)
def test_invalid_plugin_options_are_reported_in_one_line(project: Path, old: str, new: str, told: str) -> None:
    change(project, old, new)
    assert refused(project, "run", "herd=1", "--no-figures") == f"sierra: {told}"


# Conformance of each kind


def test_plugin_platform_conforms(project: Path) -> None:
    loaded = sierra.open(project).config
    template = plugin.KINDS[1].make("conf", {}, (project / "herd.conf").read_bytes(), "herd.conf")
    from tortoise.platform import Tortoise  # type: ignore[import-not-found]

    platforms.check(Tortoise, loaded, template, {"herd": grammar.parse("herd.Log4")})


def test_plugin_template_format_conforms(installed: Path) -> None:
    from tortoise.template import Conf, ConfOptions  # type: ignore[import-not-found]

    data = (plugins.SOURCE / "project" / "herd.conf").read_bytes()
    templates.check(lambda data, name: Conf(data, name, ConfOptions()), data, ["speed", "tortoises", "seed"])


@pytest.mark.integration
def test_plugin_statistic_conforms(installed: Path) -> None:
    statistics.check("laggards", {(1.0, 3.0, 9.0, 11.0): 2.0, (4.0,): 4.0}, {"resamples": 999})
    statistics.check("laggards", {(1.0, 3.0, 9.0, 11.0): 6.0}, {"part": 1.0, "resamples": 999})


@pytest.mark.integration
def test_plugin_range_conforms(installed: Path) -> None:
    criteria.check("Primes", {"5": (2, 3, 5, 7, 11), "1": (2,)}, ["", "0", "-1", "x", "5.C2", "1000"])
    criteria.check("Primes", {"2": (11, 13)}, options={"above": 10})


@pytest.mark.integration
@pytest.mark.each_case
@pytest.mark.parametrize("claim", links.COMMAND_CLAIMS, ids=lambda claim: claim.__name__)
def test_plugin_link_conforms(installed: Path, tmp_path: Path, claim: Callable[[links.Trial], None]) -> None:
    from tortoise.link import Burrow, BurrowOptions  # type: ignore[import-not-found]

    @dataclass
    class Home:
        name: str = "home"

    (tmp_path / "home").mkdir()
    (tmp_path / "local").mkdir()
    options = BurrowOptions(burrows=str(tmp_path))
    links.call(claim, links.Trial(lambda host: Burrow(host, options), Home(), tmp_path / "local"))  # type: ignore[arg-type]


def test_plugin_comparison_method_conforms(installed: Path) -> None:
    comparisons.check("welch")


RANGES = """
from sierra.plugin import Computed, NoOptions, Point, Set
class Arenas:
    contract, Options, example = 1, NoOptions, "2"
    def __init__(self, options): pass
    def scale(self, text):
        change = Set("//arena/@size", "{side}")
        return Computed(tuple(Point(f"arena{k}", (change,), parameters={"side": 10 * k}) for k in range(1, int(text) + 1)))
"""


@pytest.mark.nightly
def test_recorded_values_of_a_range_need_no_plugin(tmp_path: Path) -> None:
    """The values have changes of their own, so that the variable is declared nowhere."""
    lib = plugins.write(tmp_path / "lib", "arenas", {"sierra.criteria Arenas": "Arenas"}, RANGES)
    root = projects.make(tmp_path / "project")
    words = ("run", "place.Arenas2", "noise=0.1,0.5", "--runs", "1", "--no-figures")
    done = projects.sierra(root, *words, environment={"PYTHONPATH": str(lib)})
    assert done.returncode == 0, done.stderr
    batch = sierra.open(root).batches[-1].batch
    values = rows(root, "SELECT DISTINCT place, noise FROM swarm ORDER BY ALL")
    assert [tuple(row.values()) for row in values] == [("arena1", 0.1), ("arena1", 0.5), ("arena2", 0.1), ("arena2", 0.5)]
    assert [row["query"] for row in rows(root, "SELECT query FROM batches")] == ["place.Arenas2 noise=0.1,0.5"]
    assert "4 runs: 0 executed, 4 reused" in succeed(root, "run", batch[:10], "--no-figures")
    assert "identical (4 runs: 4 identical)" in succeed(root, "replay", batch[:10])
    assert "unknown range 'Arenas2'" in refused(root, "run", "place.Arenas2", "--no-figures")


@pytest.mark.integration
@pytest.mark.parametrize(
    ("name", "expected"),
    [("mean", 6.0), ("median", 6.0), ("iqm", 6.0), ("sd", 4.760952285695233), ("iqr", 7.0), ("mad", 4.0), ("range", 10.0)],
)
def test_shipped_statistics_conform(name: str, expected: float) -> None:
    statistics.check(name, {(1.0, 3.0, 9.0, 11.0): expected})


@pytest.mark.integration
def test_a_statistic_of_a_plugin_is_computed_with_its_options(project: Path) -> None:
    assert projects.quick(project, "run", "herd=1", "--no-figures").returncode == 0
    asked = projects.quick(project, "stats", "walk", "distance", "--statistic", "laggards,median", "--json")
    (row,) = json.loads(asked.stdout)
    both = sorted(one["last"] for one in rows(project, "SELECT run, max_by(distance, tick) AS last FROM walk GROUP BY run"))
    assert (row["laggards"], row["laggards_low"], row["laggards_interval"]) == (both[0], None, None)
    assert row["median"] == pytest.approx(sum(both) / 2)
    assert "n is too small for the 95 % interval of laggards in 1 row" in asked.stderr
    change(project, "[runners.niced]", "[statistics.laggards]\npart = 1.0\n\n[runners.niced]")
    (row,) = json.loads(projects.quick(project, "stats", "walk", "distance", "-s", "laggards", "--json").stdout)
    assert row["laggards"] == pytest.approx(sum(both) / 2)
    change(project, "part = 1.0", "part = 2.0")
    told = "[statistics.laggards]: part should be less than or equal to 1, not 2.0"
    assert refused(project, "stats", "walk", "distance", "-s", "laggards") == f"sierra: {told}"


BROKEN = """
from sierra.plugin import Estimate, Function, NoOptions
class Made:
    contract = 1
    Options = NoOptions
    interval = "none"
    def __init__(self, options): pass
    def definition(self): return Function(lambda values: ESTIMATE)
"""


@pytest.mark.integration
@pytest.mark.parametrize("estimate", ["Estimate(1.0, 2.0, 3.0)", "Estimate(1.0, 0.5)", "Estimate(float('nan'))", "1 / 0"])
def test_a_statistic_with_a_wrong_interval_is_a_fault_of_its_package(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, estimate: str
) -> None:
    code = BROKEN.replace("ESTIMATE", estimate)
    monkeypatch.syspath_prepend(plugins.write(tmp_path / "lib", "broken", {"sierra.statistics wrong": "Made"}, code))
    project = projects.make(tmp_path / "project")
    stores.ask(project, "noise=1")
    asked = projects.quick(project, "stats", "swarm", "coverage", "-s", "wrong")
    assert (asked.returncode == 0, asked.stdout, asked.stderr.count("\n")) == (False, "", 1)
    assert "wrong" in asked.stderr


def test_xml_template_format_conforms() -> None:
    data = b"<?xml version='1.0'?>\n<a b='1'><!-- c --><c>2</c><d>x</d></a>\n"
    templates.check(XmlTemplate, data, ["/a/@b", "//c", "//d"])


@pytest.mark.integration
def test_plugin_reader_conforms(installed: Path, tmp_path: Path) -> None:
    tables = {
        b"track 1\ntick far\n0 0.5\n1 2\nend\n": {"tick": [0, 1], "far": [50.0, 200.0]},
        b"track 1\ntick far\nend\n": {"tick": [], "far": []},
    }
    damaged = [
        b"track 1\ntick far\n0 0.5\n",
        b"track 1\ntick far\n0\nend\n",
        b"track 1\ntick far\n0 x\nend\n",
        b"track 2\nend\n",
    ]
    readers.check("track", tables, damaged, tmp_path, {"scale": 100.0})


COLUMNS = b'{"a": [1, 2], "b": ["x", "y"]}'
AB = {"a": [1, 2], "b": ["x", "y"]}
GRAPH = b"""<graphml><key id="b" attr.name="b" attr.type="string"/><graph><node a="1"/><node a="2"/></graph></graphml>"""


@pytest.mark.integration
@pytest.mark.each_case
@pytest.mark.parametrize(
    ("name", "tables", "damaged", "form"),
    [
        ("csv", {b"a,b\n1,x\n2,y\n": AB, b"a,b\n": {"a": [], "b": []}}, [b"a,b\n1\n", b""], PLAIN),
        ("csv", {b"#\na;b\n1;x\n#\n2;y\n": AB}, [b"#\na;b\n1\n", b""], Form(comment="#", na=("-",))),
        ("jsonl", {b'{"a": 1, "b": "x"}\n{"a": 2, "b": "y"}\n': AB}, [b'{"a": 1\n', b"[1]\n"], PLAIN),
        ("jsonl", {b'{"a": 1, "b": "x"}\n{"a": 2, "b": "y"}\n': AB}, [b'{"a": 1\n', b"[1]\n"], Form(flatten=True)),
        ("json", {b'[{"a": 1, "b": "x"}, {"a": 2, "b": "y"}]': AB, COLUMNS: AB}, [b"[1]", b"", b"["], PLAIN),
        ("xml", {b'<r><s a="1" b="x"/><s a="2" b="y"/></r>': AB}, [b'<r><s a="1" b="x"/>', b""], Form(rows="//s")),
        ("parquet", None, [b"PAR1"], PLAIN),
        ("npy", None, [b"", b"PK", b"\x93NUMPY"], PLAIN),
        ("arrow", None, [b"", b"ARROW1"], PLAIN),
        ("sqlite", None, [b"", b"x"], Form(rows="t")),
        ("graphml", {GRAPH: {"a": ["1", "2"]}}, [b"", GRAPH[:-1]], Form(rows="nodes")),
    ],
)  # fmt: skip
def test_shipped_readers_conform(name: str, tables: Any, damaged: list[bytes], form: Form, tmp_path: Path) -> None:
    made = {"parquet": parquet, "npy": npz, "arrow": arrow, "sqlite": sqlite}
    readers.check(name, tables or made[name](tmp_path), damaged, tmp_path / "trial", form=form)


def npz(folder: Path) -> dict[bytes, Any]:
    import numpy as np

    np.savez(folder / "one.npz", a=np.array([1, 2]), b=np.array(["x", "y"]))
    return {(folder / "one.npz").read_bytes(): {"i": [0, 1], **AB}}


def arrow(folder: Path) -> dict[bytes, Any]:
    import pyarrow as pa
    from pyarrow import feather

    feather.write_feather(pa.table(AB), folder / "one.arrow")
    return {(folder / "one.arrow").read_bytes(): AB}


def sqlite(folder: Path) -> dict[bytes, Any]:
    import sqlite3
    from contextlib import closing

    with closing(sqlite3.connect(folder / "one.db")) as database:
        database.execute("CREATE TABLE t (a, b)")
        database.execute("INSERT INTO t VALUES (1, 'x'), (2, 'y')")
        database.commit()
    return {(folder / "one.db").read_bytes(): AB}


def parquet(folder: Path) -> dict[bytes, Any]:
    import pyarrow as pa
    import pyarrow.parquet as pq

    columns = {"a": [1, 2], "b": ["x", "y"], "c": [0.5, None]}
    pq.write_table(pa.table(columns), folder / "one.parquet")
    return {(folder / "one.parquet").read_bytes(): columns}


@pytest.mark.integration
def test_plugin_runner_conforms(installed: Path, tmp_path: Path) -> None:
    from tortoise.runner import Niced, NicedOptions  # type: ignore[import-not-found]

    runners.check_runner(lambda slots: Niced(slots, NicedOptions(niceness=3)), tmp_path)


@pytest.mark.integration
def test_plugin_scheduler_conforms(installed: Path, tmp_path: Path) -> None:
    (tmp_path / "spool").mkdir()
    (tmp_path / "trial").mkdir()
    table = schedulers.table("spool", {"spool": str(tmp_path / "spool")}, "here")
    runners.check(schedulers.find("spool")(table), tmp_path / "trial")


@pytest.mark.integration
def test_plugin_engine_without_isolation_conforms(installed: Path, tmp_path: Path) -> None:
    engine_conformance.check(engines.find("direct"), None, tmp_path, tmp_path)


# Plug-ins that cannot be used


@pytest.mark.integration
@pytest.mark.parametrize(
    ("code", "told"),
    [
        ("import nothing_of_this_name", "cannot be loaded: ModuleNotFoundError: No module named 'nothing_of_this_name'"),
        (
            PLATFORM.replace("contract = 1", "contract = 2"),
            "is made for version 2 of the contract, but this SIERRA has version 1",
        ),
        (PLATFORM.replace("def files", "def file"), "lacks files"),
        (PLATFORM.replace("self.words = ", "self.words = 1 / 0 + "), "cannot be made: ZeroDivisionError: division by zero"),
        *at_night(
            [
                ("raise SystemExit('no\\nlicence')", "cannot be loaded: SystemExit: no licence"),
                ("def f(:", "cannot be loaded: SyntaxError: "),
                ("", "cannot be loaded: AttributeError: "),
                (
                    PLATFORM.replace("contract = 1", ""),
                    "declares no version of the contract, but this SIERRA has version 1",
                ),
                (PLATFORM.replace("Options = NoOptions", "Options = dict"), "Options is not a subclass of Table"),
            ]
        ),
    ],
)
def test_unusable_plugin_is_reported_in_one_line_and_breaks_no_other_command(
    plain: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: str, told: str
) -> None:
    name = f"bad{abs(hash(code)) % 10**9}"
    monkeypatch.syspath_prepend(str(plugins.write(tmp_path / "lib", name, {"sierra.platforms odd": "Made"}, code)))
    succeed(plain, "run", "population_size=1,2", "--runs", "1", "--no-figures")
    succeed(plain, "ls")
    check = {one["name"]: one for one in json.loads(projects.quick(plain, "doctor", "--json").stdout)}["platform odd"]
    change(plain, "template =", 'platform = "odd"\ntemplate =')
    line = refused(plain, "run", "population_size=1")
    assert line.startswith(f"sierra: the platform 'odd' of {name} 1")
    assert told in line
    assert line.endswith(f"; install a version of {name} that works, or uninstall it")
    assert (check["state"], told in check["found"]) == (("ok", False) if "cannot be made" in told else ("missing", True))
    succeed(plain, "ls")


@pytest.mark.integration
def test_plugin_name_of_two_packages_is_an_error_that_names_both(
    plain: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for package in ("first_of_two", "second_of_two"):
        plugins.write(tmp_path / "lib", package, {"sierra.platforms twice": "Made"}, PLATFORM)
    monkeypatch.syspath_prepend(str(tmp_path / "lib"))
    succeed(plain, "run", "population_size=1", "--runs", "1", "--no-figures")
    change(plain, "template =", 'platform = "twice"\ntemplate =')
    told = "the platform 'twice' is offered by first_of_two 1 and by second_of_two 1; uninstall all but one of these packages"
    assert refused(plain, "run", "population_size=1") == f"sierra: {told}"


def test_plugin_cannot_replace_a_shipped_name(plain: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(plugins.write(tmp_path / "lib", "taker", {"sierra.readers jsonl": "Made"}, PLATFORM)))
    append(plain, '[outputs.log]\nfile = "log.jsonl"\nrequired = false\n')
    line = refused(plain, "run", "population_size=3", "--runs", "1")
    assert line.startswith("sierra: the reader 'jsonl' is offered by SIERRA itself and by taker 1; ")


def test_fault_in_a_plugin_is_reported_with_its_package(plain: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    code = PLATFORM.replace("return self.words", "return self.wrods")
    monkeypatch.syspath_prepend(str(plugins.write(tmp_path / "lib", "faulty", {"sierra.platforms odd": "Made"}, code)))
    change(plain, "template =", 'platform = "odd"\ntemplate =')
    line = refused(plain, "run", "population_size=1", code=1)
    told = "a fault in the platform 'odd' of faulty 1: AttributeError: 'Made' object has no attribute 'wrods'"
    assert line.startswith(f"sierra: {told}; please report it to its authors with ")


@pytest.mark.nightly
def test_plugin_is_imported_only_by_commands_that_use_it(plain: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    mark = tmp_path / "imported"
    code = f"open({str(mark)!r}, 'w').close()\n{PLATFORM}"
    monkeypatch.syspath_prepend(str(plugins.write(tmp_path / "lib", "lazy", {"sierra.platforms odd": "Made"}, code)))
    for words in (("ls",), ("run", "population_size=1,2", "--runs", "1", "--no-figures"), ("sql", "SELECT 1")):
        succeed(plain, *words)
    assert not mark.exists()
    change(plain, "template =", 'platform = "odd"\ntemplate =')
    succeed(plain, "run", "population_size=1", "--runs", "1", "--no-figures")
    assert mark.exists()


# Templates that are not a single file


@pytest.mark.nightly
def test_template_may_render_arguments_and_several_files(plain: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(plugins.write(tmp_path / "lib", "flagged", {"sierra.templates flags": "Made"}, FLAGS)))
    (plain / "sim.flags").write_text("--count 1\n--seed 0\n--label two words\n")
    (plain / "sim.py").write_text(
        "import os, sys\n"
        "notes = open(os.environ['SIERRA_RUN_DIR'] + '/notes.txt').read()\n"
        "print('count,label,notes', ','.join([sys.argv[2], sys.argv[6], notes]), sep='\\n', file=open('out.csv', 'w'))\n"
    )
    (plain / "sierra.toml").write_text(
        'template = "sim.flags"\ncommand = "python3 sim.py {arguments}"\nseed = "--seed"\n[variables]\ncount = "--count"\n'
    )
    assert "4 runs: 4 executed" in succeed(plain, "run", "count=3,4", "--runs", "2", "--no-figures")
    found = rows(plain, "SELECT count, label, notes FROM out ORDER BY count, notes")
    assert [(row["count"], row["label"]) for row in found] == [(3, "two words")] * 2 + [(4, "two words")] * 2
    assert all(row["notes"].startswith(f"--count {row['count']} --seed ") for row in found)
    assert len({row["notes"] for row in found}) == 4
    assert "identical" in succeed(plain, "replay", sierra.open(plain).batches[-1].batch)


def test_arguments_placeholder_needs_a_suitable_template_and_must_be_a_whole_word(plain: Path) -> None:
    change(plain, "python3 sim.py {input}", "python3 sim.py {arguments}")
    told = "sierra: command: {arguments} needs a template that provides arguments; arena.xml provides none"
    assert refused(plain, "run", "population_size=1") == told
    change(plain, "{arguments}", "--all={arguments}")
    told = "sierra: command: {arguments} expands to several words; write it as a separate word, not '--all={arguments}'"
    assert refused(plain, "run", "population_size=1") == told
