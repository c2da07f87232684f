"""Standard output is an output like any other: it makes tables, belongs to the result, and is replayed and packed."""

from __future__ import annotations

import dataclasses
import errno
import json
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from sierra.config.output_tables import Output
from sierra.errors import Missing
from sierra.execution import unread_files
from sierra.ingest.standard_output import NO_FILE, added
from sierra.model import Result
from tests.projects import quick, sql

PROGRAM = """\
import random, sys

size, seed = (int(sys.argv[sys.argv.index(name) + 1]) for name in ("--robots", "--seed"))
draw = random.Random(seed)
print("Starting the simulation ...")
for step in range(5):
    print(f"step={step} score={draw.random() * size:.3f}")
print()
print(f"RESULT coverage={draw.random() * size:.3f} collisions={draw.randint(0, 9)}")
"""
KEYS = """\
command = "python3 sim.py {arguments} --seed {seed}"
runs = 3
[variables]
population_size = { argument = "--robots {value}" }
[package]
title = "x"
authors = [{ name = "A B" }]
license = "MIT"
"""
STEPS = """\
[outputs.steps]
file = "stdout"
lines = 'step=(?P<step>\\d+) score=(?P<score>\\S+)'
"""
ENDS = """\
[outputs.ends]
file = "stdout"
lines = 'coverage=(?P<coverage>\\S+) collisions=(?P<collisions>\\d+)'
"""
ASK = ("run", "population_size=1,2", "--no-figures")
NOTE = "note: 6 lines of stdout in 6 runs are in no table, because no lines of [outputs] match: 'Starting the simulation ...'"


def made(root: Path, outputs: str, program: str = PROGRAM) -> Path:
    root.mkdir(parents=True, exist_ok=True)
    (root / "sim.py").write_text(program)
    (root / "sierra.toml").write_text(KEYS + outputs)
    return root


def asked(root: Path, code: int = 0, *words: str) -> subprocess.CompletedProcess[str]:
    ended = quick(root, *(words or ASK))
    assert ended.returncode == code, ended.stdout + ended.stderr
    return ended


def is_sound(root: Path) -> None:
    asked(root, 0, "fsck")


def reasons(root: Path) -> list[str]:
    return [row["reason"] for row in sql(root, "SELECT DISTINCT reason FROM executions WHERE reason IS NOT NULL ORDER BY ALL")]


def test_each_kind_of_line_is_a_table_and_others_are_noted_once(tmp_path: Path) -> None:
    root = made(tmp_path, STEPS + ENDS)
    told = asked(root)
    assert told.stderr.count("no table") == 1
    assert NOTE in told.stderr
    tables = "SELECT output, path, count(*) AS runs, min(rows) AS rows, min(counted_rows) AS counted FROM artifacts"
    assert sql(root, f"{tables} WHERE kind = 'table' GROUP BY ALL ORDER BY ALL") == [
        {"output": "ends", "path": "stdout", "runs": 6, "rows": 1, "counted": 1},
        {"output": "steps", "path": "stdout", "runs": 6, "rows": 5, "counted": 5},
    ]
    assert "table ends from stdout (lines, declared): 1 row" in asked(root, 0, "outputs").stdout
    types = "SELECT DISTINCT typeof(step) AS a, typeof(score) AS b FROM steps"
    assert sql(root, types) == [{"a": "BIGINT", "b": "DOUBLE"}]
    is_sound(root)


@pytest.mark.integration
@pytest.mark.parametrize(
    ("keys", "program", "rows"),
    [
        ('format = "csv"\ncomment = "#"\ndelimiter = ";"', "print('# made', 'a;b', '1;2', '3;4', sep='\\n')", [(1, 2), (3, 4)]),
        ('format = "jsonl"', 'print(\'{"a": 1, "b": 2}\')', [(1, 2)]),
        ('format = "json"', 'print(\'[{"a": 1, "b": 2}]\')', [(1, 2)]),
    ],
    ids=["csv", "jsonl", "json"],
)
def test_standard_output_is_read_in_each_format(tmp_path: Path, keys: str, program: str, rows: list[tuple[int, int]]) -> None:
    root = made(tmp_path, f'[outputs.t]\nfile = "stdout"\n{keys}\n', program)
    asked(root)
    assert sql(root, "SELECT DISTINCT a, b FROM t ORDER BY ALL") == [{"a": a, "b": b} for a, b in rows]


@pytest.mark.integration
@pytest.mark.parametrize(
    ("program", "reason"),
    [
        ("", "printed nothing on standard output (output 'steps')"),
        ("print('finished')", "stdout: no line matches "),
        (PROGRAM + "open('stdout', 'w').write('mine')", "wrote a file or folder 'stdout', but [outputs] has file = \"stdout\""),
        (PROGRAM + "import os; os.mkdir('stdout'); open('stdout/a', 'w')", "wrote a file or folder 'stdout'"),
        (PROGRAM + "import os; os.remove('../stdout'); os.symlink('/etc/passwd', '../stdout')", "is no file that can be read"),
        (PROGRAM + "print('step=7 score=\\x1b[1m2')", "stdout: line 9: the column 'score' has control characters: '\\x1b[1m2'"),
        (PROGRAM + "print('step=7 score=', end='') if seed % 2 == 0 else 0", "the last line is truncated"),
    ],
    ids=["nothing", "no match", "own file", "own folder", "link", "colours", "cut"],
)
def test_run_without_sound_rows_on_standard_output_fails(tmp_path: Path, program: str, reason: str) -> None:
    root = made(tmp_path, STEPS, program)
    asked(root, 1)
    [found] = reasons(root)
    assert reason in found
    is_sound(root)


@pytest.mark.integration
@pytest.mark.parametrize("program", ["", "print('finished')", PROGRAM.replace('print(f"RESULT', 'seed % 2 and print(f"RESULT')])
def test_optional_lines_may_lack(tmp_path: Path, program: str) -> None:
    root = made(tmp_path, (STEPS if "step" in program else "") + f"{ENDS}required = false\n", program)
    asked(root)
    if program == "print('finished')":
        assert "no line matches lines in [outputs.ends]" in asked(root, 0, "outputs").stdout
    assert (reasons(root), len(sql(root, "SELECT * FROM artifacts WHERE output = 'ends' AND rows = 0"))) == ([], 0)
    is_sound(root)


@pytest.mark.integration
def test_changed_lines_are_read_from_what_is_recorded(tmp_path: Path) -> None:
    root = made(tmp_path, "")
    asked(root)
    without = "[success]\nexit_status = [0, 3]\n"
    for outputs, tables in ((STEPS + ENDS, ["ends", "steps"]), (ENDS, ["ends"]), (without, []), (STEPS, ["steps"])):
        made(root, outputs)
        answer = json.loads(asked(root, 0, *ASK, "--json").stdout)
        assert answer["executed"] == 0
        assert [row["output"] for row in sql(root, "SELECT DISTINCT output FROM artifacts WHERE rows > 0 ORDER BY 1")] == tables
        is_sound(root)
    assert sql(root, "SELECT count(*) AS rows FROM steps") == [{"rows": 30}]
    made(root, STEPS.replace("score=", "nothing="))
    asked(root, 1)


@pytest.mark.integration
def test_file_of_the_name_is_never_taken_for_what_a_run_printed(tmp_path: Path) -> None:
    root = made(tmp_path, "", PROGRAM + "open('stdout', 'w').write('step=1 score=1\\n')\n")
    asked(root)
    made(root, STEPS, (root / "sim.py").read_text())
    assert json.loads(asked(root, 1, *ASK, "--json").stdout)["executed"] == 6
    assert "wrote a file or folder 'stdout'" in reasons(root)[0]


@pytest.mark.integration
def test_replay_compares_the_tables_and_not_the_other_lines(tmp_path: Path) -> None:
    clock = "import time\nprint('took', time.time())\n"
    root = made(tmp_path / "same", STEPS + ENDS, PROGRAM + clock)
    asked(root)
    [batch] = [row["batch"] for row in sql(root, "SELECT batch FROM batches")]
    assert "6 equal" in asked(root, 0, "replay", batch).stdout
    other = made(tmp_path / "other", STEPS + ENDS, PROGRAM + "import time\nprint('step=9 score=', time.time(), sep='')\n")
    asked(other)
    [batch] = [row["batch"] for row in sql(other, "SELECT batch FROM batches")]
    told = asked(other, 1, "replay", batch).stdout
    assert "6 different" in told
    made(other, f"{STEPS}tolerance = {{ score = {{ abs = 1e9 }} }}\n{ENDS}")
    assert "6 different" not in quick(other, "replay", batch).stdout


@pytest.mark.integration
def test_package_executes_and_compares_standard_output_without_sierra(tmp_path: Path) -> None:
    root = made(tmp_path / "p", STEPS + ENDS)
    asked(root)
    [batch] = [row["batch"] for row in sql(root, "SELECT batch FROM batches")]
    asked(root, 0, "package", batch, "-o", str(tmp_path / "x.zip"), "--yes")
    with zipfile.ZipFile(tmp_path / "x.zip") as file:
        file.extractall(tmp_path / "x")
    shutil.rmtree(root)
    words = [sys.executable, "reproduce.py", "--execute", "--level=2", "--yes"]
    ended = subprocess.run(words, cwd=tmp_path / "x", capture_output=True, text=True, check=False)
    assert "6 identical" in ended.stdout, ended.stdout + ended.stderr


def replayed(root: Path) -> str:
    [batch] = [row["batch"] for row in sql(root, "SELECT batch FROM batches")]
    return asked(root, 0, "replay", batch).stdout


def executed(root: Path, outputs: str) -> int:
    made(root, outputs, (root / "sim.py").read_text())
    return int(json.loads(asked(root, 0, *ASK, "--json").stdout)["executed"])


@pytest.mark.integration
def test_output_may_have_a_name_as_that_of_accepted_ends(tmp_path: Path) -> None:
    root = made(tmp_path, ENDS.replace("ends", "ends_accepted"))
    asked(root)
    assert sql(root, "SELECT count(*) AS rows FROM ends_accepted") == [{"rows": 6}]
    lacking = ENDS.replace("ends", "ends_accepted").replace("coverage=", "nothing=")
    made(root, f"{lacking}{ENDS}required = false\n")
    asked(root, 1)
    assert any("(lines in [outputs.ends_accepted]" in reason for reason in reasons(root))


@pytest.mark.integration
def test_standard_output_that_is_no_output_any_more_is_no_file(tmp_path: Path) -> None:
    root = made(tmp_path, STEPS, PROGRAM + "open('my stdout', 'w').write('x')\n")
    asked(root)
    files = "SELECT DISTINCT path FROM artifacts WHERE kind <> 'log' ORDER BY ALL"
    for outputs in ("", '[outputs.a]\nfile = "std*"\nformat = "csv"\nrequired = false\n', "[success]\nexit_status = [0, 3]\n"):
        assert executed(root, outputs) == 0
        assert sql(root, files) == [{"path": "my stdout"}]
        is_sound(root)
    assert "6 identical" in replayed(root)


@pytest.mark.integration
def test_file_whose_name_ends_with_stdout_belongs_to_the_result_also_later(tmp_path: Path) -> None:
    root = made(tmp_path, "", PROGRAM + "open('my stdout', 'w').write('x')\n")
    asked(root)
    assert executed(root, STEPS) == 0
    is_sound(root)


@pytest.mark.integration
def test_run_is_executed_again_for_a_file_of_which_only_parts_are_kept(tmp_path: Path) -> None:
    root = made(tmp_path, "", "print('x' * (2 << 20))")
    asked(root)
    assert executed(root, '[outputs.log]\nfile = "stdout"\nformat = "file"\n') == 6
    assert sql(root, "SELECT DISTINCT size FROM artifacts WHERE kind = 'file'") == [{"size": (2 << 20) + 1}]
    is_sound(root)


@pytest.mark.integration
@pytest.mark.parametrize(
    ("program", "found"),
    [("open('a', 'w').write('x')", "6 identical"), ("import time; print('time', time.time())", "6 equal")],
    ids=["nothing", "time"],
)
def test_replay_agrees_on_optional_lines_that_lack(tmp_path: Path, program: str, found: str) -> None:
    root = made(tmp_path, "", program)
    asked(root)
    assert executed(root, f"{ENDS}required = false\n") == 0
    assert found in replayed(root)
    is_sound(root)


@pytest.mark.parametrize(
    ("printed", "why"),
    [
        ("v=1 v=2\n", "it matches lines in [outputs.v], but this made no rows"),
        ("end\n", "no line matches lines in [outputs.v]"),
    ],
)
def test_reason_for_a_file_without_rows_is_true(tmp_path: Path, printed: str, why: str) -> None:
    (tmp_path / "stdout").write_text(printed)
    outputs = {"v": Output.model_validate({"file": "stdout", "lines": r"v=(?P<v>\d)"})}
    [unread] = unread_files.of_run(["stdout"], outputs, [], tmp_path)
    assert unread.why.startswith(why)


BEGAN = Result("r", "e", "", 0.0, 1.0, 0, None, None, None, None, None, "", 0, ())
CSV = {"steps": Output.model_validate({"file": "stdout", "format": "csv"})}


def test_standard_output_that_cannot_be_read_fails_only_its_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    result = dataclasses.replace(BEGAN, directory=str(tmp_path))
    (tmp_path / "stdout").write_text("a\n1\n")
    (tmp_path / "stdout").chmod(0)
    assert [file.bytes for file in added(result, CSV).outputs] == [4]
    fail = errno.EACCES

    def describe(*_: object) -> None:
        raise OSError(fail, "refused")

    monkeypatch.setattr("sierra.ingest.standard_output.describe", describe)
    assert added(result, CSV).error == f"{NO_FILE}: refused"
    fail = errno.ENOSPC
    with pytest.raises(Missing):
        added(result, CSV)


def test_run_that_never_began_gets_no_standard_output(tmp_path: Path) -> None:
    result = dataclasses.replace(BEGAN, directory=str(tmp_path / "run"), exit_code=None, error="no such program")
    assert added(result, CSV) == result
    assert not list(tmp_path.iterdir())


def test_standard_output_of_a_copy_of_a_run_counts_by_its_digest() -> None:
    outputs = {"steps": Output.model_validate({"file": "stdout", "format": "csv"})}
    result = Result("r", "e", "", 0.0, 1.0, 0, None, None, None, None, None, "", 0, (), printed=(3, "ab" * 32))
    assert [(file.path, file.bytes, file.sha256) for file in added(result, outputs).outputs] == [("stdout", 3, "ab" * 32)]
    assert added(result, {}) == result
