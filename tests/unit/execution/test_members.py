"""Runs on robots: their identity, their inputs, and what is recorded of them."""

from __future__ import annotations

import json
import platform
import re
import subprocess
from pathlib import Path

import pytest

import sierra
from sierra.errors import ConfigError, QueryError, SierraError, UsageError
from sierra.execution.commands import CommandBuilder
from sierra.model import ARCH_ON_ROBOT, ON_ROBOT, Job, Member
from sierra.store.row_types import RobotRow
from tests import images, projects, robots
from tests.tiers import needs_extension, of_extension

GROUPS = """
[targets.robots.robots.base]
command = "{python} tracker.py"
[targets.robots.robots.groups.leader]
places = [2, 7]
command = "{python} robot.py {input} {robot} --leader"
changes = [{ set = "//@x", value = "{robot * 10}" }]
"""


@pytest.fixture(autouse=True)
def _fleet(monkeypatch: pytest.MonkeyPatch) -> None:
    robots.register(monkeypatch)


def jobs(root: Path, *query: str) -> list[Job]:
    """Return the jobs of a query for the target `robots`."""
    plan = sierra.open(root).plan(*query, target="robots", runs=1)
    builder = CommandBuilder(plan.batch.spec, root, plan.engine, plan.limits, "session", root)
    return [builder.job(run, files) for run, files in plan.inputs.files(plan.batch, lambda run: True)]


BAG = """
[targets.robots.outputs.scan]
file = "run.db3"
format = "bag"
topics = ["/scan"]
required = false
"""


@pytest.mark.integration
def test_a_database_whose_messages_may_be_unknown_is_reported_before_the_robots_move(tmp_path: Path) -> None:
    root = robots.project(tmp_path / "p", BAG)

    def notes(target: str, *words: str, size: int = 1) -> list[str]:
        done = projects.quick(root, "run", f"population_size={size}", "--target", target, "--no-figures", *words)
        assert done.returncode == (2 if size == 5 else 0), done.stderr
        return [line for line in done.stderr.splitlines() if "before Iron" in line or line.startswith("sierra: ")]

    note, refused = notes("robots", size=5)
    assert note.startswith("note: [outputs.scan]: databases of ROS 2 before Iron ({robot}/run.db3) do not have the definitions")
    assert "the fleet has 4" in refused, "nothing has moved yet"
    assert notes("robots", "--dry-run") == notes("robots") == [note]
    assert notes("sim", "--dry-run") == []
    (root / "sierra.toml").write_text((root / "sierra.toml").read_text().replace(BAG, f'{BAG}ros = "humble"\n'))
    assert notes("robots", "--dry-run") == []


@pytest.mark.integration
def test_all_robots_of_a_run_write_one_table_and_are_recorded(tmp_path: Path) -> None:
    root = robots.project(tmp_path / "p", GROUPS)
    project = sierra.open(root)
    summary = project.run("population_size=1,3", target="robots", figures=False)
    assert (summary.executed, summary.failed) == (4, 0), summary
    assert projects.sql(
        root, "SELECT population_size, robot, count(*) AS rows, max(tick) AS last FROM swarm GROUP BY ALL ORDER BY ALL"
    ) == [{"population_size": count, "robot": robot, "rows": 8, "last": 3} for count in (1, 3) for robot in range(1, count + 1)]
    assert projects.sql(root, "SELECT DISTINCT robot FROM tracking") == [{"robot": 0}]
    [found] = projects.sql(root, "SELECT execution FROM runs WHERE population_size = 3 AND number = 0")
    execution = found["execution"]
    assert projects.sql(
        root, f"SELECT place, robot_group, robot FROM robots WHERE execution = '{execution}' ORDER BY place"
    ) == [
        {"place": 0, "robot_group": "base", "robot": "tb3-00"},
        {"place": 1, "robot_group": "robot", "robot": "tb3-01"},
        {"place": 2, "robot_group": "leader", "robot": "tb3-02"},
        {"place": 3, "robot_group": "robot", "robot": "tb3-03"},
    ]
    # the clock of robot 2 is 2 s ahead, and 20 µs more after 10 s: 10 µs after 5 s
    start = robots.START_NS
    assert projects.sql(
        root,
        f"SELECT stamp - offset_ns - round(drift * (stamp - clock_ns))::BIGINT - {start} AS common, uncertainty_ns "
        f"FROM (SELECT {start + 5 * robots.SECOND} AS stamp), robot_clocks WHERE place = 2 AND execution = '{execution}'",
    ) == [{"common": 3 * robots.SECOND - 10_000, "uncertainty_ns": 1_002_000.0}]
    shown = projects.quick(root, "show", execution[:12]).stdout
    assert "tb3-02" in shown
    taken = projects.quick(root, "outputs").stdout
    assert "table tracking from 0/tracking.csv" in taken
    assert project.maintenance.fsck().findings == ()
    again = project.run("population_size=1,2,3", target="robots", figures=False)
    assert (again.executed, again.reused) == (2, 4), "the size of the largest run is no part of smaller ones"


def test_each_robot_gets_inputs_and_commands_of_its_own(tmp_path: Path) -> None:
    changes = 'run_changes = [{ set = "//@x", value = "{robot + run}" }]\n'
    variables = '[environment]\nset = { ROS_NAMESPACE = "tb{robot}" }\n'
    root = robots.project(tmp_path / "p", GROUPS + variables, changes + robots.CONFIG)
    [job] = jobs(root, "population_size=3")
    assert [(one.place, one.group) for one in job.members] == [(0, "base"), (1, "robot"), (2, "leader"), (3, "robot")]
    inputs = [dict(one.files)["input.xml"].decode() for one in job.members]
    assert [text.split('x="')[1].split('"')[0] for text in inputs] == ["0", "1", "20", "3"]
    assert [one.argv for one in job.members[1:3]] == [
        ("python3", f"{ON_ROBOT}/robot.py", "\0/input.xml", "1"),
        ("python3", f"{ON_ROBOT}/robot.py", "\0/input.xml", "2", "--leader"),
    ]
    names = ("SIERRA_ROBOT", "SIERRA_ROBOTS", "ROS_NAMESPACE")
    assert [job.members[2].environment[name] for name in names] == ["2", "3", "tb2"]
    assert "PATH" not in job.members[2].environment
    assert (job.argv, job.environment) == ((), {})
    listed = json.loads(dict(job.files)["sierra_robots.json"])["robots"]
    assert [sorted(one) for one in listed] == [
        ["files", "group", "place"],
        ["group", "place"],
        *2 * [["files", "group", "place"]],
    ]


def test_the_processor_is_the_robots_and_the_code_has_the_programs_for_all(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = robots.CONFIG.replace('"{python} robot.py', '"bin/{arch}/go robot.py')
    root = robots.project(tmp_path / "p", '[environment]\nset = { LIBRARIES = "{project}/lib/{arch}" }\n', config)
    (root / ".gitignore").write_text("bin\n")
    subprocess.run(["git", "init", "-q", root], check=True)
    for arch in ("aarch64", "x86_64"):
        (root / "bin" / arch).mkdir(parents=True)
        (root / "bin" / arch / "go").write_text(arch)
    [job] = jobs(root, "population_size=1")
    assert job.members[0].argv[0] == f"{ON_ROBOT}/bin/{ARCH_ON_ROBOT}/go"
    placed = job.members[0].at("/run", "/code", "armv7l")
    assert (placed.argv[0], placed.environment["LIBRARIES"]) == ("/code/bin/armv7l/go", "/code/lib/armv7l")
    monkeypatch.setattr(platform, "machine", lambda: "arm64")
    assert [one.run for one in jobs(root, "population_size=1")] == [job.run], "the processor is no part of the identity"
    plan = sierra.open(root).plan("population_size=1", target="robots")
    assert [one.name for one in plan.programs.all] == [f"{{project}}/bin/{arch}/go" for arch in ("x86_64", "aarch64")]


def test_commands_and_groups_are_part_of_the_identity_and_other_projects_keep_theirs(tmp_path: Path) -> None:
    def runs(name: str, more: str = "", target: str = "robots") -> set[str]:
        return {job.run for job in jobs(robots.project(tmp_path / name, more), "population_size=3")} if target else set()

    plain = runs("plain")
    assert plain == runs("again")
    others = [
        runs("group", "[targets.robots.robots.groups.leader]\nplaces = [2]\n"),
        runs("base", '[targets.robots.robots.base]\ncommand = "{python} tracker.py"\n'),
        runs("far", "[targets.robots.robots.groups.leader]\nplaces = [9]\n"),
    ]
    assert [one == plain for one in others] == [False, False, True]
    sim = robots.project(tmp_path / "sim")
    with_robots = sierra.open(sim).plan("population_size=3").batch.id
    (sim / "sierra.toml").write_text(robots.CONFIG.split("[targets.robots]")[0])
    assert sierra.open(sim).plan("population_size=3").batch.id == with_robots


@pytest.mark.parametrize(
    ("change", "query", "kind", "message"),
    [
        (('count = "population_size"', 'count = "swarm"'), "population_size=2", QueryError, "which the query does not vary"),
        ((), "population_size=1.5,2", QueryError, "population_size is 1.5, but a run takes a whole number of robots"),
        ((), "population_size=0,1", QueryError, "count is 0; a run takes 1 to 1000 robots"),
        (("{input}\"\ntarget", "{input} {robot}\"\ntarget"), "population_size=2", ConfigError, "unknown placeholder {robot}"),
        (('file = "swarm.csv"', 'file = "*.csv"'), "population_size=2", ConfigError, "name the file, or put a name in braces"),
        (('runs = 2', 'runs = 2\nbefore = "true"'), "population_size=2", ConfigError, "before has no effect on robots"),
        (("[variables]", "changes=[{set='//@x',value='{robot}'}]\n[variables]"), "population_size=1", ConfigError, "in run"),
        (('robot.py {input}', '../robot.py {project}/../x'), "population_size=2", ConfigError, "outside of the project"),
    ],
)  # fmt: skip
def test_what_robots_cannot_do_is_refused_in_one_line(
    tmp_path: Path, change: tuple[str, ...], query: str, kind: type[SierraError], message: str
) -> None:
    config = robots.CONFIG.replace(*change) if change else robots.CONFIG
    root = robots.project(tmp_path / "p", config=config)
    target = "sim" if "unknown placeholder" in message else "robots"
    with pytest.raises(kind) as raised:
        sierra.open(root).plan(query, target=target)
    assert message in str(raised.value)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ("[targets.robots.robots.groups.robot]\nplaces = [1]\n", "groups.robot: this name is taken"),
        ("[targets.robots.robots.groups]\na = { places = [1] }\nb = { places = [1] }\n", "place 1 is in a and in b"),
        ("[targets.robots.robots.groups.a]\nplaces = [0]\n", "places"),
        ("[per_run]\nrobot = [1, 2]\n", "{robot} is the robot's place"),
        ("[targets.half.robots]\ncount = 2.5\n", "2.5 should be a whole number from 1, or the name of a variable"),
        ("[targets.half.robots]\ncount = true\n", "True should be a whole number from 1"),
    ],
)  # fmt: skip
def test_contradictory_tables_of_robots_are_refused(tmp_path: Path, more: str, message: str) -> None:
    with pytest.raises(ConfigError) as raised:
        sierra.open(robots.project(tmp_path / "p", more)).plan("population_size=2", target="robots")
    assert message in str(raised.value)


@pytest.mark.integration
def test_a_runner_that_does_not_claim_containers_gets_no_runs_in_them(tmp_path: Path) -> None:
    more = '[targets.robots.container]\nimage = "sim.tar"\nengine = "apptainer"\n'
    root = robots.project(tmp_path / "p", more)
    layer = images.layer(("bin/python3", "#!"))
    images.docker_archive(root / "sim.tar", [layer])
    sierra.open(root).images.pin("sim.tar")
    project = sierra.open(root)
    with pytest.raises(UsageError, match=r"^runner 'pretend' cannot execute runs on robots in containers; use --on robots, or"):
        project.run("population_size=2", target="robots", runner="pretend", figures=False)
    assert list(project.batches) == []
    assert project.run("population_size=2", target="robots", runner="pretend", engine="none", figures=False).failed == 0


def test_runners_refuse_runs_that_they_cannot_execute(tmp_path: Path) -> None:
    project = sierra.open(robots.project(tmp_path / "p", "[runners.pretend]\nrobots = 2\n"))
    with pytest.raises(UsageError, match=r"'local' cannot execute runs on robots .* use --on robots"):
        project.run("population_size=2", target="robots", runner="local", figures=False)
    with pytest.raises(UsageError, match="'pretend' executes runs on robots only"):
        project.run("population_size=2", target="sim", runner="pretend", figures=False)
    with pytest.raises(ConfigError, match="runs take 3 robots, but the fleet has 2"):
        project.run("population_size=2,3", target="robots", figures=False)
    assert list(project.batches) == []


LEADER = "[targets.robots.robots.groups.leader]\nplaces = [2, 4]\n"
SUPERVISED = "[targets.robots.trials]\nsupervised = true\ncountdown = 0\n"


@needs_extension("robots")
@pytest.mark.parametrize(
    ("more", "groups", "message"),
    [
        (LEADER, ("robot", "laeder"), "tb2: no place is of the group 'laeder'; did you mean 'leader'?"),
        (
            "",
            ("robot", "arm"),
            "tb2: no place is of the group 'arm'; [robots.groups] can declare it, and there are robot, base",
        ),
        *of_extension(
            "trials",
            (
                LEADER + SUPERVISED,
                ("robot", "leader", "robot", "robot"),
                "a run needs 2 robots of the group 'leader', but the fleet has 1; runs of 1 to 3 robots are possible",
            ),
        ),
        (
            LEADER,
            ("robot", "leader", "base"),
            "a run needs 2 robots of the group 'robot', but the fleet has 1; runs of 1 to 2 robots are possible",
        ),
        (
            LEADER,
            ("leader", "leader"),
            "a run needs 2 robots of the group 'robot', but the fleet has 0; add some to [runners.robots.fleet]",
        ),
    ],
)
def test_a_fleet_that_cannot_take_all_places_of_all_runs_is_refused_before_anything_moves(
    tmp_path: Path, more: str, groups: tuple[str, ...], message: str
) -> None:
    fleet = "".join(
        f'fleet.tb{number} = {{ host = "tb{number}.invalid", group = "{group}" }}\n' for number, group in enumerate(groups, 1)
    )
    config = robots.CONFIG.replace('"pretend"', '"robots"')
    root = robots.project(tmp_path / "p", f"{more}[runners.robots]\nstop = []\n{fleet}", config)
    done = projects.quick(root, "run", "population_size=1,2,3,4", "--target", "robots", "--yes", "--no-figures")
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == f"sierra: {message}\n"
    assert projects.sql(root, "SELECT count(*) AS sessions FROM sessions") == [{"sessions": 0}]


@needs_extension("robots")
def test_a_robot_may_be_of_a_group_of_another_target(tmp_path: Path) -> None:
    fleet = 'fleet.tb1 = { host = "tb1.invalid" }\nfleet.tb2 = { host = "tb2.invalid", group = "leader" }\n'
    other = "[targets.other.robots]\ncount = 1\ngroups.leader.places = [1]\n"
    config = robots.CONFIG.replace('"pretend"', '"robots"')
    root = robots.project(tmp_path / "p", f"{other}[runners.robots]\nstop = []\nlink = 'none'\n{fleet}", config)
    with pytest.raises(SierraError, match="unknown link 'none'"):
        sierra.open(root).run("population_size=1", target="robots", figures=False)


@pytest.mark.integration
def test_a_robot_without_an_output_and_an_invalid_trial_do_not_count(tmp_path: Path) -> None:
    config = robots.CONFIG.replace("{input} {robot}", "{input} {robot} silent")
    root = robots.project(tmp_path / "p", "[runners.pretend]\ninvalid = [0]\n", config)
    summary = sierra.open(root).run("population_size=1,2", target="robots", runs=1, figures=False)
    assert summary.failed == 2
    assert projects.sql(root, "SELECT status, reason FROM executions ORDER BY lamport") == [
        {"status": "invalid", "reason": "invalid trial: fell over"},
        {"status": "failed", "reason": "robot 2 (tb3-02) did not write 'swarm.csv'"},
    ]


@needs_extension("robots")
@pytest.mark.integration
def test_robots_that_have_changed_are_noted_and_stamps_of_set_clocks_are_missing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plain, versions = robots._row, iter(("1.4", "1.5"))

    def row(job: Job, one: Member, code: int) -> RobotRow:
        version = next(versions)
        was_set = "its wall clock has moved by +3 s" if version == "1.5" else None
        return plain(job, one, code)._replace(
            firmware=version, calibration_sha256="ab" * 32, clock_remark=was_set, uneven_ns=None
        )

    monkeypatch.setattr(robots, "_row", row)
    root = robots.project(tmp_path / "p")
    project = sierra.open(root)
    expected = (
        "tb3-01: stamps of 1 run cannot be converted to one time axis (robot_clocks.remark): its wall clock has moved by +3 s",
        "tb3-01: its firmware differs between runs of this batch: 1.4, 1.5",
    )
    for _ in range(2):  # also if nothing is executed
        summary = project.run("population_size=1", target="robots", figures=False)
        assert summary.notes[-2:] == expected
    assert projects.sql(
        root, "SELECT drift IS NULL AS missing, remark IS NULL AS fine, uncertainty_ns FROM robot_clocks ORDER BY ALL"
    ) == [  # nobody has watched these clocks: their change by 10 µs may have come at once
        {"missing": False, "fine": True, "uncertainty_ns": 1_010_000.0},
        {"missing": True, "fine": False, "uncertainty_ns": 1_010_000.0},
    ]


@pytest.mark.nightly
def test_a_batch_names_its_robots_and_says_if_their_firmware_differs_between_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plain, versions = robots._row, {"tb3-01": "1.4", "tb3-02": "1.5"}

    def row(job: Job, one: Member, code: int) -> RobotRow:
        made = plain(job, one, code)
        return made._replace(firmware=versions.get(made.robot))

    monkeypatch.setattr(robots, "_row", row)
    root = robots.project(tmp_path / "p", '[targets.robots.robots.base]\ncommand = "{python} tracker.py"\n')

    def shown(query: str, **more: int) -> tuple[list[list[object]], list[object], str]:
        """Execute a query; return the robots and the firmware of its batch in JSON, and its text."""
        batch = sierra.open(root).run(query, target="robots", figures=False, **more).batch
        found = json.loads(projects.quick(root, "show", batch, "--json").stdout)
        listed = [[one[name] for name in ("robot", "place", "firmware", "runs")] for one in found["robots"]]
        return listed, found["firmware"], projects.quick(root, "show", batch).stdout

    base = ["tb3-00", 0, None, 4]
    listed, firmware, text = shown("population_size=1,2")
    assert listed == [base, ["tb3-01", 1, "1.4", 4], ["tb3-02", 2, "1.5", 2]]
    assert firmware == [], "robots may differ from each other"
    assert re.search(
        r"\nrobots:\nrobot +place +robot_group +firmware +runs\ntb3-00 +0 +base +4\ntb3-01 +1 +robot +1.4 +4\n", text
    )
    assert "firmware differs" not in text
    versions["tb3-01"] = "1.5"
    listed, firmware, text = shown("population_size=1,2", runs=3)
    assert listed == [["tb3-00", 0, None, 6], ["tb3-01", 1, "1.4", 4], ["tb3-01", 1, "1.5", 2], ["tb3-02", 2, "1.5", 3]]
    assert firmware == [{"firmware": "1.4", "robots": 1, "runs": 4}, {"firmware": "1.5", "robots": 2, "runs": 4}]
    assert "\nfirmware differs between runs: 1.4 (1 robot, 4 runs), 1.5 (2 robots, 4 runs)\n" in text
