"""Files that go to hosts with their paths there, and result logs that come back."""

from __future__ import annotations

from pathlib import Path

import pytest

from sierra.errors import Damaged
from sierra.extensions.lab.carried_files import Paths, ResultLogs, index_of
from sierra.store.layout import SessionPaths
from sierra.worker.result_log import line_of

PATHS = Paths({"/p/.sierra": "/h/lab", "/p/.sierra/work/ab": "/h/lab/sessions/ab", "/p/.sierra/work/ab/code": "/h/lab/code/1"})


@pytest.mark.parametrize(
    ("here", "there"),
    [
        ("/p/.sierra/work/ab/code/sim.py", "/h/lab/code/1/sim.py"),
        ("/p/.sierra/work/ab/code:/usr/bin", "/h/lab/code/1:/usr/bin"),
        ("--code=/p/.sierra/work/ab/code", "--code=/h/lab/code/1"),
        ("/p/.sierra/work/ab/worker.pyz", "/h/lab/sessions/ab/worker.pyz"),
        ("/p/.sierra/work/ab/code-2/sim.py", "/h/lab/sessions/ab/code-2/sim.py"),
        ("/p/.sierra2/x", "/p/.sierra2/x"),
        ("/other/p/.sierra", "/other/p/.sierra"),
    ],
)
def test_paths_of_this_machine_become_those_of_the_host(here: str, there: str) -> None:
    assert PATHS.there({"argv": [here], "environment": {"A": here}}) == {"argv": [there], "environment": {"A": there}}


def test_contents_of_files_stay_as_they_are() -> None:
    files = {"experiment.xml": "/p/.sierra"}
    assert PATHS.there({"files": files, "limits": {"wall_s": 1.5}, "observe": None}) == {
        "files": files,
        "limits": {"wall_s": 1.5},
        "observe": None,
    }


@pytest.mark.parametrize("name", ["../1.a.pack", "1.a.pack/..", "x.a.pack", "1.pack", "1.a.pack\n", "/1.a.pack", None, 7])
def test_a_host_cannot_choose_where_its_results_are_written(name: object) -> None:
    with pytest.raises(Damaged, match="which is no result log"):
        index_of({"event": "log", "name": name})


@pytest.fixture
def logs(tmp_path: Path) -> ResultLogs:
    (tmp_path / "results").mkdir()
    return ResultLogs(SessionPaths(tmp_path))


def test_a_result_log_grows_by_what_comes(logs: ResultLogs, tmp_path: Path) -> None:
    logs.add("3.a.pack", 0, b"first")
    logs.add("3.a.pack", 5, b" second")
    assert (tmp_path / "results" / "3.a.pack").read_bytes() == b"first second"
    logs.cut("3.a.pack", 5)
    assert logs.have() == {"3.a.pack": 5}
    assert (tmp_path / "results" / "3.a.pack").read_bytes() == b"first"


def test_a_part_of_another_place_is_refused(logs: ResultLogs) -> None:
    logs.add("3.a.pack", 0, b"first")
    with pytest.raises(Damaged, match="5 bytes come for byte 0, and not for 5"):
        logs.add("3.a.pack", 0, b"first")


def test_what_a_killed_process_has_left_incomplete_is_fetched_again(logs: ResultLogs, tmp_path: Path) -> None:
    complete = line_of({"event": "finished", "time": 1.0})
    log = tmp_path / "results" / "3.a.pack"
    log.write_bytes(complete + complete[:-5])
    assert logs.have() == {"3.a.pack": len(complete)}
    assert log.read_bytes() == complete
