"""Claims are planned if their text was recorded before all executions that count for them, in the order of Lamport numbers."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path
from typing import Any

import pytest

import sierra
from sierra.config import project_file
from sierra.deliverables.claims import registration
from sierra.deliverables.claims.model import Registered
from sierra.deliverables.claims.registration import normal_form
from sierra.store.lamport_clock import stamp
from sierra.store.store import Store
from tests import projects

QUERY = '[queries.main]\ncriteria = "population_size=1,2"\n'
HOLDS = 'sql = "SELECT count(*) > 0 AS holds FROM swarm"'
CLOCK = 'import time\nopen("clock.csv", "w").write(f"now\\n{time.time_ns()}\\n")\n'
"""Further lines of a simulator, whose output differs in each execution."""
PACKAGE = '[package]\ntitle = "Coverage"\nauthors = [{ name = "Jane Doe" }]\nlicense = "MIT"\n'
ALL = "SELECT claim, name, session, lamport FROM registered_claims ORDER BY lamport, name"


def claim(decision: str = HOLDS, says: str = "It covers.", name: str = "covers") -> str:
    return f'[claims.{name}]\nsays = "{says}"\npaper = "Fig. 1"\nquery = "main"\n{decision}\n'


def write(root: Path, *tables: str) -> None:
    (root / "sierra.toml").write_text(projects.CONFIG + QUERY + "".join(tables))


@pytest.fixture
def root(tmp_path: Path) -> Path:
    made = projects.make(tmp_path / "project")
    write(made, claim())
    return made


def told(root: Path, *words: str) -> dict[str, Any]:
    """Return the only evaluated claim."""
    done = projects.quick(root, *(words or ("claims",)), "--json")
    assert "Traceback" not in done.stderr
    [found] = json.loads(done.stdout)
    return dict(found)


def word(root: Path) -> str:
    return str(told(root)["registered"])


def reason(root: Path) -> str:
    return str(told(root)["registration"]["reason"])


def run(root: Path, *words: str) -> None:
    done = projects.quick(root, "run", *(words or ("main",)), "--no-figures")
    assert done.returncode == 0, done.stderr


def segments(root: Path) -> set[str]:
    folder = root / ".sierra" / "segments"
    return {path.name for path in folder.iterdir()} if folder.exists() else set()


@pytest.mark.integration
def test_a_claim_that_is_declared_before_its_runs_is_planned(root: Path) -> None:
    run(root)
    assert word(root) == "planned"
    assert reason(root) == "it was registered before 4 executions began"
    done = projects.quick(root, "claims")
    assert "planned" in done.stdout
    assert "note: covers: planned: it was registered before 4 executions began" in done.stderr
    before = segments(root)
    assert projects.quick(root, "claims", "--register").stdout.splitlines()[-1].split() == ["covers", "registered", "before"]
    run(root)
    assert segments(root) == before, "a text is recorded once"


@pytest.mark.integration
def test_a_claim_that_is_registered_is_not_yet_decided_without_runs(root: Path) -> None:
    done = projects.quick(root, "claims", "--register", "--json")
    assert json.loads(done.stdout) == [{"name": "covers", "registration": "registered now"}]
    assert done.returncode == 0
    assert word(root) == "registered, not yet decided"
    run(root)
    assert word(root) == "planned"
    write(root, claim('plan_n = "sierra plan-n 518b -d 0.05"\n' + HOLDS))
    assert "note: covers: number of runs from: sierra plan-n 518b -d 0.05\n" in projects.quick(root, "claims").stderr


@pytest.mark.integration
def test_a_claim_about_recorded_runs_is_exploratory_and_says_how_many_were_reused(root: Path) -> None:
    write(root)
    run(root)
    write(root, claim())
    assert (word(root), reason(root)) == ("exploratory", "4 of 4 executions began before it was registered")
    write(root, QUERY.replace("main", "more") + "runs = 3\n", claim().replace('"main"', '"more"'))
    run(root, "more")
    assert (word(root), reason(root)) == ("exploratory", "4 of 6 executions began before it was registered")


@pytest.mark.integration
def test_only_the_experiments_that_a_claim_names_count(root: Path) -> None:
    write(root)
    run(root, "population_size=1")
    value = 'value = { column = "coverage", experiments = "population_size=2", expected = 8, margin = 99 }'
    write(root, claim(value), claim(name="all"))
    run(root)
    found = {one.name: (one.registered, one.registration.reason) for one in sierra.open(root).claims.evaluate()}
    assert found["covers"] == (Registered.PLANNED, "it was registered before 2 executions began")
    assert found["all"] == (Registered.EXPLORATORY, "2 of 4 executions began before it was registered")


@pytest.mark.integration
def test_nothing_is_written_where_claims_are_only_read(root: Path, tmp_path: Path) -> None:
    write(root, PACKAGE)
    run(root)
    batch = sierra.open(root).batches[0].batch
    write(root, PACKAGE, claim(), '[numbers.word]\nclaim = "covers"\nvalue = "registered"\n')
    before = segments(root)
    for words in (
        ("run", "main", "-n"),
        ("paper", "-n"),
        ("report", batch[:10], "--to", str(tmp_path / "report.html")),
        ("package", batch[:10], "-o", str(tmp_path / "a.zip"), "--yes", "--no-report"),
        ("open", str(tmp_path / "a.zip"), "claims"),
    ):
        done = projects.quick(root, *words)
        assert "Traceback" not in done.stderr
        assert segments(root) == before, words
    assert "exploratory: it is not registered, and 4 executions counted before" in done.stderr


@pytest.mark.integration
def test_a_changed_claim_begins_anew_and_shows_its_history(root: Path) -> None:
    run(root)
    changed = claim(says="It covers much.")
    write(root, changed)
    done = projects.quick(root, "claims")
    assert "note: covers: exploratory: 4 of 4 executions began before it was registered" in done.stderr
    assert "note: covers: changed once since it was first registered (20" in done.stderr
    write(root, claim())
    assert told(root)["registration"]["changes"] == 2, "it was changed, and back again"
    assert word(root) == "planned", "the text was recorded before the runs"
    write(root, claim(name="renamed"))
    assert (word(root), told(root)["registration"]["changes"]) == ("planned", 0)


def test_the_smallest_number_of_a_text_counts_and_equal_numbers_plan_nothing() -> None:
    def recorded(*numbers: int, packages: list[str] | None = None) -> list[registration._Recorded]:
        return [registration._Recorded("c", "n", 0.0, stamp(number, "f" * 16), packages) for number in numbers]

    def counted(*numbers: int, packages: list[str] | None = None) -> list[registration._Counted]:
        return [registration._Counted(stamp(number, "0" * 16), packages, 1) for number in numbers]

    def told(own: list[registration._Recorded], executions: list[registration._Counted]) -> tuple[Registered, str]:
        return registration._word(own, executions)

    assert told(recorded(9, 2), counted(3, 4))[0] is Registered.PLANNED
    assert told(recorded(2, 9), counted(2, 3)) == (
        Registered.EXPLORATORY,
        "1 of 2 executions began before it was registered",
    )
    assert told(recorded(3), [])[0] is Registered.UNDECIDED
    assert told([], [])[0] is Registered.MISSING
    theirs = recorded(1, packages=["p"])
    assert told(theirs, counted(2, packages=["p"]))[0] is Registered.PLANNED
    assert told(theirs, counted(2, packages=["q"]))[0] is Registered.EXPLORATORY
    assert told(theirs, counted(2, packages=["p", "q"]))[0] is Registered.EXPLORATORY
    assert told(theirs, counted(2)) == (
        Registered.EXPLORATORY,
        "1 of 1 execution came from another store than its registration",
    )
    assert told(recorded(1), counted(2, packages=["p"]))[0] is Registered.EXPLORATORY


def test_changes_are_counted_from_the_registered_texts() -> None:
    assert registration._changes([], "a") == 0
    assert registration._changes(["a"], "a") == 0
    assert registration._changes(["a", "b", "c"], "c") == 2
    assert registration._changes(["a", "b"], "a") == 2
    assert registration._changes(["a"], "b") == 1, "the present text is not registered"


@pytest.mark.integration
def test_two_processes_that_register_at_once_leave_one_word(root: Path) -> None:
    both = [projects.start(root, "claims", "--register") for _ in range(2)]
    assert [(one.communicate(timeout=60), one.returncode)[1] for one in both] == [0, 0]
    run(root)
    # A second process that read the store before the first one had registered the text, and records it after the runs.
    loaded = project_file.load(root / "sierra.toml")
    form = normal_form(loaded, loaded.config.claims["covers"])
    store = Store(root / ".sierra")
    registration._record(store, {"covers": (registration.claim_id(form), form)})
    assert len({row["claim"] for row in projects.sql(root, ALL)}) == 1 < len(projects.sql(root, ALL))
    assert (word(root), reason(root)) == ("planned", "it was registered before 4 executions began")


@pytest.mark.integration
def test_rm_and_gc_keep_registrations_and_fsck_checks_them(root: Path) -> None:
    run(root)
    [row] = projects.sql(root, ALL)
    for number in range(4):
        write(root, claim(says=f"It covers {number} times."))
        assert projects.quick(root, "claims", "--register").returncode == 0
    before = projects.sql(root, ALL)
    assert projects.quick(root, "gc", "--yes").returncode == 0
    assert projects.sql(root, ALL) == before
    batch = sierra.open(root).batches[0].batch
    assert projects.quick(root, "rm", batch[:10], "--yes").returncode == 0
    assert projects.sql(root, ALL) == before
    shown = projects.quick(root, "show", row["claim"][:10])
    assert "It covers." in shown.stdout
    assert f"sierra show {row['claim'][:10]} shows it" in projects.quick(root, "why", row["claim"][:10]).stderr
    done = projects.quick(root, "rm", row["claim"][:10], "--yes")
    assert done.returncode == 0, done.stderr
    assert projects.sql(root, ALL) == before[1:]
    assert "nothing" not in done.stdout
    assert projects.quick(root, "fsck").returncode == 0
    registration._record(Store(root / ".sierra"), {"forged": ("0" * 64, {"says": "It was planned."})})
    done = projects.quick(root, "fsck")
    assert "claim 0000000000 does not have the id that follows from its columns" in done.stdout
    assert done.returncode != 0


@pytest.mark.integration
def test_a_package_carries_the_registrations_of_its_claims(root: Path, tmp_path: Path) -> None:
    write(root, PACKAGE, claim(), claim(name="secret", says="It is unpublished."))
    run(root)
    write(root, PACKAGE, claim())
    package = str(tmp_path / "results.zip")
    done = projects.quick(root, "package", "--claims", "-o", package, "--yes")
    assert done.returncode == 0, done.stderr
    assert told(root, "open", package, "claims")["registered"] == "planned"
    with zipfile.ZipFile(package) as file:
        [described] = [json.loads(file.read(name)) for name in file.namelist() if name.endswith("package.json")]
        [page] = [file.read(name).decode() for name in file.namelist() if name.endswith("report.html")]
    [packed] = described["claims"]
    assert packed["registered"] == "planned"
    assert packed["registration"] in page
    other = projects.make(tmp_path / "other")
    write(other, claim())
    assert projects.quick(other, "claims", "--register").returncode == 0
    assert projects.quick(other, "import", package).returncode == 0
    assert {row["name"] for row in projects.sql(other, ALL)} == {"covers"}, "only claims of the packed project"
    assert len(projects.sql(other, ALL)) == 2
    assert word(other) == "planned", "both came in the package"
    assert projects.quick(other, "fsck").returncode == 0
    run(other)
    assert (word(other), reason(other)) == ("planned", "it was registered before 4 executions began"), "its own, before its own"
    batch = sierra.open(other).batches[0].batch
    assert projects.quick(other, "rm", batch[:10], "--yes").returncode == 0
    assert len(projects.sql(other, ALL)) == 1, "the other's registration went with the last batch of its package"
    assert projects.sql(other, "SELECT * FROM imports") == []


@pytest.mark.integration
def test_an_imported_registration_plans_no_executions_of_this_store_and_none_of_ours_plans_imported_ones(
    root: Path, tmp_path: Path
) -> None:
    write(root, PACKAGE)
    run(root)
    batch = sierra.open(root).batches[0].batch
    plain, registered = str(tmp_path / "plain.zip"), str(tmp_path / "registered.zip")
    assert projects.quick(root, "package", batch[:10], "-o", plain, "--yes", "--no-report").returncode == 0
    other = projects.make(tmp_path / "other")
    write(other, claim())
    assert projects.quick(other, "claims", "--register").returncode == 0
    assert projects.quick(other, "import", plain).returncode == 0
    assert (word(other), reason(other)) == ("exploratory", "4 of 4 executions came from another store than its registration")
    third = projects.make(tmp_path / "third")
    write(third, PACKAGE, claim())
    run(third)
    assert projects.quick(third, "package", "--claims", "-o", registered, "--yes", "--no-report").returncode == 0
    fourth = projects.make(tmp_path / "fourth")
    write(fourth)
    assert projects.quick(fourth, "import", registered).returncode == 0
    run(fourth)
    write(fourth, claim())
    assert (word(fourth), reason(fourth)) == ("exploratory", "4 of 4 executions began before it was registered")


@pytest.mark.integration
def test_executing_the_runs_of_a_package_again_plans_nothing(root: Path, tmp_path: Path) -> None:
    (root / "sim.py").write_text(projects.SIMULATOR + CLOCK)
    write(root, PACKAGE)
    run(root)
    write(root, PACKAGE, claim())
    assert word(root) == "exploratory"
    package = str(tmp_path / "results.zip")
    assert projects.quick(root, "package", "--claims", "-o", package, "--yes", "--no-report").returncode == 0
    done = projects.quick(tmp_path, "reproduce", package, "--into", "again", "--yes", "--json")
    [found] = json.loads(done.stdout)["claims"]
    assert (found["ground"], found["registered"]) == ("re-executed", "exploratory")
    assert found["registration"] == "4 of 4 executions began before it was registered"


@pytest.mark.integration
def test_an_anonymous_package_keeps_the_word(root: Path, tmp_path: Path) -> None:
    write(root, PACKAGE, claim())
    run(root)
    package = str(tmp_path / "anonymous.zip")
    done = projects.quick(root, "package", "--claims", "--anonymous", "-o", package, "--yes", "--no-report")
    assert done.returncode == 0, done.stderr
    assert told(root, "open", package, "claims")["registered"] == "planned"
    other = projects.make(tmp_path / "other")
    write(other, claim())
    assert projects.quick(other, "import", package).returncode == 0
    [marked] = projects.sql(other, "SELECT count(*) AS n FROM redactions SEMI JOIN registered_claims USING (session)")
    assert marked == {"n": 1}


@pytest.mark.integration
def test_the_report_and_the_paper_give_the_word(root: Path, tmp_path: Path) -> None:
    number = '[numbers.word]\nclaim = "covers"\nvalue = "registered"\n'
    write(root, claim('sql = "SELECT count(*) > 0 AS holds, 1 AS one FROM swarm"'), number)
    done = projects.quick(root, "paper")
    assert done.returncode == 0, done.stderr
    assert "claim covers: planned\n" in done.stdout
    folder = root / "paper" / "sierra"
    assert r"\newcommand{\sierraword}{planned}" in (folder / "numbers.tex").read_text()
    provenance = json.loads((folder / "provenance.json").read_text())
    assert provenance["claims"]["covers"]["registered"] == "planned"
    assert projects.quick(root, "paper", "--check").returncode == 0
    batch = sierra.open(root).batches[0].batch
    report = tmp_path / "report.html"
    assert projects.quick(root, "report", batch[:10], "--to", str(report)).returncode == 0
    assert "planned: it was registered before 4 executions began" in report.read_text()
    write(root, claim('sql = "SELECT count(*) > 1 AS holds, 1 AS one FROM swarm"'), number)
    done = projects.quick(root, "paper", "--check")
    assert (done.returncode, "another record of claim 'covers', which is exploratory" in done.stdout) == (1, True)


def test_a_normal_form_freezes_the_query_its_runs_and_the_decision(root: Path) -> None:
    order = 'order = { by = "population_size", groups = ["2", "1"], column = "coverage", measure = "time_to", threshold = 3 }'
    write(root, claim(f'runs = 7\nplan_n = "sierra  plan-n 518b -d 0.05"\n{order}'))
    loaded = project_file.load(root / "sierra.toml")
    form = normal_form(loaded, loaded.config.claims["covers"])
    assert form == {
        "says": "It covers.",
        "query": {
            "query": "population_size=1,2",
            "overrides": [],
            "controller": None,
            "scenario": None,
            "runs": 7,
            "target": None,
        },
        "order": {
            "column": "coverage",
            "measure": "time_to",
            "threshold": 3.0,
            "groups": ["2", "1"],
            "by": "population_size",
        },
        "plan_n": "sierra plan-n 518b -d 0.05",
    }
    golden = "0a55dfff002e7133"
    assert registration.claim_id(form).startswith(golden), "the id of a normal form is the same for ever"


def test_where_the_paper_shows_a_claim_and_what_only_baselines_need_is_not_in_the_normal_form(root: Path) -> None:
    value = 'value = { column = "coverage", experiments = "population_size=2", expected = 8, margin = 1MORE }'
    forms = []
    for more, place in (("", "Fig. 1"), (', better = "higher", regression = "5 %"', "Fig. 2")):
        write(root, claim(value.replace("MORE", more)).replace("Fig. 1", place))
        loaded = project_file.load(root / "sierra.toml")
        forms.append(normal_form(loaded, loaded.config.claims["covers"]))
    assert forms[0] == forms[1]
    write(root, claim(value.replace("MORE", "")), "")
    assert "expected" in forms[0]["value"]


@pytest.mark.integration
def test_what_cannot_be_registered_is_said_in_one_line(root: Path) -> None:
    done = projects.quick(root, "claims", "covers", "--register")
    assert done.stderr == ("sierra: --register records all claims and evaluates none; leave out names, --against and --junit\n")
    write(root, claim(), claim(name="wrong").replace('"main"', '"population_size.Nonsense"'))
    done = projects.quick(root, "claims", "--register")
    assert done.returncode == 1
    assert "not registered: " in done.stdout
    assert "covers" in done.stdout
    done = projects.quick(root, "run", "main", "--no-figures")
    assert done.returncode == 0, "a claim that is wrong stops no run"
    assert "claim wrong is not registered: " in done.stderr
    write(root)
    assert projects.quick(root, "claims", "--register").stderr == "sierra: sierra.toml declares no [claims.NAME]\n"
    write(root, claim('plan_n = "guessed"\n' + HOLDS))
    assert "'guessed' should be the command, as in: sierra plan-n" in projects.quick(root, "claims").stderr
