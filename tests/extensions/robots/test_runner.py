"""Tests of the runner on robots, which are folders of this machine here. `tests/extensions/robots` has real ones."""

from __future__ import annotations

import hashlib
import re
import shutil
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from sierra.config.validate import options
from sierra.containers.engines.hosts import OtherHost
from sierra.errors import ConfigError, Missing
from sierra.extensions.robots.agent_link import AgentLink
from sierra.extensions.robots.fleet_table import FleetTable, RobotTable
from sierra.extensions.robots.runner import Robots
from sierra.ingest.observations import observed
from sierra.model import Job
from sierra.provenance.environment import differing
from sierra.runners.base import Look, Work
from sierra.store.layout import SessionPaths
from sierra.testing import robots as conformance
from sierra.util.kept_log import kept_of
from sierra.worker.processes import marked
from tests.pythons import python_of
from tests.support.local_link import LocalChannel, LocalLink, ProcessLink
from tests.support.robot_runs import GO, Runs, execution_of, job
from tests.waiting import PATIENCE_S, until

NAMES = ("ada", "bob", "cy")


class Fleet(Runs):
    """Runs on three robots on this machine."""

    def __init__(self, folder: Path, links: dict[str, LocalLink] | None = None, **options: Any) -> None:
        self.links = links or {name: LocalLink(name, folder / name) for name in NAMES}
        super().__init__(folder, {name: one.home for name, one in self.links.items()}, self._link, **options)

    def _link(self, name: str, _: object) -> LocalLink:
        return self.links[name]


@pytest.fixture
def fleet(tmp_path: Path) -> Iterator[Fleet]:
    made = Fleet(tmp_path, setup="export GREETING=hello GREETING_TOKEN=abracadabra", lease=10.0)
    yield made
    for link in made.links.values():
        link.stall(stalled=False)
        link.kill()


def soon_over(fleet: Fleet) -> None:
    """Let a robot that hears nothing end its run soon, in a test that waits for this; no program is killed."""
    fleet.table = fleet.table.model_copy(update={"lease": 3.0, "grace": PATIENCE_S})


def is_alone(number: int) -> bool:
    """Return whether no process of a run is alive."""
    return not marked([b"SIERRA_EXECUTION=" + execution_of(number).encode()])


@pytest.mark.integration
def test_the_log_of_each_robot_is_kept_however_much_others_print(fleet: Fleet, tmp_path: Path):
    runner = fleet.submit(job(1, "1", "loud", "2", f"7@{tmp_path}/gate", "3", "loud"))
    fleet.all_begun()
    (tmp_path / "gate").touch()
    [result] = fleet.follow(runner)
    content, size = kept_of(f"{result.directory}/stdout")
    assert len(content) == size, "the recorder leaves out nothing more"
    text = content.decode()
    assert text.count("==> ") == 3
    assert text.count("bytes left out") == 2
    assert "==> ada <==\nrobot 1\nxxx" in text
    assert text.endswith("x\n==> bob <==\nrobot 2\n"), "the log of the robot that has failed comes last"


@pytest.mark.integration
def test_a_run_on_three_robots_leaves_one_folder(fleet: Fleet):
    ada = RobotTable(host="ada", variables={"TZ": "Asia/Kathmandu"}, firmware=("echo", "1.4"))
    fleet.table = fleet.table.model_copy(update={"fleet": {**fleet.table.fleet, "ada": ada}, "variables": {"TZ": "UTC"}})
    first, second = fleet.run(job(1), job(2))
    assert (first.exit_code, first.error, first.stopped) == (0, None, None)
    assert [file.path for file in first.outputs] == ["1/here.csv", "2/here.csv", "3/here.csv"]
    assert Path(first.directory, "output/2/here.csv").read_text() == "time,robot\n0,2\n"
    assert Path(first.directory, "stdout").read_text() == "==> ada <==\nrobot 1\n==> bob <==\nrobot 2\n==> cy <==\nrobot 3\n"
    assert first.robots == {1: "ada", 2: "bob", 3: "cy"}
    assert first.host == "ada,bob,cy"
    assert second.exit_code == 0
    row = fleet.rows_by_place[2]
    assert (row["robot"], row["status"], row["reason"], row["exit_code"]) == ("bob", "ok", None, 0)
    assert [fleet.rows_by_place[place]["firmware"] for place in (1, 2)] == ["1.4", None]
    for row in fleet.rows_by_place.values():  # also that of a robot in another time zone
        assert abs(row["offset_start_ns"]) < 1_000_000_000
        assert 0 <= row["start_skew_ns"] < 60_000_000_000
        assert row["clock_remark"] is None
        assert 0 < row["uneven_ns"] < 1_000_000_000
    environments = {row["environment"]: row for table, row in fleet.rows if table == "environments"}
    assert '"GREETING": "hello"' in environments[row["environment"]]["variables"]
    assert "abracadabra" not in str(fleet.rows)
    assert all(list((link.home / ".cache/sierra-robot/runs").iterdir()) == [] for link in fleet.links.values())
    assert [name.split("/")[2] for name in fleet.links["ada"].pushed] == ["programs", "sources"]


@pytest.mark.parametrize("limit", [None, pytest.param(10.0, marks=pytest.mark.nightly)])
def test_a_step_of_the_clock_of_this_machine_is_not_blamed_on_robots(
    fleet: Fleet, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, limit: float | None
):
    fleet.table = fleet.table.model_copy(update={"clock_drift": limit, "lease": PATIENCE_S})
    gate = tmp_path / "gate"
    runner = fleet.submit(job(1, *(word for place in "123" for word in (place, f"0@{gate}"))))
    fleet.all_begun()
    wall = time.time_ns
    monkeypatch.setattr(time, "time_ns", lambda: wall() - 20_000_000_000)
    gate.touch()
    [result] = fleet.follow(runner)
    moved = "the wall clock of this machine has moved by -20 s while the run was executed"
    failed = "this machine has a clock that moved by -20 s during the run, more than clock_drift = 10 in [runners.robots]"
    assert result.error == (failed if limit else None)
    assert fleet.notes == [f"ada, bob, cy: {moved}, so that stamps cannot be converted to one time axis"]
    for row in fleet.rows_by_place.values():
        assert row["offset_end_ns"] - row["offset_start_ns"] > 19e9
        assert row["clock_remark"] == moved


@pytest.mark.integration
def test_files_and_software_of_each_robot_are_recorded(tmp_path: Path):
    workspace = tmp_path / "ws" / "install"
    workspace.mkdir(parents=True)
    (workspace / "controller").write_text("turn left")
    change = ["sh", "-c", "echo >> $AMENT_PREFIX_PATH/controller"]
    fleet = Fleet(tmp_path, setup=f"export AMENT_PREFIX_PATH={workspace} ROS_PACKAGE_PATH=/usr/share", stop=change)
    results = fleet.run(*(replace(job(number), observe={"project": "not there"}) for number in (1, 2)))
    used = observed(results[1])
    assert used is not None
    assert (used.observation.method, used.observation.reason) == ("maps", "only files that were mapped into memory were seen")
    python = Path(shutil.which("python3") or "").resolve()
    executed = {row.path: row.sha256 for row in used.read if row.use == "executed"}
    assert executed.keys() == {f"{{robot {name}}}{python}" for name in NAMES}
    assert set(executed.values()) == {hashlib.sha256(python.read_bytes()).hexdigest()}
    assert any("libc.so" in row.path and row.path.startswith("{robot cy}") for row in used.read)

    environments = {row["environment"]: row for table, row in fleet.rows if table == "environments"}
    before, after = (environments[row["environment"]] for table, row in fleet.rows if table == "robots" and row["place"] == 2)
    [(name, was, found)] = differing(before, after)
    assert name == f"workspaces.{workspace}"
    assert str(was).startswith("sha256 ")
    assert was != found
    assert re.search(r"^libc6==", str(after["packages"]), re.MULTILINE)


@pytest.mark.integration
def test_a_look_tells_that_a_run_is_being_stopped_and_then_that_its_files_are_collected(
    fleet: Fleet, monkeypatch: pytest.MonkeyPatch
):
    plain = AgentLink.pull

    def pull(agent: AgentLink, folder: str, target: Path) -> None:
        time.sleep(0.3)
        plain(agent, folder, target)

    monkeypatch.setattr(AgentLink, "pull", pull)
    states: list[tuple[bool, bool]] = []
    take = fleet.take

    def taken(runner: Robots) -> Look:
        look = take(runner)
        states.extend([now] if [now := (look.stopping, look.collecting)] != states[-1:] else [])
        return look

    monkeypatch.setattr(fleet, "take", taken)
    [result] = fleet.run(job(1, "1", "deaf", "2", "7", "3", "nap"))
    assert str(result.error).startswith("bob has failed: its program ended with status 7; the others were stopped")
    assert states == [(False, False), (True, False), (True, True), (False, False)]


def test_the_names_of_robots_are_those_that_take_the_places(fleet: Fleet):
    runner = Robots(1, fleet.table.model_copy(update={"use": ("bob", "cy")}), fleet.make_link)
    assert runner.robot_names([(1, "robot"), (2, "robot")]) == {1: "bob", 2: "cy"}
    with pytest.raises(ConfigError, match=r"a run needs 3 robots of the group 'robot'"):
        runner.robot_names([(1, "robot"), (2, "robot"), (3, "robot")])


def test_the_runner_passes_its_conformance_suite(fleet: Fleet, tmp_path: Path):
    folder = tmp_path / "suite"
    folder.mkdir()
    fleet.table = fleet.table.model_copy(update={"lease": PATIENCE_S})
    conformance.check(lambda: Robots(1, fleet.table, fleet.make_link), folder)


@pytest.mark.nightly
def test_the_oldest_supported_python_is_enough_for_all_that_executes_on_a_robot(tmp_path: Path, require: Callable[..., str]):
    oldest = str(python_of("3.8"))
    require("Python 3.8", there=oldest != "None")
    programs, home = tmp_path / "bin", tmp_path / "ada"
    programs.mkdir()
    for name, script in (("python3", "exit 1"), ("rostopic", "while echo average rate: 5.0; do sleep 0.1; done")):
        (programs / name).write_text(f"#!/bin/sh\n{script}\n")
        (programs / name).chmod(0o755)
    link = ProcessLink("ada", home, programs)
    runs = Runs(tmp_path, {"ada": home}, lambda *_: link, python=oldest, topic_rates={"/scan": 4.0}, setup="export SPEED=1")
    [result] = runs.run(replace(job(1, robots=1, python=oldest), observe={"project": "not there"}))
    assert (result.exit_code, result.error, [file.path for file in result.outputs]) == (0, None, ["1/here.csv"])
    assert observed(result)
    assert {"environments", "robots"} <= {table for table, _ in runs.rows}

    host = OtherHost("ada", link, "engines", oldest)
    placed = host.place(runs.code / "go.py", hashlib.sha256(GO.encode()).hexdigest(), "images", runs.notes.append)
    assert Path(placed.path).read_text() == GO
    assert host.facts.home == str(home)
    assert host.call("unusable", ["/dev/nothing"], False)
    assert host.call("run", ["echo", "1"], None, 10)[:2] == [0, "1\n"]
    link.close()


class Careless(Robots):
    """A runner that claims to use containers, but does not."""

    def submit(self, work: Work, session: SessionPaths) -> None:
        super().submit(replace(work, containers=None), session)


def test_the_suite_notices_a_runner_that_ignores_containers(fleet: Fleet, tmp_path: Path):
    with pytest.raises(AssertionError, match=r"^it has not requested the containers of Work\.containers$"):
        conformance.executes_nothing_beside_containers(Careless(1, fleet.table, fleet.make_link), tmp_path)


def test_nothing_starts_if_a_robot_is_missing(fleet: Fleet):
    fleet.links["bob"].off = True
    with pytest.raises(Missing, match=r"^bob: no answer$"):
        fleet.run(job(1))
    assert not fleet.begun()


@pytest.mark.integration
def test_a_robot_that_is_not_ready_stops_all(fleet: Fleet, tmp_path: Path):
    fleet.table = fleet.table.model_copy(update={"battery": str(tmp_path / "battery"), "battery_min": 30})
    (tmp_path / "battery").write_text("12")
    with pytest.raises(Missing, match=r"^ada: its battery has 12 %, less than battery_min = 30$"):
        fleet.run(job(1))


NOTHING: dict[str, Any] = {"setup": "", "battery": [], "firmware": [], "calibration": "", "checks": [], "topic_rates": {}}


@pytest.mark.integration
@pytest.mark.parametrize("kept", [None, *NOTHING])
def test_a_robot_may_have_nothing_of_what_the_fleet_has(fleet: Fleet, kept: str | None):
    for_all = {
        **{"setup": "false", "battery": "/nowhere/capacity", "firmware": ["false"], "calibration": "/nowhere/calibration"},
        **{"checks": [["false"]], "topic_rates": {"/scan": 4.0}, "stop": [], "disk_min": 1},
    }
    own = {key: value for key, value in NOTHING.items() if key != kept}
    fleet.table = options(FleetTable, {**for_all, "fleet": {"ada": {"host": "ada", **own}}}, "[runners.robots]")
    if kept is None:
        assert [(one.exit_code, one.error) for one in fleet.run(job(1, robots=1))] == [(0, None)]
    else:
        with pytest.raises(Missing, match=r"^ada: "):
            fleet.run(job(1, robots=1))


def test_no_robot_is_touched_if_this_machine_has_no_room_for_what_a_run_measures(fleet: Fleet):
    fleet.table = fleet.table.model_copy(update={"disk_min": 10**18})
    reason = (
        rf"^this machine: the disk of {re.escape(str(fleet.session.root))} has \d+ bytes free, less than disk_min = {10**18}$"
    )
    with pytest.raises(Missing, match=reason):
        fleet.run(job(1))
    assert not any(link.pushed or list(link.home.iterdir()) for link in fleet.links.values())


@pytest.mark.integration
def test_a_failed_program_stops_the_others(fleet: Fleet):
    [result] = fleet.run(job(1, "1", "sleep", "2", "7", "3", "sleep"))
    assert result.exit_code == 7
    assert result.error
    assert "bob has failed: its program ended with status 7; " in result.error
    assert result.error.endswith("; the others were stopped")
    assert "2/here.csv" in [file.path for file in result.outputs]
    assert fleet.rows_by_place[2]["status"] == "failed"
    assert is_alone(1)


@pytest.mark.integration
def test_the_end_of_the_base_station_ends_the_run(fleet: Fleet):
    fleet.table = fleet.table.model_copy(update={"fleet": {**fleet.table.fleet, "ada": RobotTable(host="ada", group="base")}})
    [result] = fleet.run(job(1, "0", "0", "1", "sleep", "2", "sleep", robots=2, base=True))
    assert (result.exit_code, result.error) == (0, None)
    assert result.robots == {0: "ada", 1: "bob", 2: "cy"}
    assert fleet.rows_by_place[1]["reason"] == "the run is over"


@pytest.mark.integration
def test_a_clock_of_this_machine_that_is_set_during_a_measurement_delays_no_start(
    fleet: Fleet, monkeypatch: pytest.MonkeyPatch
):
    real, ask, step = time.time_ns, AgentLink.ask, [0]
    monkeypatch.setattr(time, "time_ns", lambda: real() + step[0])

    def set_before_an_answer(agent: AgentLink, do: str, *words: Any, **fields: Any) -> Any:
        if do == "clock" and agent.name == "bob":
            step[0] = -20 * 10**9
        return ask(agent, do, *words, **fields)

    monkeypatch.setattr(AgentLink, "ask", set_before_an_answer)
    fleet.run(job(1, robots=2))
    assert fleet.rows_by_place.keys() == {1, 2}
    for row in fleet.rows_by_place.values():
        assert abs(row["offset_start_ns"]) < 10e9
        assert row["start_skew_ns"] < 10e9
        assert "the wall clock of this machine has moved by -20 s" in row["clock_remark"]


@pytest.mark.integration
def test_a_run_fails_if_its_planned_end_has_to_kill_a_program(fleet: Fleet, tmp_path: Path):
    fleet.table = fleet.table.model_copy(update={"fleet": {**fleet.table.fleet, "ada": RobotTable(host="ada", group="base")}})
    (fleet.code / "go.py").write_text(
        "import os, signal, time\n"
        f"deaf, place = {str(tmp_path / 'deaf')!r}, os.environ['SIERRA_ROBOT']\n"
        "if place == '1':\n"
        "    signal.signal(signal.SIGTERM, signal.SIG_IGN)\n"
        "    open(deaf, 'w').close()\n"
        "while place != '0' or not os.path.exists(deaf):\n"
        "    time.sleep(0.01)\n"
    )
    [result] = fleet.run(job(1, robots=2, base=True))
    killed = "was killed 0.3 s after the stop, so that its files may be cut; raise grace in [runners.robots]"
    assert result.error == f"bob {killed}"
    assert fleet.rows_by_place[1]["reason"] == f"the run is over; {killed}"
    assert fleet.rows_by_place[2]["reason"] == "the run is over"


@pytest.mark.integration
def test_programs_get_the_known_addresses_of_all_robots_of_their_run(fleet: Fleet):
    own = {"ada": RobotTable(host="ada", group="base", address="10.0.0.1"), "bob": RobotTable(host="bob", address="10.0.0.2")}
    fleet.table = fleet.table.model_copy(update={"fleet": {**fleet.table.fleet, **own}})
    (fleet.code / "go.py").write_text(
        "import os, time\n"
        "print(*(f'{name}={value}' for name, value in sorted(os.environ.items()) if 'SIERRA_ADDRESS' in name), flush=True)\n"
        "time.sleep(1 if os.environ['SIERRA_ROBOT'] == '0' else 0)  # the end of the base station's program stops the others"
    )
    [result] = fleet.run(job(1, robots=2, base=True))
    both = "SIERRA_ADDRESS_0=10.0.0.1 SIERRA_ADDRESS_1=10.0.0.2\n"
    assert Path(result.directory, "stdout").read_text() == (
        f"==> ada <==\nSIERRA_ADDRESS=10.0.0.1 {both}==> bob <==\nSIERRA_ADDRESS=10.0.0.2 {both}==> cy <==\n{both}"
    )


@pytest.mark.integration
@pytest.mark.parametrize("declared", [None, "10.0.2.15"])
def test_robots_that_have_the_same_address_in_their_networks_are_refused(fleet: Fleet, declared: str | None):
    for name in ("ada", "cy"):
        fleet.links[name].variables["SSH_CONNECTION"] = "10.0.2.2 40000 10.0.2.15 22"
    own = {"cy": RobotTable(host="cy", address=declared)}
    fleet.table = fleet.table.model_copy(update={"fleet": {**fleet.table.fleet, **own}})
    with pytest.raises(
        Missing, match=r"^ada and cy have the same address 10\.0\.2\.15; give each an address by which .*"
    ) as raised:
        fleet.run(job(1))
    assert "\n" not in str(raised.value)
    assert not fleet.begun()
    assert not any(list(link.home.rglob("runs/*")) for link in fleet.links.values()), "nothing is armed"


NEPAL = "NPT-5:45"
"""A value of TZ that needs no database of time zones."""
CY_IN_NEPAL = f'case "$HOME" in */cy) export TZ={NEPAL};; esac'


@pytest.mark.parametrize(
    ("logins", "of_fleet", "own", "setup", "refused"),
    [
        ({"cy": NEPAL}, {}, {}, None, r"UTC\+00:00\) and cy \(.*, UTC\+05:45"),
        ({}, {}, {"cy": NEPAL}, None, r"UTC\+00:00\) and cy \(NPT-5:45, UTC\+05:45"),
        (
            {},
            {},
            {},
            f'[ "$HOME" != "${{HOME%cy}}" ] && export TZ={NEPAL}; true',
            r"UTC\+00:00\) and cy \(NPT-5:45, UTC\+05:45",
        ),
        ({"cy": NEPAL}, {"TZ": "UTC"}, {}, None, None),
        ({}, {"TZ": "UTC"}, {"cy": NEPAL}, None, None),
    ],
)
@pytest.mark.integration
def test_robots_with_different_time_zones_are_refused_unless_all_zones_are_declared(
    fleet: Fleet, logins: dict[str, str], of_fleet: dict[str, str], own: dict[str, str], setup: str | None, refused: str | None
):
    for name in NAMES:
        fleet.links[name].variables["TZ"] = logins.get(name, "UTC0")
    robots = {name: RobotTable(host=name, variables={"TZ": own[name]} if name in own else {}) for name in NAMES}
    fleet.table = fleet.table.model_copy(update={"fleet": robots, "variables": of_fleet, "setup": setup})
    if refused is None:
        assert [(one.exit_code, one.error) for one in fleet.run(job(1))] == [(0, None)]
        return
    remedy = r'declare variables = \{ TZ = "UTC" \} in \[runners.robots\]$'
    with pytest.raises(
        Missing, match=rf"^ada \(.*, {refused}\) have different time zones, and local times on them differ; {remedy}"
    ) as raised:
        fleet.run(job(1))
    assert "\n" not in str(raised.value)
    assert not fleet.begun()
    assert not any(list(link.home.rglob("runs/*")) for link in fleet.links.values()), "nothing is armed"


@pytest.mark.integration
def test_a_robot_without_power_stops_the_others_and_what_was_measured_is_kept(fleet: Fleet):
    soon_over(fleet)
    runner = fleet.submit(job(1, "1", "sleep", "2", "sleep", "3", "sleep"))
    fleet.all_begun()
    fleet.links["bob"].kill()
    [result] = fleet.follow(runner)
    assert result.error == "bob was lost: its agent has ended; its outputs are missing; the others were stopped"
    assert [file.path for file in result.outputs] == ["1/here.csv", "3/here.csv"]
    assert fleet.rows_by_place[2]["status"] == "lost"
    until(lambda: is_alone(1), "all processes are gone")

    fleet.links["bob"].off = False
    [again] = fleet.run(job(2))
    assert again.error is None


@pytest.mark.integration
def test_a_robot_out_of_reach_stops_by_its_lease(fleet: Fleet):
    soon_over(fleet)
    runner = fleet.submit(job(1, "1", "sleep", "2", "sleep", "3", "sleep"))
    fleet.all_begun()
    for link in fleet.links.values():
        (link.home / "stopped").unlink()
    fleet.links["cy"].stall()
    until(lambda: list(fleet.links["cy"].home.rglob("ended.json")), "it has stopped by itself")
    assert list(fleet.links["cy"].home.rglob("stopped"))
    until(lambda: list(fleet.links["ada"].home.rglob("stopped")), "it counts as lost, and the others are stopped")
    fleet.links["cy"].stall(stalled=False)
    [result] = fleet.follow(runner)
    assert result.error
    assert "cy was lost: no answer for " in result.error
    assert "3/here.csv" in [file.path for file in result.outputs]
    assert "cy does not answer; its run goes on for 3 s at most, its lease" in fleet.notes
    assert is_alone(1)


@pytest.mark.integration
def test_stopping_ends_all_robots(fleet: Fleet):
    runner = fleet.submit(job(1, "1", "sleep", "2", "sleep", "3", "sleep"), job(2))
    fleet.all_begun()
    runner.stop()
    [result] = fleet.follow(runner)
    assert result.stopped == "interrupted"
    assert is_alone(1)


@pytest.mark.integration
def test_two_drivers_cannot_use_one_robot(fleet: Fleet, tmp_path: Path):
    first = fleet.submit(job(1, "1", "sleep", "2", "sleep", "3", "sleep"))
    fleet.all_begun()
    other = Fleet(tmp_path, {name: LocalLink(name, one.home, one.lock) for name, one in fleet.links.items()})
    with pytest.raises(Missing, match=r"^\w+: in use by \w+ on .* \(session session\d\)$"):
        other.run(job(2))
    first.stop()
    assert [one.stopped for one in fleet.follow(first)] == ["interrupted"]


def test_two_names_of_one_host_are_refused_at_once(tmp_path: Path):
    ada, bob = (LocalLink(name, tmp_path / name) for name in NAMES[:2])
    fleet = Fleet(
        tmp_path, {"ada": ada, "bob": bob, "alias": LocalLink("alias", tmp_path / "alias", ada.lock)}, lease=PATIENCE_S
    )
    began = time.monotonic()
    with pytest.raises(Missing, match=r"^(ada: is the same host as alias|alias: is the same host as ada); each robot needs"):
        fleet.run(job(1))
    assert time.monotonic() - began < PATIENCE_S
    assert not fleet.begun()


def hold(fleet: Fleet) -> Robots:
    """Return a runner that has prepared a run and holds it back."""
    runner = Robots(1, fleet.table, fleet.make_link)
    runner.hold()
    fleet.start(runner, job(1))
    until(lambda: fleet.take(runner).ready, "all robots are ready")
    return runner


@pytest.mark.nightly
def test_a_run_that_is_held_back_begins_soon_after_the_word(fleet: Fleet):
    soon_over(fleet)
    runner = hold(fleet)
    time.sleep(fleet.table.lease + 0.2)
    assert not fleet.begun()
    said = time.time()
    runner.begin()
    [result] = fleet.follow(runner)
    assert result.error is None
    assert 0 < min(row["started"].timestamp() for row in fleet.rows_by_place.values()) - said < 2.0


@pytest.mark.integration
def test_a_start_that_a_robot_does_not_confirm_in_time_is_tried_again(fleet: Fleet, monkeypatch: pytest.MonkeyPatch):
    fleet.table = fleet.table.model_copy(update={"lease": 30.0, "clock_error": 0.2})
    send, starts = LocalChannel.send, 0

    def slow(channel: LocalChannel, line: str) -> None:
        nonlocal starts
        if '"do":"at"' in line and channel in fleet.links["bob"].channels:
            starts += 1
            time.sleep(3.0 if starts == 1 else 0.0)  # later than any start with this limit on the error of clocks
        send(channel, line)

    monkeypatch.setattr(LocalChannel, "send", slow)
    assert [(one.exit_code, one.error) for one in fleet.run(job(1))] == [(0, None)]
    assert starts > 1
    assert sorted(row["place"] for table, row in fleet.rows if table == "robots") == [1, 2, 3]


@pytest.mark.integration
def test_a_run_that_is_held_back_and_stopped_leaves_nothing(fleet: Fleet):
    fleet.table = fleet.table.model_copy(update={"lease": PATIENCE_S})
    runner = hold(fleet)
    runner.stop()
    assert fleet.follow(runner) == []
    assert fleet.rows == []
    assert all(list((link.home / ".cache/sierra-robot/runs").iterdir()) == [] for link in fleet.links.values())
    until(lambda: is_alone(1), "all are disarmed")


@pytest.mark.parametrize("fault", [LocalLink.kill, pytest.param(LocalLink.stall, marks=pytest.mark.integration)])
def test_a_robot_that_is_lost_while_a_run_is_held_back_is_told_at_once(fleet: Fleet, fault: Callable[[LocalLink], None]):
    soon_over(fleet)
    runner = hold(fleet)
    fault(fleet.links["bob"])
    with pytest.raises(Missing, match=r"^bob: was ready, but cannot start any more: (its agent has ended|no answer for )"):
        fleet.follow(runner)
    assert not fleet.begun()
    until(lambda: is_alone(1), "all are disarmed")


@pytest.mark.parametrize(
    ("made", "said"),
    [
        (
            job(1, robots=5),
            "a run needs 5 robots of the group 'robot', but the fleet has 3; runs of 1 to 3 robots are possible",
        ),
        (job(1, base=True), 'a run needs a base station, but the fleet has none; give a host group = "base"'),
    ],
)
def test_a_run_that_the_fleet_cannot_execute_is_refused(fleet: Fleet, made: Job, said: str):
    with pytest.raises(ConfigError, match=said):
        fleet.submit(made)
