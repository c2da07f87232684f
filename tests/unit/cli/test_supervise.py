"""Supervised trials at a terminal: prompts, any key stops, and Ctrl-C at any prompt keeps what was measured."""

from __future__ import annotations

import contextlib
import re
import signal
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from sierra.cli import pose_map
from sierra.model import Area, Pose
from tests import projects
from tests.terminals import Terminal
from tests.waiting import until

CONFIG = f"""observe = "none"
{projects.CONFIG}
[trials]
supervised = true
countdown = 0.3
reasons = ["wrong start", "a robot fell"]
poses = [[0, 0, 90], [2, 1]]
"""
ENDLESS = projects.SIMULATOR + "import time\nif count == 9:\n    time.sleep(600)\n"
TRIALS = """
SELECT operator, valid, t.reason, note, stopped, status FROM trials t JOIN executions e USING (execution) ORDER BY position
"""
ENDING = """
import sys, time
from pathlib import Path
from sierra.cli.supervise import Person
from sierra.config.trial_tables import Trials
from sierra.execution.supervised.supervisor import Ended, Trial
from sierra.model import Pose, Status
from sierra.runners.base import Beat

def wait(name, *arguments):
    while not Path(name).exists():
        attendant.ending(*arguments)
        time.sleep(0.01)

person, beats = Person(Trials(countdown=0), "Ann"), (Beat("tb2", 4.0, 79.0),)
trial = Trial("r", 0, {}, 1, 1, 0, 1, poses=(Pose(1, 1),), robots={0: "tracker", 1: "tb1", 2: "tb2"})
with person.attending(trial) as attendant:
    while attendant.decide(ready=True) is None:
        time.sleep(0.01)
    while not attendant.watch(1.0, beats) and not Path("lost").exists():
        time.sleep(0.01)
    print("note: tb2 does not answer", file=sys.stderr)
    wait("over", beats, None)
    wait("collected", beats, 3.0)
print(person.verdict(trial, Ended(Status.OK, None, 1.0, False)))
"""
"""A program in which a person attends to a trial whose robots are stopped and whose files are collected."""
GO, VALID, REASON, NOTE = "go, s: skip, a: abort > ", "i: no > ", "or text) > ", "note (Enter: none) > "


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return projects.make(tmp_path / "project", CONFIG, simulator=ENDLESS)


def supervise(root: Path, *words: str, size: int = 1, **environment: str) -> Terminal:
    argv = (str(projects.SIERRA), "run", f"population_size={size}", "--runs", "1", "--no-figures", *words)
    return Terminal(root, *argv, environment=environment)


def trials(root: Path) -> list[tuple[object, ...]]:
    return [tuple(row.values()) for row in projects.sql(root, TRIALS)]


@pytest.mark.integration
def test_a_person_starts_judges_and_repeats_trials(root: Path) -> None:
    with supervise(root) as terminal:
        before = terminal.mode()
        terminal.answer("operator (Enter: ", "Ann")
        shown = terminal.answer(GO)
        assert "trial 1 of 1: population_size=1, run 0\r\n" in shown
        assert "|1↑ " in shown
        assert "2: x 2 m, y 1 m\r\n" in shown
        terminal.answer(VALID, "i")
        terminal.answer(REASON, "7")
        terminal.answer(REASON, "2")
        terminal.answer(NOTE, "on its back")
        assert "run 0, try 2" in terminal.answer(GO)
        terminal.answer(VALID)
        terminal.answer(NOTE)
        assert terminal.end() == 0
        assert terminal.mode() == before
    assert trials(root) == [
        ("Ann", False, "a robot fell", "on its back", False, "invalid"),
        ("Ann", True, None, None, False, "ok"),
    ]
    assert projects.quick(root, "report", "--to", "../report.html").returncode == 0
    page = " ".join(re.sub("<[^>]*>", " ", (root.parent / "report.html").read_text()).split())
    assert "2 trials, of which 1 is not valid. The operator stopped 0." in page
    assert " 0 invalid " in page
    assert " Ann no a robot fell on its back " in page
    assert "Executions that did not succeed, and whose runs succeeded when they were executed again" in page


@pytest.mark.integration
def test_any_key_stops_a_trial_and_does_not_answer_the_next_prompt(root: Path) -> None:
    with supervise(root, "--operator", "Bob", size=9, TERM="dumb") as terminal:
        terminal.answer(GO)
        terminal.expect("any key: stop")
        until(lambda: any(root.glob(".sierra/work/*/*/output/swarm.csv")))
        terminal.type("\n\n\n")
        assert "stopped: was stopped by the operator" in terminal.answer("not valid, repeat it > ", "v")
        terminal.answer(NOTE, "too slow")
        assert terminal.end() == 1
        assert "\x1b" not in terminal.shown
        assert "\r" not in terminal.shown.replace("\r\n", "\n"), "this terminal cannot go back in a line"
    assert trials(root) == [("Bob", True, None, "too slow", True, "stopped")]


@pytest.mark.integration
def test_ctrl_c_at_every_prompt_keeps_what_was_measured_and_restores_the_terminal(root: Path) -> None:
    answers = {"operator": "Ann", GO: "", "any key: back": None, VALID: "i", REASON: "1", NOTE: ""}
    for last in range(len(answers)):
        with supervise(root) as terminal:
            before = terminal.mode()
            for prompt, answer in list(answers.items())[:last]:
                terminal.expect(prompt)
                if answer is not None:
                    terminal.type(f"{answer}\n")
            terminal.expect(list(answers)[last])
            terminal.type("\x03")
            assert terminal.end() == 130
            assert terminal.mode() == before
        kept = [("Ann", False, "nobody has judged it", None, None, "invalid")] * max(0, last - 2)
        assert trials(root) == kept


@contextlib.contextmanager
def collecting(folder: Path) -> Iterator[Terminal]:
    """Yield the terminal of a trial whose files are being collected, after keys were typed in vain while robots stopped."""
    with Terminal(folder, sys.executable, "-c", ENDING) as terminal:
        before = terminal.mode()
        assert "\nnot on the map: 0 (tracker), 2 (tb2)\r\n" in terminal.answer(GO)
        terminal.expect("1 s; any key: stop  tb2 4.0 s 79 %")
        (folder / "lost").touch()
        terminal.expect("\nnote: tb2 does not answer\r\n")
        terminal.expect("stopping  tb2")
        terminal.type("i\n")
        (folder / "over").touch()
        assert "any key" not in terminal.expect("collecting files, 3 s  tb2 4.0 s 79 %")
        yield terminal
        assert terminal.end() == 0
        assert terminal.mode() == before


@pytest.mark.integration
def test_lines_that_are_typed_while_files_are_collected_answer_the_prompts(tmp_path: Path) -> None:
    with collecting(tmp_path) as terminal:
        terminal.type("v\x7fi\n2\nit f")
        terminal.expect("collecting")
        (tmp_path / "collected").touch()
        assert "stopped" not in terminal.expect(f"{VALID}i\r\n")
        terminal.expect(f"{REASON}2\r\n")
        terminal.expect(f"{NOTE}it f")
        terminal.type("ell\n")
        terminal.expect("Verdict(valid=False, reason='hardware failure', note='it fell')")


@pytest.mark.integration
@pytest.mark.parametrize("keys", ["\n\n \n", "asdf\n\nv\n"])
def test_keys_that_may_have_been_meant_to_stop_do_not_judge_a_trial(tmp_path: Path, keys: str) -> None:
    with collecting(tmp_path) as terminal:
        terminal.type(keys)
        terminal.expect("collecting")
        (tmp_path / "collected").touch()
        terminal.expect(VALID)
        if keys.strip():
            terminal.expect("asdf\r\nvalid? ")
            terminal.expect(VALID)
        terminal.answer("", "i")
        terminal.answer(REASON, "1")
        terminal.answer(NOTE)
        terminal.expect("Verdict(valid=False, reason='wrong start', note=None)")


@pytest.mark.nightly
def test_a_key_in_the_countdown_leads_back_and_a_lost_terminal_ends_the_session(root: Path) -> None:
    (root / "sierra.toml").write_text(CONFIG.replace("0.3", "600"))
    with supervise(root, "--operator", "Ann") as terminal:
        terminal.answer(GO)
        terminal.expect("any key: back")
        terminal.type("x")
        terminal.expect("not started")
        terminal.expect(GO)
        terminal.process.send_signal(signal.SIGHUP)
        assert terminal.process.wait(60) == 130
    assert trials(root) == []


def test_without_a_terminal_prompts_are_an_error_at_once_and_yes_answers_them(root: Path) -> None:
    refused = projects.quick(root, "run", "population_size=1", "--runs", "1", "--no-figures")
    assert (refused.returncode, refused.stdout) == (3, "")
    assert refused.stderr == (
        "sierra: trials are supervised here ([trials]): run in a terminal, or answer all prompts with --yes\n"
    )
    assert not (root / ".sierra").exists()
    (root / "sierra.toml").write_text(projects.CONFIG)
    alone = projects.quick(root, "run", "population_size=1", "--operator", "Ann", "--no-figures")
    assert (alone.returncode, alone.stderr.partition(";")[0]) == (2, "sierra: --operator Ann: nobody supervises these runs")


def test_a_map_shows_robots_where_they_start() -> None:
    lines = pose_map.draw([Pose(0, 0, 90), Pose(4, 0, 180), Pose(4, 2), Pose(4, 2, 0)], plain=True)
    assert lines[0] == f"+{'-' * 48}+"
    assert lines[1].rstrip(" |").endswith("*"), "two robots have the same place"
    assert lines[-7].startswith("|1^ ")
    assert lines[-7].index("2<") == lines[1].index("*")
    assert lines[-5:] == [
        "x: 0 to 4 m (to the right), y: 0 to 2 m (up)",
        "  1: x 0 m, y 0 m, heading 90 degrees",
        "  2: x 4 m, y 0 m, heading 180 degrees",
        "  3: x 4 m, y 2 m",
        "  4: x 4 m, y 2 m, heading 0 degrees",
    ]
    assert len(pose_map.draw([Pose(1, 1)])) == 20, "one robot alone has room around it"


def test_maps_of_an_area_have_one_scale_and_the_list_names_the_robots() -> None:
    arena = Area((0, 4), (0, 3))
    first, second = (pose_map.draw(poses, arena, {1: "tb1"}) for poses in ([Pose(1, 1), Pose(2, 2)], [Pose(4, 3), Pose(0, 0)]))
    assert [line for line in first if line[0] not in " |"] == [line for line in second if line[0] not in " |"]
    assert first[-3] == "x: 0 to 4 m (to the right), y: 0 to 3 m (up)"
    assert first[-2:] == ["  1 (tb1): x 1 m, y 1 m", "  2: x 2 m, y 2 m"]
    rows = [row for row in range(1, 17) if first[row].strip("| ")]
    assert [(row, first[row].find(character)) for row, character in zip(rows, "21", strict=True)] == [(6, 21), (11, 11)]
    assert (second[1].index("1"), second[16].index("2")) == (41, 1)
    assert pose_map.draw([Pose(5, 1)], arena)[-2] == "x: 0 to 5 m (to the right), y: 0 to 3 m (up)", "nobody is left out"
    assert pose_map.draw([Pose(0.1, 0.1)], Area((0, 0.2), (0, 0.2)))[-2].startswith("x: 0 to 0.2 m"), "a small arena"
