"""Supervised trials at a terminal: prompts, any key stops, and Ctrl-C at any prompt keeps what was measured."""

from __future__ import annotations

import contextlib
import re
import signal
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

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
from sierra.extensions.trials.terminal import Person
from sierra.extensions.trials.table import Trials
from sierra.extensions.trials.supervisor import Ended, Trial
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
        assert ", heading 90 degrees\r\n" in shown
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
        assert "\nwithout a pose: 0 (tracker), 2 (tb2)\r\n" in terminal.answer(GO)
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
    inputs = projects.quick(root, "run", "population_size=1", "--operator", "Ann", "--inputs", "inputs")
    assert (inputs.returncode, inputs.stderr) == (2, "sierra: --inputs executes nothing; leave out --operator\n")
