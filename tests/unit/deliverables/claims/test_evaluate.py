"""Claims hold, do not hold, or cannot be told, by the runs that their query recorded."""

from __future__ import annotations

import json
import shutil
import tomllib
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sierra
from sierra.config import project_file
from sierra.config.claim_table import ClaimedOrder
from sierra.deliverables.claims import by_test, evaluate
from sierra.deliverables.claims.by_value import decide
from sierra.deliverables.claims.evaluate import Ground, Verdict
from sierra.deliverables.claims.model import ClaimResult
from sierra.errors import ConfigError, NotFound
from sierra.stats.comparison.model import Cell, Question, RunValue, Sample
from sierra.store.store import Store
from tests import projects

SIMULATOR = projects.SIMULATOR.replace("with open", 'if count == 3 and seed % 2:\n    sys.exit("odd")\nwith open', 1)
"""A simulator whose runs with 3 robots and an odd seed fail."""
CONFIG = (
    projects.CONFIG
    + """
[queries.main]
criteria = "population_size=1,2,8"
runs = 12
[queries.failing]
criteria = "population_size=3"
runs = 12
"""
)
PACKAGE = """
[package]
title = "Coverage of a swarm"
authors = [{ name = "Jane Doe" }]
license = "MIT"
"""
VALUE = 'value = { column = "coverage", experiments = "population_size=8", expected = EXPECTED, margin = "10 %" }'


def claim(name: str, decision: str, query: str = "main") -> str:
    return f'[claims.{name}]\nsays = "It is so."\npaper = "Fig. 1"\nquery = "{query}"\n{decision}\n'


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A project with two batches, in one of which runs failed; tests only change its claims."""
    root = projects.make(tmp_path_factory.mktemp("claims") / "project", CONFIG, simulator=SIMULATOR)
    project = sierra.open(root)
    project.run("main", figures=False)
    project.run("failing", figures=False)
    return root


def found(root: Path, *claims: str, names: tuple[str, ...] = ()) -> dict[str, dict[str, Any]]:
    """Return the evaluated claims by name, after writing them into the project."""
    (root / "sierra.toml").write_text(CONFIG + "".join(claims))
    done = projects.quick(root, "claims", *names, "--json")
    assert "Traceback" not in done.stderr
    evaluated = json.loads(done.stdout)
    assert done.returncode == (0 if all(one["verdict"] == "holds" for one in evaluated) else 1)
    return {one["name"]: one for one in evaluated}


@pytest.mark.integration
def test_a_value_holds_if_its_whole_interval_is_within_the_margin(recorded: Path) -> None:
    claims = [claim(f"about_{e}", VALUE.replace("EXPECTED", str(e))) for e in (36, 39, 100)]
    answer = found(recorded, *claims)
    assert [one["verdict"] for one in answer.values()] == ["holds", "can't tell", "does not hold"]
    for one in answer.values():
        seeds = projects.sql(recorded, "SELECT DISTINCT number, seed FROM batch_runs WHERE ordinal = 2")
        mean = 32 + 0.1 * sum(row["seed"] % 100 for row in seeds) / 12
        assert (one["n"], one["value"]) == (12, pytest.approx(mean))
        assert one["low"] < mean < one["high"]
        assert one["ground"] == "recomputed from recorded data"


@pytest.mark.integration
def test_orders_and_equivalences_are_tested_and_corrected_together(recorded: Path) -> None:
    tests = [
        claim("order", 'order = { by = "population_size", groups = ["8", "2", "1"] }'),
        claim("reverse", 'order = { by = "population_size", groups = ["1", "8"] }'),
        claim("alike", 'equivalence = { by = "population_size", groups = ["1", "2"], margin = 4.5 }'),
        claim("unlike", 'equivalence = { by = "population_size", groups = ["1", "2"], margin = 3.5 }'),
        claim("later", 'order = { by = "noise", groups = ["1", "2"] }', query="noise=1,2"),
    ]
    answer = found(recorded, *tests)
    verdicts = {name: one["verdict"] for name, one in answer.items()}
    shown = {"order": "holds", "reverse": "does not hold", "alike": "holds", "unlike": "does not hold"}
    assert verdicts == shown | {"later": "can't tell"}
    assert "run: sierra run noise=1,2" in answer["later"]["text"]
    assert answer["alike"]["p"] == pytest.approx(4 / 2**12), "the four claims on this table of pairs count"
    assert found(recorded, *tests, names=("order",))["order"] == answer["order"], "no claim can be picked"


@pytest.mark.integration
def test_lost_runs_count_up_to_what_the_claim_allows(recorded: Path) -> None:
    decision = 'sql = "SELECT min(coverage) >= 0 AS holds, count(DISTINCT run) AS some FROM swarm"'
    answer = found(
        recorded,
        claim("strict", decision, query="failing"),
        claim("lenient", f'lost = "90 %"\n{decision}', query="failing"),
        claim("value", 'value = { column = "coverage", expected = 1, margin = 1 }', query="failing"),
    )
    good = answer["lenient"]["n"]
    assert 0 < good < 12
    assert answer["lenient"]["numbers"] == {"some": good}
    assert answer["lenient"]["verdict"] == "holds"
    for name in ("strict", "value"):
        assert answer[name]["verdict"] == "can't tell"
        assert f"{12 - good} of 12 runs failed, were cut off, are missing or have no finite value" in answer[name]["text"]


STATEMENTS = {
    "SELECT true FROM swarm": "it has 180 rows; a claim needs one",
    "SELECT true FROM swarm WHERE tick < 0": "it has 0 rows; a claim needs one",
    "SELECT count(*) FROM swarm": "not true or false",
    "SELECT max(coverage) > NULL FROM swarm": "yields NULL",
    "SELECT true, 'nan'::DOUBLE AS x": "x is NaN",
    "DELETE FROM swarm": "statements are not allowed",
    "COPY swarm TO 'stolen.csv'": "statements are not allowed",
    "SELECT count(*) > 0 FROM read_csv('/etc/passwd')": "read_csv() is not allowed here",
    "SELECT count(*) > 0 FROM 'https://example.org/x.csv'": "there is no table",
    "SELECT random() > 0": "another value each time",
    "SELECT true; SELECT false": "use one statement",
    "SELECT sum(a.range * b.range * c.range) > 0 FROM range(99999) a, range(99999) b, range(99999) c": "did not end",
    "WITH RECURSIVE r AS (SELECT 1 AS x UNION ALL SELECT x FROM r) SELECT count(*) > 0 FROM r": "did not end",
    "SELEC true": "syntax error",
    "SELECT max(least) > 9 FROM gaps": "gaps.least has NaN",
    "SELECT max(v) > 9 FROM (SELECT * FROM gaps) AS g (label, run, v)": "gaps.least has NaN",
    "SELECT bool_and(good) FROM hidden": "gaps.least has NaN",
}
"""Statements that decide nothing, and why."""
GAPS = """
[sql]
wall = 5
[tables.gaps]
sql = "SELECT run, CASE WHEN min(tick) = 0 THEN 'nan'::DOUBLE ELSE 0 END AS least FROM swarm GROUP BY run"
[tables.hidden]
sql = "SELECT run, least > 9 AS good FROM gaps"
"""
"""Derived tables of which one has NaN, and the other hides that."""


@pytest.mark.nightly
def test_statements_that_decide_nothing_are_one_line_each(recorded: Path) -> None:
    good = claim("good", 'sql = "SELECT count(*) = 0 FROM gaps WHERE isfinite(least)"')
    claims = [claim(f"bad{place}", f'sql = "{statement}"') for place, statement in enumerate(STATEMENTS)]
    answer = found(recorded, good, *claims, GAPS)
    assert answer["good"]["verdict"] == "holds"
    for place, said in enumerate(STATEMENTS.values()):
        bad = answer[f"bad{place}"]
        assert bad["verdict"] == "can't tell"
        assert said in bad["text"]
        assert "\n" not in bad["text"]
    assert not (recorded / "stolen.csv").exists()


@pytest.mark.integration
def test_the_command_prints_a_table_and_writes_junit(recorded: Path, tmp_path: Path) -> None:
    claims = [claim(f"about_{e}", VALUE.replace("EXPECTED", str(e))) for e in (36, 39, 100)]
    (recorded / "sierra.toml").write_text(CONFIG + "".join(claims))
    done = projects.quick(recorded, "claims", "--junit", str(tmp_path / "claims.xml"))
    assert done.returncode == 1
    assert done.stdout.splitlines()[0].split() == ["claim", "verdict", "registered", "numbers", "n", "ground"]
    suite = ET.parse(tmp_path / "claims.xml").getroot()[0]  # noqa: S314 - written above
    assert suite.attrib == {"name": "claims", "tests": "3", "failures": "1", "errors": "1"}
    assert [case[0].tag for case in suite] == ["system-out", "error", "failure"]
    done = projects.quick(recorded, "claims", "about_10")
    assert (done.returncode, "did you mean 'about_100'?" in done.stderr) == (2, True)
    (recorded / "sierra.toml").write_text(CONFIG)
    done = projects.quick(recorded, "claims")
    assert (done.returncode, done.stderr) == (2, "sierra: sierra.toml declares no [claims.NAME]\n")


@pytest.mark.nightly
def test_the_batches_of_claims_and_their_ground_are_known_to_callers(recorded: Path) -> None:
    (recorded / "sierra.toml").write_text(
        CONFIG + claim("one", 'sql = "SELECT true"') + claim("two", 'sql = "SELECT true"', query="noise=1,2")
    )
    project = project_file.load(recorded)
    store = Store(recorded / ".sierra")
    (one,) = evaluate.evaluate(project, store, ["one"], ground=Ground.REEXECUTED)
    assert (one.verdict, one.ground.value) == (Verdict.holds, "re-executed")
    assert evaluate.batches(project, store, ["one"]) == {"one": one.batches}
    with pytest.raises(NotFound, match=r"\[claims\.two\].* run: sierra run noise=1,2"):
        evaluate.batches(project, store)
    every = store.values(str, "SELECT batch FROM batches")
    assert evaluate.batches(project, store, ["one"], among=every) == {"one": one.batches}
    (recorded / "sierra.toml").write_text(
        CONFIG + claim("one", 'sql = "SELECT true"').replace("[claims.one]", "[claims.one]\nruns = 5")
    )
    with pytest.raises(NotFound, match=r"none of the given batches has its query: population_size=1,2,8, 5 runs for each"):
        evaluate.batches(project_file.load(recorded), store, among=every)


@pytest.mark.parametrize(
    ("table", "said"),
    [
        ('query = "noise=1"', "give exactly one of sql, value, order, equivalence"),
        ('sql = "SELECT true"', 'give either "query" or "batches"'),
        ('query = "noise=1"\nsql = "SELECT true"\nfigure = "speeed"', "there is no [figures.speeed]"),
        ('query = "noise=1"\nvalue = { expected = 0, margin = "5 %" }', "a percentage of 0 is 0"),
        ('query = "noise=1"\nvalue = { expected = 1, margin = "five" }', "or a percentage such as 5 %"),
        ('query = "noise=1"\nsql = "SELECT true"\nlost = -1', "should be a number of runs"),
        ('query = "noise=1"\norder = { groups = ["1", "2"] }', '"by" is missing'),
        ('query = "noise=1"\norder = { by = "noise", groups = ["1"] }', "groups should have at least 2 items"),
        ('query = "noise=1"\nequivalence = { by = "noise", groups = ["1", "1"], margin = 1 }', "named twice"),
    ],
)
def test_claims_that_say_too_little_are_refused(table: str, said: str) -> None:
    claims = {"x": {"says": "so", "paper": "Fig. 1"} | tomllib.loads(table)}
    with pytest.raises(ConfigError) as error:
        project_file.parse({"template": "x.xml", "command": "true", "claims": claims}, "sierra.toml")
    assert said in str(error.value)


def test_an_interval_within_the_limits_outside_or_across_them() -> None:
    assert decide(1, 2, 1, 2) is Verdict.holds
    assert decide(2.1, 3, 1, 2) is Verdict.does_not_hold
    assert decide(0, 0.9, 1, 2) is Verdict.does_not_hold
    assert decide(1.5, 2.1, 1, 2) is decide(0, 3, 1, 2) is Verdict.cannot_tell


def verdict(groups: list[Any], tests: int = 1) -> Verdict:
    return conclusion(groups, tests).verdict


def conclusion(groups: list[Any], tests: int) -> ClaimResult:
    """Return the finding about the order of samples, of which the first should have the greatest values."""
    names = tuple(map(str, range(len(groups))))
    samples = (
        Sample(name, tuple(RunValue(seed, float(v)) for seed, v in enumerate(values)), len(values))
        for name, values in zip(names, groups, strict=True)
    )
    asked = ClaimedOrder(groups=names, by="x", paired=False)
    pairs, paired, notes = by_test._pairs([Cell({}, tuple(samples))], Question(asked.alpha, None, False), "auto", {})
    tested = by_test.Tested(asked, pairs, 0, "", paired, notes)
    return by_test.conclude(tested, min(1.0, tests * tested.p), by_test.Family(tests))


def test_equal_groups_are_seldom_ordered() -> None:
    """Simulation: without a difference, each of the two wrong verdicts has at most half of alpha, 0.05."""
    random = np.random.default_rng(1)
    found = [verdict(list(random.normal(size=(2, 10)))) for _ in range(400)]
    most = 400 * 0.025 + 3 * (400 * 0.025 * 0.975) ** 0.5
    assert 0 < found.count(Verdict.holds) <= most
    assert 0 < found.count(Verdict.does_not_hold) <= most


def test_an_interval_without_0_beside_a_claim_that_is_not_shown_is_said_to_be_of_its_pair_alone() -> None:
    groups = [[4, 5, 6, 7, 8, 9.0], [3, 1, 2, 0, 4.5, 1.5]]
    alone, among = (conclusion(groups, tests) for tests in (1, 40))
    assert (alone.verdict, among.verdict) == (Verdict.holds, Verdict.cannot_tell)
    groups[1][0] = 6.5
    among = conclusion(groups, 4)
    assert (among.verdict, (among.low or 0) > 0) == (Verdict.cannot_tell, True)
    assert among.text.endswith("; each interval is of one pair alone, not corrected for 4 tests")
    assert not among.notes


@pytest.mark.integration
def test_an_order_of_three_needs_both_parts() -> None:
    random = np.random.default_rng(2)
    found = [verdict([random.normal(5, 1, 10), random.normal(0, 1, 10), random.normal(0, 1, 10)]) for _ in range(200)]
    assert found.count(Verdict.holds) <= 200 * 0.025 + 3 * (200 * 0.025 * 0.975) ** 0.5
    assert verdict([[9, 8, 9, 8, 9.5], [5, 4, 5, 4, 4.5], [1, 2, 1, 2, 1.5]]) is Verdict.holds


def test_too_few_runs_for_any_verdict_are_told() -> None:
    assert verdict([[4, 5, 6], [1, 2, 3]]) is Verdict.cannot_tell
    assert verdict([[4, 5, 6, 7], [0, 1, 2, 3]]) is Verdict.holds
    assert verdict([[4, 5, 6, 7], [0, 1, 2, 3]], tests=2) is Verdict.cannot_tell


@pytest.mark.nightly
def test_baselines_of_batches_and_of_packages_find_regressions(recorded: Path, tmp_path: Path) -> None:
    """The batches are packed, the code becomes worse, and the clone without the old store sees the regression."""
    value = VALUE.replace("EXPECTED", "36").replace('"10 %" }', '"10 %", better = "higher", regression = "5 %" }')
    order = claim("order", 'order = { by = "population_size", groups = ["8", "2"] }')
    (recorded / "sierra.toml").write_text(CONFIG + PACKAGE + claim("eight", value) + order)
    project = sierra.open(recorded)
    assert projects.quick(recorded, "package", "--claims", "--no-report", "-o", str(tmp_path / "old.zip")).returncode == 0
    [old] = {one for found in project.claims.evaluate() for one in found.batches}
    clone = tmp_path / "clone"
    shutil.copytree(recorded, clone, ignore=shutil.ignore_patterns(".sierra"))
    (clone / "sim.py").write_text(SIMULATOR.replace("count * tick", "0.9 * count * tick"))
    done = projects.quick(clone, "baseline", "set", "published", str(tmp_path / "old.zip"))
    assert done.stdout == "sierra.baselines.json: baseline published with 2 claims\n"
    new = sierra.open(clone).run("main", figures=False).batch
    done = projects.quick(clone, "claims", "--against", "published", "--junit", str(tmp_path / "claims.xml"), "--json")
    changed = {one["name"]: one for one in json.loads(done.stdout)}
    assert done.returncode == 1
    assert {name: one["verdict"] for name, one in changed.items()} == {"eight": "regression", "order": "no regression"}
    assert [changed["eight"][name] for name in ("difference", "low", "high")] == pytest.approx([-3.2, -3.2, -3.2])
    assert ET.parse(tmp_path / "claims.xml").getroot()[0].get("failures") == "1"  # noqa: S314 - written above
    before = projects.quick(clone, "baseline", "set", "itself", new[:10])
    assert (before.returncode, projects.quick(clone, "claims", "--against", "itself").returncode) == (0, 0)
    xml = str(tmp_path / "compared.xml")
    wide, narrow = (
        projects.quick(clone, "compare", new[:10], f"{tmp_path}/old.zip:{old[:8]}", "--margin", margin, "--junit", xml)
        for margin in ("5", "2")
    )
    assert "no figure: the runs of old are not in the store" in wide.stderr + narrow.stderr
    suite = ET.parse(xml).getroot()[0]  # noqa: S314 - written above
    assert [case[0].get("message") for case in suite] == [None, None, "different"]
    done = projects.quick(clone, "compare", f"{tmp_path}/old.zip", f"again={tmp_path}/old.zip")
    assert (done.returncode, "cannot be compared with itself" in done.stderr) == (2, True)
    done = projects.quick(clone, "claims", "--against", "publishd")
    assert (done.returncode, "did you mean 'published'?" in done.stderr) == (2, True)
    (clone / "sierra.baselines.json").write_text('{"format": 1, "baselines": {"x": {"eight": {"n": "1"}}}}')
    done = projects.quick(clone, "claims", "--against", "x")
    assert (done.returncode, done.stderr.count("\n")) == (2, 4), "one line for each of the four errors"
    assert all(line.startswith("sierra: sierra.baselines.json: ") for line in done.stderr.splitlines())
