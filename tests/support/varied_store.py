"""A store that has been through much: for tests that compare ways of reading it."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import sierra
from tests import projects

SIMULATOR = (
    projects.SIMULATOR
    + """
import json
kind = arena.split('kind="')[1].split('"')[0]
if count == 9:
    sys.exit("nine is too many")
with open("levels.csv", "w") as file:
    print("tick", "Level" if count % 2 else "level", "value", sep=",", file=file)
    for tick in range(3):
        print(tick, tick * count, {1: tick, 2: tick + 0.5, 3: "none", 4: 2**60 + tick}[count], sep=",", file=file)
with open("notes.jsonl" if count < 3 else "Notes.jsonl", "w") as file:
    for place in range(3):
        print(json.dumps({"place": place, "what": f"{kind} {place}"}), file=file)
with open("wide.csv", "w") as file:
    print("a;b", file=file)
    for tick in range(3 + seed % 2):
        print(tick, count + tick / 2, sep=";", file=file)
print("said by", seed)
"""
)
TEMPLATE = projects.TEMPLATE.replace('controller="none"', 'controller="none" kind="0"')
CONFIG = (
    projects.CONFIG
    + """
kind = "//swarm/@kind"
"""
)
JUDGED = '\n[outputs.wide]\nfile = "wide.csv"\nmismatch = "ragged"\n'
PACKAGE = '\n[package]\ntitle = "Coverage"\nauthors = [{ name = "Jane Doe" }]\nlicense = "MIT"\n'
REMOVED = "a_word_of_nobody_else"


QUERIES = (
    ("population_size=1,2",),
    ("population_size=2,3", "--runs", "3"),
    ("kind=a,b", "population_size=1"),
    ("kind=1,2", "population_size=2"),
    ("population_size=1,9",),
    ("population_size=4", "noise=0.5,0.25"),
)
FAILING = (QUERIES[1], QUERIES[4])
"""Those with failed runs."""


def make(folder: Path, after: Callable[[Path], None] = lambda root: None) -> Path:
    """Make a project with seven batches in its store, some of which share runs; return its folder.

    `after` is called with the project's folder after each step.

    It has failed, reused, replayed and imported executions, marked trials, later judgements, a removed batch, axes of several
    types, and outputs whose columns differ in their types and in upper and lower case.
    """
    from sierra.extensions.trials import mark_trial

    root = projects.make(folder, CONFIG, simulator=SIMULATOR, template=TEMPLATE)
    other = projects.make(
        folder.with_name(f"{folder.name} of others"), CONFIG + PACKAGE, simulator=SIMULATOR, template=TEMPLATE
    )
    for words in QUERIES:
        _ask(root, *words, code=int(words in FAILING))
        after(root)
    project = sierra.open(root)
    project.replay(project.batches[0].batch, runs=1)
    removed = _ask(root, f"kind={REMOVED}")
    after(root)
    execution = projects.sql(root, "SELECT min(execution) AS e FROM executions WHERE status = 'ok'")[0]["e"]
    mark_trial(project, execution, valid=False, reason="it fell", operator="Ada")
    mark_trial(project, execution, valid=True, note="it did not")
    last = projects.sql(root, "SELECT max(execution) AS e FROM executions WHERE status = 'ok'")[0]["e"]
    mark_trial(project, last, valid=False, reason="wet floor")
    (root / "sierra.toml").write_text(CONFIG + JUDGED)
    after(root)
    _ask(root, *QUERIES[0])
    after(root)
    project = sierra.open(root)
    batch = sierra.open(other).run("population_size=2,3", "noise=0.75", figures=False).batch
    package = other / "package.zip"
    sierra.open(other).packages.pack(batch, report=False, path=package)
    after(other)
    project.packages.import_records(package)
    after(root)
    project.records.remove(removed)
    shutil.rmtree(other)
    return root


def _ask(root: Path, *words: str, code: int = 0) -> str:
    done = projects.quick(root, "run", *words, "--no-figures", "--json")
    assert done.returncode == code, done.stderr
    return str(json.loads(done.stdout)["batch"])
