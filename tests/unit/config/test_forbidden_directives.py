"""Directives that a project adds to cluster jobs: those that break jobs, or have their own setting, are refused at once."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests import projects

SLURM = [
    ("--dependency=afterok:1", "SIERRA itself makes array tasks wait"),
    ("-d singleton", "SIERRA itself makes array tasks wait"),
    ("--dep=afterok:1", "SIERRA itself makes array tasks wait"),
    ("--array=0-3", "array_tasks = N"),
    ("--mail-type=FAIL --array 0-3", "array_tasks = N"),
    ("-a0-3", "array_tasks = N"),
    ("-ko nowhere", "SIERRA shows the output of array tasks"),
    ("--output=/tmp/x", "SIERRA shows the output of array tasks"),
    ("-e /tmp/x", "SIERRA shows the output of array tasks"),
    ("--parsable", "SIERRA reads the output of the submit command"),
    ("--test-only", "SIERRA reads the output of the submit command"),
    ("--wait", "SIERRA waits for its jobs itself"),
    ("-HW", "SIERRA waits for its jobs itself"),
    ("--export=ALL", "[environment]"),
    ("-J mine", "by the name that it gives them"),
    ("--time=10", "use wall = SECONDS"),
    ("-t 10", "use wall = SECONDS"),
    ("--mem=4G", "use memory"),
    ("-c4", "use cpus = N"),
    ("--ntasks=4", "runs on one node"),
    ("--partition short", "use partition"),
    ("mail-type=FAIL", "should be the text after #SBATCH, such as --mail-type=FAIL"),
    ("#SBATCH --nice", "should be the text after #SBATCH"),
]
PBS = [
    ("-J 0-3", "array_tasks = N"),
    ("-t 0-3", "array_tasks = N"),
    ("-o /tmp/x", "SIERRA shows the output of array tasks"),
    ("-e /tmp/x", "SIERRA shows the output of array tasks"),
    ("-V", "[environment]"),
    ("-v A=1", "[environment]"),
    ("-W depend=afterok:1", "SIERRA itself makes array tasks wait"),
    ("-W umask=22,depend=afterok:1", "SIERRA itself makes array tasks wait"),
    ("-Wblock=true", "SIERRA waits for its jobs itself"),
    ("-N mine", "by the name that it gives them"),
    ("-l walltime=1:00:00", "use wall = SECONDS"),
    ("-lselect=1:ncpus=4", "use cpus, memory and gpus"),
    ("-q long", "use partition"),
    ("#PBS -m abe", "should be the text after #PBS, such as -l place=excl"),
]


@pytest.mark.parametrize(
    ("scheduler", "line", "instead"), [*(("slurm", *one) for one in SLURM), *(("pbs", *one) for one in PBS)]
)
def test_directives_that_sierra_sets_itself_are_refused_with_the_alternative(
    tmp_path: Path, scheduler: str, line: str, instead: str
) -> None:
    root = projects.make(tmp_path / "project", f"{projects.CONFIG}[runners.{scheduler}]\ndirectives = ['{line}']\n")
    done = projects.quick(root, "run", "noise=1")  # before anything is sent to a cluster
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert f"directive {line!r} of " in done.stderr
    assert instead in done.stderr


def test_forbidden_directives_are_refused_for_runners_of_any_name(tmp_path: Path) -> None:
    table = '[runners.big]\nscheduler = "slurm"\ndirectives = ["--wait"]\n'
    done = projects.quick(projects.make(tmp_path / "project", projects.CONFIG + table), "run", "noise=1")
    assert (done.returncode, "directive '--wait' of 'big' cannot be added: SIERRA waits" in done.stderr) == (2, True)


@pytest.mark.parametrize(
    ("scheduler", "line"),
    [
        *(("slurm", line) for line in ("--mail-type=FAIL --mail-user=a@b", "--exclude=n1", "--nodelist=n1", "--no-requeue")),
        *(("slurm", line) for line in ("--gres=gpu:a100:2", "--mem-bind=local", "--time-min=5", "-x n1", "--exclusive", "-H")),
        *(("slurm", line) for line in ("--wait-all-nodes=1", "--nice  # --wait", "--reservation=course")),
        *(("pbs", line) for line in ("-l place=excl", "-m abe", "-W group_list=ants", "-P project", "-p 5", "-l vmem=4gb")),
        ("lsf", "-J mine"),
    ],
)
def test_directives_without_their_own_setting_are_accepted(tmp_path: Path, scheduler: str, line: str) -> None:
    root = projects.make(tmp_path / "project", f"{projects.CONFIG}[runners.{scheduler}]\ndirectives = ['{line}']\n")
    done = projects.quick(root, "run", "noise=1", "-n")
    assert done.returncode == 0, done.stderr
