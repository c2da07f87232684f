"""The worker observes runs with what it is told about its machine, which may have become wrong, and within a budget."""

from __future__ import annotations

import base64
import hashlib
import json
import os
import subprocess
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest

from sierra.util.hashing import sealed
from sierra.worker.layout import OBSERVED, TRACE
from sierra.worker.observations import MOST_LOST, Account
from sierra.worker.program import words
from tests.waiting import PATIENCE_S

LARGE = b"x" * (1 << 17)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    made = tmp_path / "runs"
    made.mkdir()
    return made


def job(name: str, script: str, **more: Any) -> dict[str, Any]:
    """Return a job that executes a shell script, and is observed."""
    environment = {"PATH": os.environ["PATH"], "SIERRA_EXECUTION": name}
    files = {"input": base64.b64encode(b"1").decode()}
    one = {"run": name, "execution": name, "argv": ["sh", "-c", script], "environment": environment, "files": files}
    return {**one, "limits": {}, "observe": {}, **more}


def execute(folder: Path, *jobs: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Execute jobs one after the other; return their ends."""
    lines = folder.parent / "jobs"
    lines.write_text("".join(json.dumps(one) + "\n" for one in (*jobs, {"end": True})))
    with lines.open() as stream:
        command = words(str(folder), "1")
        assert subprocess.run(command, stdin=stream, timeout=PATIENCE_S).returncode == 0
    events = map(json.loads, (folder / "journal.jsonl").read_text().splitlines())
    return [event for event in events if event["event"] == "end"]


def record(end: Mapping[str, Any]) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(Path(end["directory"], OBSERVED).read_text())
    return found


@pytest.mark.integration
@pytest.mark.parametrize("fake", ["exit 1", "exit 0", 'echo "$0: no" >&2; exit 1', "kill -9 $$", None])
def test_a_run_whose_remembered_tracer_does_not_work_is_executed_unobserved(
    folder: Path, fake: str | None, require: Callable[..., str]
) -> None:
    require("strace")
    tracer = folder.parent / "strace"
    if fake is not None:
        tracer.write_text(f"#!/bin/sh\n{fake}\n")
        tracer.chmod(0o755)
    helps = {"tracer": str(tracer), "digests": ""}
    script = "echo good >out"
    first, second = execute(folder, job("one", script, helps=helps), job("two", script, helps=helps))
    for end in (first, second):
        assert (end["exit_code"], end["error"]) == (0, None)
        assert [file["path"] for file in end["outputs"]] == ["out"]
        assert Path(end["directory"], "stderr").read_bytes() == b""
    assert record(first)["method"] == "none"
    assert record(first)["reason"]
    assert record(second)["method"] == "strace", "after that, the worker finds a tracer itself"
    assert not [path.name for path in folder.iterdir() if path.name.endswith(TRACE)]


def test_a_sampled_run_is_observed_only_within_the_budget(folder: Path, require: Callable[..., str]) -> None:
    require("strace")
    jobs = [job("first", "true"), job("none", "true", budget=0.0), job("ample", "true", budget=1e9)]
    assert [end["execution"] for end in execute(folder, *jobs) if end.get("observed")] == ["first", "ample"]


def test_the_first_run_of_an_experiment_is_observed_only_if_it_is_affordable(folder: Path, require: Callable[..., str]) -> None:
    require("strace")
    jobs = [job("unknown", "true", affordable=0.0), job("dear", "true", affordable=0.0), job("cheap", "true", affordable=1e9)]
    assert [end["execution"] for end in execute(folder, *jobs) if end.get("observed")] == ["unknown", "cheap"]


FAILING = {"failed": "exit 1", "endless": "exec sleep 9", "good": "true"}


@pytest.mark.integration
@pytest.mark.parametrize("how", ["failed", "endless"])
def test_another_run_of_the_experiment_is_observed_in_place_of_one_that_fails(
    folder: Path, require: Callable[..., str], how: str
) -> None:
    require("strace")
    first = job("first", FAILING[how], experiment=1, limits={"wall_s": 0.5})
    others = [(2, "other", "good"), (1, "second", how), (1, "third", "good"), (1, "fourth", "good")]
    later = [job(name, FAILING[what], experiment=number, limits={"wall_s": 0.5}) for number, name, what in others]
    for one in later:
        del one["observe"]
    assert [end["execution"] for end in execute(folder, first, *later) if end.get("observed")] == ["first", "second", "third"]


def test_runs_of_an_experiment_that_always_fails_are_not_all_observed(folder: Path, require: Callable[..., str]) -> None:
    require("strace")
    jobs = [job(str(number), "exit 1", experiment=1) for number in range(9)]
    for one in jobs[1:]:
        del one["observe"]
    assert len([end for end in execute(folder, *jobs) if end.get("observed")]) == 1 + MOST_LOST


def test_a_run_observed_in_place_of_another_must_be_affordable_and_the_sample_has_no_successors(
    folder: Path, require: Callable[..., str]
) -> None:
    require("strace")
    first = job("first", "exit 1", experiment=1, affordable=0.0)
    sampled = job("sampled", "exit 1", experiment=2, budget=1e9)
    others = [job(name, "true", experiment=number) for name, number in (("one", 1), ("two", 2))]
    for one in others:
        del one["observe"]
    ends = execute(folder, first, sampled, *others)
    assert [end["execution"] for end in ends if end.get("observed")] == ["first", "sampled"]


def test_the_account_allows_one_more_observation_only_if_it_fits() -> None:
    account = Account()
    assert account.allows(None)
    assert not account.allows(1.0), "no run has ended yet"
    account.add(100.0)
    account.charge(7.0, observations=7)
    account.charge(0.5, sampled=True)
    account.charge(0.5, observations=1, sampled=True)
    assert account.allows(0.02), "one observation of the sample, and one more, take 2 of 100 seconds"
    assert not account.allows(0.0199)
    assert account.allows(None)


def test_the_account_compares_an_observation_with_the_mean_run() -> None:
    account = Account()
    assert account.allows(times=0.0), "no run has ended yet"
    account.add(3.0)
    account.add(5.0)
    account.charge(2.0, observations=1)
    assert account.allows(times=0.5)
    assert not account.allows(times=0.499)


def test_hashes_that_are_known_are_used_as_long_as_the_file_is_unchanged(folder: Path, require: Callable[..., str]) -> None:
    require("strace")
    data, digests = folder.parent / "data", folder.parent / "digests"
    data.write_bytes(LARGE)
    status = data.stat()
    state = [status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns, status.st_ctime_ns]
    helps = {"tracer": None, "digests": str(digests)}
    for number, known in enumerate((state, [*state[:-1], 0])):
        digests.write_bytes(sealed(json.dumps({str(data): [*known, "0" * 64]}).encode()))
        place = folder / str(number)
        place.mkdir()
        [end] = execute(place, job("one", f"cat {data}", helps=helps))
        hashes = {sha256 for name, use, sha256, _ in record(end)["files"] if name == str(data) and use == "read"}
        assert hashes == {"0" * 64 if known == state else hashlib.sha256(LARGE).hexdigest()}


@pytest.mark.integration
@pytest.mark.parametrize("content", [b"", b"x\n{}", sealed(b"[]"), sealed(b"{"), sealed(b'{"/": 3}')])
def test_damaged_hashes_are_ignored(folder: Path, content: bytes, require: Callable[..., str]) -> None:
    require("strace")
    (folder.parent / "digests").write_bytes(content)
    [end] = execute(folder, job("one", "true", helps={"tracer": None, "digests": str(folder.parent / "digests")}))
    assert record(end)["reason"] is None


def test_new_hashes_of_large_files_are_reported_once(folder: Path, require: Callable[..., str]) -> None:
    require("strace")
    ends = execute(folder, job("one", "true"), job("two", "true"))
    library = next(path for path in record(ends[0])["digests"] if "/libc." in path)
    *state, sha256 = record(ends[0])["digests"][library]
    status = Path(library).stat()
    assert state == [status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns, status.st_ctime_ns]
    assert sha256 == hashlib.sha256(Path(library).read_bytes()).hexdigest()
    assert record(ends[1])["digests"] == {}
