"""Runs that write one file outside their folders and read it again have each other's data: they do not count."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from sierra.execution.execute_missing import Executor
from sierra.ingest import shared_use
from tests import projects
from tests.waiting import until

OK = "SELECT count(*) AS n FROM runs WHERE status = 'ok'"
REASON = "use at the same time; execute with --jobs 1, in a container, or pass {output}"
pytestmark = pytest.mark.integration


def assert_own(folder: Path) -> None:
    """Check that no run that counts has the rows of another one: each run writes its seed."""
    if projects.sql(folder, OK)[0]["n"]:
        assert projects.sql(folder, "SELECT * FROM swarm JOIN runs r USING (run) WHERE value <> r.seed") == []


@pytest.fixture
def execute(tmp_path: Path, require: Callable[..., str]) -> Callable[..., tuple[int, str]]:
    """Execute runs of a shell script, and return how many count, and what SIERRA has said. `$D` is a folder outside."""
    require("strace")
    outside = tmp_path / "outside"
    outside.mkdir()

    def execute(script: str, *, query: str = "population_size=1,2", runs: int = 5, jobs: int = 2) -> tuple[int, str]:
        folder = tmp_path / "project"
        if not folder.exists():
            config = projects.CONFIG.replace("python3 sim.py {input}", "sh sim.sh {seed} {input}").replace(
                "runs = 2", f"runs = {runs}"
            )
            projects.make(folder, config)
        (folder / "sim.sh").write_text(f"D={outside}\n{script}\n")
        done = projects.quick(folder, "run", query, "--jobs", str(jobs), "--no-figures")
        assert_own(folder)
        return projects.sql(folder, OK)[0]["n"], done.stdout + done.stderr

    return execute


TEMPFILE = (
    'import sys, tempfile; f = tempfile.NamedTemporaryFile("w+", dir=sys.argv[1]); f.write("tick,value\\n0," + sys.argv[2]); '
    'f.write("\\n"); f.flush(); open("swarm.csv", "w").write(open(f.name).read())'
)
WRITE = '{{ echo tick,value; echo "0,$1"; }} > {0}; sleep 0.05'
MANY = "d=$(mktemp -d $D/XXXXXX); for i in $(seq 1001); do echo x > $D/$i.$$; done; cat $D/*.$$ > $d/x; rm $D/*.$$"


@pytest.mark.parametrize(
    "script",
    [
        f"{WRITE.format('$D/out.csv')}; cp $D/out.csv swarm.csv",
        f"{WRITE.format('$D/out.csv')}; mv $D/out.csv swarm.csv || cp $D/x swarm.csv",
        f"rm -f $D/out.csv; {WRITE.format('$D/out.csv')}; ln $D/out.csv swarm.csv",
        f"mkdir -p $D/work; {WRITE.format('$D/work/out.csv')}; cat $D/work/out.csv > swarm.csv",
        f"t=$(mktemp $D/XXXXXX); {WRITE.format('$t')}; mv $t $D/out.csv; cp $D/out.csv swarm.csv",
        f"exec 8<>$D/out.csv; {WRITE.format('/dev/fd/8')}; cat /dev/fd/8 $D/out.csv | tail -n 2 > swarm.csv",
        f"{WRITE.format('/dev/shm/sierra-test-out.csv')}; cp /dev/shm/sierra-test-out.csv swarm.csv",
        f"mkdir -p $D/jax-swarm; {WRITE.format('$D/jax-swarm/out.csv')}; cp $D/jax-swarm/out.csv swarm.csv",
        f"{WRITE.format('../../out.csv')}; cp ../../out.csv swarm.csv",
        f"{WRITE.format('own')}; cp --remove-destination own $D/out.csv; rm own; sleep 0.05; cp $D/out.csv swarm.csv",
        f"{WRITE.format('$D/out.lock')}; echo '#{'x' * 64}' >> $D/out.lock; head -n 2 $D/out.lock > swarm.csv",
        f"{MANY}; {WRITE.format('$D/out.csv')}; cp $D/out.csv swarm.csv",
        f"ln -sfn $PWD $D/now; {WRITE.format('$D/now/swarm.csv')}",
        f"{WRITE.format('own.csv')}; ln -s $PWD/own.csv $D/$$; mv -T $D/$$ $D/now; sleep 0.05; cat $D/now > swarm.csv",
    ],
    ids=[
        "copied",
        "moved",
        "linked",
        "folder",
        "replaced",
        "both",
        "memory",
        "like a cache",
        "beside",
        "made again",
        "like a lock",
        "many",
        "link",
        "new link",
    ],
)
def test_runs_that_share_a_file_do_not_count(execute: Callable[..., tuple[int, str]], script: str) -> None:
    counted, said = execute(script)
    assert counted < 10, said  # a run that was alone counts
    assert REASON in said


def test_with_one_job_they_count(execute: Callable[..., tuple[int, str]]) -> None:
    script = f"{WRITE.format('$D/out.csv')}; cp $D/out.csv swarm.csv"
    assert execute(script)[0] < 10
    assert execute(script, jobs=1)[0] == 10


def test_an_output_that_has_another_name_outside_is_the_runs_own(execute: Callable[..., tuple[int, str]]) -> None:
    assert execute(f"{WRITE.format('$D/out.csv')}; ln $D/out.csv swarm.csv", jobs=1)[0] == 10


def test_two_runs_at_once_are_compared_although_only_one_was_observed(execute: Callable[..., tuple[int, str]]) -> None:
    both = "mkdir -p $D/both; touch $D/both/$1; until [ $(ls $D/both | wc -l) = 2 ]; do sleep 0.01; done"
    script = f"{both}; {WRITE.format('$D/out.csv')}; cp $D/out.csv swarm.csv"
    counted, said = execute(script, query="population_size=1", runs=2)
    assert (counted, "is executed again and observed" in said) == (1, True), said


@pytest.mark.parametrize(
    "script",
    [
        f"{WRITE.format('$D/$$.csv')}; cp $D/$$.csv swarm.csv",
        f"t=$(mktemp); {WRITE.format('$t')}; cp $t swarm.csv; echo $1 >> $D/log",
        f"t=$(mktemp -d $D/XXXXXX); {WRITE.format('$t/out.csv')}; cp $t/out.csv swarm.csv",
        f"t=$(mktemp $D/XXXXXX); {WRITE.format('$t')}; cp $t swarm.csv; exec 9<>$D/lock; flock 9",
        f"TMPDIR=$(mktemp -d $D/XXXXXX); export TMPDIR; t=$(mktemp); {WRITE.format('$t')}; mv $t swarm.csv",
        f"python3 -c '{TEMPFILE}' $D $1",
        f"d=$(mktemp -d $D/XXXXXX); ln -sfn $PWD $d/now; ln -sfn $PWD $D/last; {WRITE.format('$d/now/swarm.csv')}",
        f"echo $$ > $D/pid.lock; cat $D/pid.lock > /dev/null; {WRITE.format('swarm.csv')}",
    ],
    ids=["pid", "mktemp", "folder", "lock", "tmpdir", "tempfile", "links", "pid in a lock"],
)
def test_runs_with_names_of_their_own_count(execute: Callable[..., tuple[int, str]], script: str) -> None:
    counted, said = execute(script, runs=10, jobs=4)
    assert counted == 20, said


def test_two_runs_with_names_of_their_own_count(execute: Callable[..., tuple[int, str]]) -> None:
    counted, said = execute(f"{WRITE.format('$D/$$.csv')}; cp $D/$$.csv swarm.csv", query="population_size=1", runs=2)
    assert counted == 2, said


def test_two_sessions_at_once_share_a_file(execute: Callable[..., tuple[int, str]], tmp_path: Path) -> None:
    script = f"{WRITE.format('$D/out.csv')}; sleep 0.3; cp $D/out.csv swarm.csv"
    execute(script, query="population_size=3", runs=6, jobs=1)
    folder = tmp_path / "project"
    started = [projects.start(folder, "run", f"population_size={size}", "--jobs", "1", "--no-figures") for size in (1, 2)]
    for process in started:
        process.communicate(timeout=100)
    assert projects.sql(folder, "SELECT count(*) > 0 AS failed FROM executions WHERE reason LIKE 'writes and reads%'") == [
        {"failed": True}
    ]
    assert_own(folder)


SHARING = f"{WRITE.format('$D/out.csv')}; cp $D/out.csv swarm.csv"
PLAIN = '{ echo tick,value; echo "0,$1"; } > swarm.csv; sleep 0.05'


def test_a_run_of_another_experiment_is_no_witness(execute: Callable[..., tuple[int, str]]) -> None:
    script = f'if grep -q "count=.2" "$2"; then {SHARING}; else {PLAIN}; fi'
    counted, said = execute(script, runs=2, jobs=4)
    assert (counted, REASON in said) == (3, True), said


def test_a_run_that_has_failed_is_no_witness(execute: Callable[..., tuple[int, str]]) -> None:
    observed = "! grep -q 'TracerPid:.0$' /proc/$$/status"
    second_fails = f"if {observed}; then mkdir $D/1 2>/dev/null || {{ mkdir $D/2 2>/dev/null && exit 3; }}; fi"
    script = f"{second_fails}; {SHARING}"
    _, said = execute(script, query="population_size=1", runs=6)
    assert REASON in said


@pytest.mark.parametrize(
    ("fails", "runs", "jobs"),
    [("exit 3", 6, 2), ("exit 3", 4, 4), ("exit 0", 6, 2)],
    ids=["next", "all at once", "without output"],
)
def test_sharing_is_seen_although_the_first_observed_run_fails(
    execute: Callable[..., tuple[int, str]], fails: str, runs: int, jobs: int
) -> None:
    observed = "! grep -q 'TracerPid:.0$' /proc/$$/status"
    script = f"if {observed} && mkdir $D/1 2>/dev/null; then sleep 0.3; {fails}; fi; {SHARING}"
    counted, said = execute(script, query="population_size=1", runs=runs, jobs=jobs)
    assert (counted < runs - 1, REASON in said) == (True, True), said


def test_names_of_their_own_count_although_the_first_observed_run_fails(execute: Callable[..., tuple[int, str]]) -> None:
    script = f"mkdir $D/1 2>/dev/null && {{ sleep 0.3; exit 3; }}; {WRITE.format('$D/$$.csv')}; cp $D/$$.csv swarm.csv"
    counted, said = execute(script, query="population_size=1", runs=4, jobs=4)
    assert counted == 3, said


@pytest.mark.nightly
def test_a_run_of_a_session_before_is_no_witness(execute: Callable[..., tuple[int, str]], tmp_path: Path) -> None:
    (tmp_path / "outside" / "do.sh").write_text(PLAIN)
    config = tmp_path / "project" / "sierra.toml"
    execute(". $D/do.sh", query="population_size=3", runs=1)
    once, always = config.read_text().replace("runs = 1", "runs = 2"), 'runs = 2\nobserve = "all"'
    config.write_text(once.replace("runs = 2", always))
    assert execute(". $D/do.sh", query="population_size=1")[0] >= 2
    config.write_text(once)
    (tmp_path / "outside" / "do.sh").write_text(SHARING)
    _, said = execute(". $D/do.sh", query="population_size=1")
    assert REASON in said


@pytest.mark.nightly
def test_a_session_that_dies_while_it_compares_leaves_no_wrong_rows(
    execute: Callable[..., tuple[int, str]], tmp_path: Path
) -> None:
    first = 'if grep -q "count=.3" "$2"; then echo tick,value > swarm.csv; exit; fi'
    second = "mkdir $D/1 || mkdir $D/2 || { touch $D/begun; sleep 60; }"
    execute(f"{first}; {second}; {SHARING}", query="population_size=3", runs=2)
    folder = tmp_path / "project"
    process = projects.start(folder, "run", "population_size=1", "--jobs", "2", "--no-figures")
    until((tmp_path / "outside" / "begun").exists, "a run is compared", 60)
    process.kill()
    process.communicate(timeout=30)

    def is_decided() -> bool:
        assert projects.quick(folder, "gc", "--yes").returncode == 0  # it finishes a session whose worker has ended, too
        found = projects.sql(folder, "SELECT count(*) > 0 AS failed FROM executions WHERE reason LIKE 'writes and reads%'")
        return found == [{"failed": True}]

    until(is_decided, "the session is finished", 60)
    assert_own(folder)


def test_a_session_that_cannot_compare_decides_nothing_for_others(
    execute: Callable[..., tuple[int, str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    found: list[int] = []

    def compare(session: Executor) -> None:
        for context in (replace(session._context, session="0" * 16), session._context):
            found.append(len(shared_use.find(session.store, session.session.paths, context, final=True)))

    monkeypatch.setattr(Executor, "_compare", compare)
    execute(f"{WRITE.format('$D/$$.csv')}; sleep 0.5; cp $D/$$.csv swarm.csv", query="population_size=1", runs=2)
    assert found == [0, 2]
