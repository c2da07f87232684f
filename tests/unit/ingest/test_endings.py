"""The end of a run tells more than its status: errors that it printed, processes that still ran, a marker that was met."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from sierra.config.project_file import parse
from sierra.errors import ConfigError
from sierra.ingest.stderr import against, error_line
from tests.projects import CONFIG, SIMULATOR, make, quick, sql

TRACED = 'Traceback (most recent call last):\n  File "sim.py", line 5, in <module>\n    f()\n    ^^^\n'
BOOM = f"{TRACED}RuntimeError: GPU buffer overflow\n"
CRASHED = "terminate called after throwing an instance of 'std::runtime_error'\n  what():  no GPU\n"
QUERY = ("run", "population_size=1,2", "--runs", "3", "--no-figures")


@pytest.mark.parametrize(
    ("printed", "error"),
    [
        (BOOM, "RuntimeError: GPU buffer overflow"),
        (
            f"{TRACED}OutOfMemoryError: CUDA out of memory.\nTried 2 GiB\n\n",
            "OutOfMemoryError: CUDA out of memory.",
        ),
        (
            f"{TRACED}KeyError: 1\n\nDuring handling of the above exception, another exception occurred:\n\n{BOOM}",
            "RuntimeError: GPU buffer overflow",
        ),
        ("Exception in thread reader:\n" + BOOM, "RuntimeError: GPU buffer overflow"),
        ("[display] closed\n" + BOOM + "[display] Error: closed\n== after: tidy\n", "RuntimeError: GPU buffer overflow"),
        ("==> tb1 <==\n" + BOOM + "==> tb2 <==\nready\n", "RuntimeError: GPU buffer overflow"),
        (CRASHED, "terminate called after throwing an instance of 'std::runtime_error'"),
        (
            "sim.sh: line 3: 17 Segmentation fault (core dumped) ./sim\n",
            "sim.sh: line 3: 17 Segmentation fault (core dumped) ./sim",
        ),
        (
            "thread 'main' panicked at src/main.rs:2:5:\nno GPU\nnote: run with `RUST_BACKTRACE=1`\n",
            "thread 'main' panicked at src/main.rs:2:5:",
        ),
        (
            'Exception in thread "main" java.lang.Oops\njava.lang.IllegalStateException: no GPU\n\tat Sim.run(Sim.java:3)\n',
            "java.lang.IllegalStateException: no GPU",
        ),
        ("ready\nERROR: Lost atoms: original 4000 current 3987\n", "ERROR: Lost atoms: original 4000 current 3987"),
        ("\x1b[31m[ERROR] [1699.2]: no GPU\x1b[0m\n", "[ERROR] [1699.2]: no GPU"),
        ("2026-11-27 10:00:00,123 Fatal error: no GPU", "2026-11-27 10:00:00,123 Fatal error: no GPU"),
        ("Error in solve(a) : singular\nExecution halted\n", "Execution halted"),
        ("10 %\r50 %\rError: cut\r\n", "Error: cut"),
        ("ERROR: Lost atoms: original 40 current 39\nLast command: run 100\n", "ERROR: Lost atoms: original 40 current 39"),
        ("2024-05-01 10:00:00 [1,234ms] [Error] [kit] no GPU\n", "2024-05-01 10:00:00 [1,234ms] [Error] [kit] no GPU"),
        ("Error: caf\udce9 closed\n", "Error: caf\ufffd closed"),
    ],
)
def test_the_error_at_the_end_is_found(printed: str, error: str) -> None:
    assert error_line(printed.encode("utf-8", "surrogateescape")) == error


@pytest.mark.parametrize(
    "printed",
    [
        "",
        "ready\n",
        BOOM + "INFO: trying again\n" + "step\n" * 9,
        BOOM + "[INFO] trying again\n",
        BOOM + "2026-11-27 10:00:00 ready\n",
        "Exception ignored in: <function Window.__del__ at 0x7f>\n" + BOOM,
        "sim.py:3: UserWarning: Error bars are wide\n  plot()\n",
        "WARNING: error in the log of yesterday\n",
        "warning: no GPU\n",
        "libGL error: no driver\n",
        "Error: 0.0012\n",
        "error = 1e-05\n",
        "Error rate: 0.1\n",
        "ERROR RATE: 0.1 %\n",
        "Errors: 0\n",
        "Error: 0.5 m\n",
        "Error: none\n",
        "error (L2) at t=10: 0.01\n",
        "MeanSquaredError: 0.02\n",
        "Failed runs: 0\n",
        "no error\n",
        "ERROR: lost a packet, sent it again\nfinished\n",
        "0 errors, 2 warnings\n",
    ],
)
def test_what_is_no_error_at_the_end_is_not_taken_as_one(printed: str) -> None:
    assert error_line(printed.encode()) is None


def test_a_rule_on_standard_error_may_have_letters_that_are_not_ascii(tmp_path: Path) -> None:
    (tmp_path / "stderr").write_text("ready\nservice caf\u00e9\n")
    assert (
        against("caf[\u00e8\u00e9]$", str(tmp_path)) == "standard error must not have 'caf[\u00e8\u00e9]$': service caf\u00e9"
    )
    assert against("caf[\u00e8]", str(tmp_path)) is None


def prints(text: str, stream: str = "stderr") -> str:
    return SIMULATOR + f"\nprint({text!r}, end='', file=sys.{stream})\n"


@pytest.mark.integration
@pytest.mark.parametrize("stream", ["stderr", "stdout"])
def test_runs_that_end_with_a_traceback_are_counted_wherever_runs_are_shown(stream: str, tmp_path: Path) -> None:
    root = make(tmp_path / "p", simulator=prints(BOOM, stream))
    note = "6 of 6 runs were successful, but what they printed ends with an error: RuntimeError: GPU buffer overflow"
    done = quick(root, *QUERY)
    assert (done.returncode, done.stderr.count(note)) == (0, 1)
    assert ('(on standard output; marker = "stdout" and contains' in done.stderr) is (stream == "stdout")
    assert note not in quick(root, *QUERY).stderr  # nothing was executed
    batch = sql(root, "SELECT batch, run FROM batch_runs LIMIT 1")[0]
    assert note in quick(root, "show", batch["batch"]).stdout
    assert json.loads(quick(root, "show", batch["batch"], "--json").stdout)["notes"][0].startswith(note)
    assert quick(root, "report").returncode == 0
    assert any(note in re.sub(r"\s+", " ", page.read_text()) for page in root.rglob("*.html"))
    assert "1 of 1 run was successful, but what it printed ends with an error: RuntimeError" in quick(root, "try").stderr
    cure = 'stderr = "^RuntimeError:" in [success] makes such runs fail)'
    if stream == "stdout":
        return
    assert f"{note} ({cure}" in done.stderr
    (root / "sierra.toml").write_text(f'{CONFIG}[success]\nstderr = "^RuntimeError:"\n')
    failed = quick(root, *QUERY)
    assert (failed.returncode, "6 evaluated again" in failed.stdout) == (1, True)


@pytest.mark.integration
@pytest.mark.parametrize(("rule", "reason"), [("^Trace", "must not have '^Trace'"), ("empty", "should be empty")])
def test_runs_fail_by_what_they_must_not_print(rule: str, reason: str, tmp_path: Path) -> None:
    fails = f'[success]\nstderr = "{rule}"\n'
    simulator = prints(BOOM).replace("Traceback (most", "\\x1b[1mTraceback (most")
    root = make(tmp_path / "p", f"before = 'echo hi'\n{CONFIG}{fails}", simulator=simulator)
    failed = quick(root, *QUERY)
    assert failed.returncode == 1
    assert f"standard error {reason}: " in failed.stdout
    (root / "sierra.toml").write_text(f"before = 'echo hi'\n{CONFIG}")
    assert "6 evaluated again" in quick(root, *QUERY).stdout
    (root / "sierra.toml").write_text(f"before = 'echo hi'\n{CONFIG}{fails}")
    assert quick(root, *QUERY).returncode == 1


@pytest.mark.integration
def test_a_silent_run_succeeds_although_commands_are_executed_before_it(tmp_path: Path) -> None:
    root = make(tmp_path / "p", f'before = "true"\n{CONFIG}[success]\nstderr = "empty"\n')
    assert quick(root, *QUERY).returncode == 0


LAUNCHER = """\
python3 "$1" "$2" &
while [ ! -e swarm.csv ]; do sleep 0.02; done
"""
SLOW = SIMULATOR + "\nimport time\ntime.sleep(60)\n"


def launched(folder: Path, config: str = "") -> Path:
    command = re.sub("^command = .*", 'command = "sh {project}/launch.sh {project}/sim.py {input}"', CONFIG, flags=re.M)
    folder.mkdir(parents=True)
    (folder / "launch.sh").write_text(LAUNCHER)
    return make(folder, config + command, simulator=SLOW)


@pytest.mark.integration
@pytest.mark.parametrize("around", ["", 'after = "true"\n', 'before = "true"\n'])
def test_processes_that_still_ran_are_named(around: str, tmp_path: Path) -> None:
    root = launched(tmp_path / "p", around)
    said = "in 6 of 6 runs processes were still running when the command ended, and were ended: python3 sim.py"
    done = quick(root, *QUERY)
    assert (done.returncode, done.stderr.count(said)) == (0, 1)
    batch = sql(root, "SELECT batch FROM batches")[0]["batch"]
    assert said in quick(root, "show", batch).stdout
    config = (root / "sierra.toml").read_text()
    (root / "sierra.toml").write_text(config + '[success]\nleftovers = "fail"\n')
    failed = quick(root, *QUERY)
    assert failed.returncode == 1
    assert "processes were still running when the command ended: python3 sim.py" in failed.stdout


SERVICE = f"""\
before = "sh before.sh"
{CONFIG}
[services.helper]
command = "sh daemons.sh"
ready = {{ file = "{{run}}/ready" }}
[success]
leftovers = "fail"
"""
DAEMONS = 'touch "$SIERRA_RUN_DIR/ready"\nsetsid sh -c "while sleep 0.05; do setsid sleep 1 & done" &\nsleep 0.1\n'


@pytest.mark.integration
def test_processes_of_services_and_of_commands_before_the_run_are_not_named(tmp_path: Path) -> None:
    root = make(tmp_path / "p", SERVICE, simulator=SIMULATOR + "\nimport time\ntime.sleep(0.3)\n")
    (root / "daemons.sh").write_text(DAEMONS.replace("sleep 0.1", "sleep 100"))
    (root / "before.sh").write_text(DAEMONS)
    done = quick(root, *QUERY)
    assert (done.returncode, "still running" in done.stderr) == (0, False), done.stdout


@pytest.mark.integration
def test_processes_that_end_just_after_the_command_are_not_named(tmp_path: Path) -> None:
    root = make(tmp_path / "p", simulator=SIMULATOR + "\nimport subprocess\nsubprocess.Popen(['sleep', '0.02'])\n")
    assert "still running" not in quick(root, *QUERY).stderr


@pytest.mark.integration
def test_advice_on_runs_with_different_numbers_of_rows_begins_with_processes_that_were_ended(tmp_path: Path) -> None:
    root = launched(tmp_path / "p")
    rows = SLOW.replace("import sys", "import sys, os").replace("time.sleep(60)", "").replace("import time", "")
    (root / "sim.py").write_text(
        rows + "\nwith open('swarm.csv', 'a') as file:\n    print('9,1\\n' * (seed % 7), end='', file=file, flush=True)\n"
        "import time\nopen('ready', 'w').close()\ntime.sleep(60)\n"
    )
    (root / "launch.sh").write_text(LAUNCHER.replace("swarm.csv", "ready"))
    done = quick(root, *QUERY)
    text = done.stdout + done.stderr
    lines = [line for line in text.splitlines() if "ragged" in line]
    assert lines
    for line in lines:
        assert line.index("processes were still running") < line.index("ragged")


@pytest.mark.integration
@pytest.mark.parametrize("status", ["139", "-11"])
@pytest.mark.parametrize("shell", [False, True])
def test_an_end_by_a_signal_counts_by_either_spelling(status: str, shell: bool, tmp_path: Path) -> None:
    end = "sys.exit(139)" if shell else "os.kill(os.getpid(), 11)"
    config = f"after = 'true'\n{CONFIG}" if status == "139" else CONFIG
    root = make(tmp_path / "p", config, simulator=SIMULATOR + f"\nimport os\n{end}\n")
    assert quick(root, *QUERY).returncode == 1
    (root / "sierra.toml").write_text(f"{config}[success]\nexit_status = [0, {status}]\n")
    done = quick(root, *QUERY)
    assert done.returncode == 0, done.stdout
    again = "6 executed, 0 reused" if "after" in config else "0 executed"
    assert again in done.stdout
    assert quick(root, "replay", sql(root, "SELECT batch FROM batches LIMIT 1")[0]["batch"]).returncode == 0


def hangs(config: str = "") -> str:
    return f'{config}{CONFIG}[success]\nmarker = "stdout"\ncontains = "finished"\n[limits]\nafter_marker = 0.2\nwall = 50\n'


HANGS = SIMULATOR + "\nimport time\nprint('finished', flush=True)\ntime.sleep(60)\n"


@pytest.mark.integration
@pytest.mark.parametrize("around", ["", "after = 'true'\n"])
def test_a_run_that_hangs_after_its_marker_is_ended_and_counts(around: str, tmp_path: Path) -> None:
    root = make(tmp_path / "p", hangs(around), simulator=HANGS)
    assert quick(root, *QUERY).returncode == 0
    assert sql(root, "SELECT kind, text, count(*) AS n FROM endings GROUP BY ALL") == [
        {"kind": "after marker", "text": "0.2", "n": 6}
    ]
    assert sql(root, "SELECT max(wall_s) < 40 AS soon, count(*) AS n FROM executions WHERE status = 'ok'") == [
        {"soon": True, "n": 6}
    ]
    (root / "sierra.toml").write_text(hangs(around).replace("finished", "finish"))
    done = quick(root, *QUERY)
    assert "0 executed" in done.stdout
    assert "6 evaluated again" in done.stdout


@pytest.mark.integration
def test_a_run_that_hangs_before_its_marker_runs_to_its_limit(tmp_path: Path) -> None:
    config = hangs().replace('"stdout"\ncontains = "finished"', '"done.json"').replace("wall = 50", "wall = 1")
    root = make(tmp_path / "p", config, simulator=HANGS)
    done = quick(root, "run", "population_size=1", "--runs", "1", "--no-figures")
    assert done.returncode == 1
    assert "ran longer than its limit" in done.stdout
    (root / "sim.py").write_text(HANGS.replace("print('finished', flush=True)", "open('done.json', 'w').close()"))
    assert quick(root, "run", "population_size=1", "--runs", "1", "--no-figures").returncode == 0


@pytest.mark.parametrize(
    ("table", "reason"),
    [
        ({"success": {"exit_status": [0, 300]}}, "success.exit_status: 300 should be from 0 to 255, or from -64 to -1"),
        ({"success": {"exit_status": [-65]}}, "success.exit_status: -65 should be"),
        ({"limits": {"after_marker": 1}}, "limits.after_marker: give the marker in [success]"),
        (
            {"limits": {"after_marker": 1}, "success": {"marker": "stderr"}},
            "the text of stderr that shows the end",
        ),
        ({"limits": {"after_marker": -1}, "success": {"marker": "a"}}, "limits.after_marker"),
        ({"success": {"stderr": "("}}, "success.stderr"),
        ({"success": {"leftovers": "kill"}}, "success.leftovers"),
    ],
)
def test_impossible_conditions_are_refused(table: dict[str, object], reason: str) -> None:
    with pytest.raises(ConfigError) as caught:
        parse(table, "sierra.toml")
    assert reason in str(caught.value)
