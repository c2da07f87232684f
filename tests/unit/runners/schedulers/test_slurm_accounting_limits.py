"""Limits of SLURM's accounting for a user, as sacctmgr reports them; see `integration/clusters/test_slurm_accounting`."""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import pytest

import sierra
from sierra.config.cluster_table import ClusterTable
from sierra.errors import ConfigError, Full, Missing
from sierra.runners.cluster import runner
from sierra.runners.schedulers import slurm as scheduler
from sierra.runners.schedulers.base import Limit, Request
from sierra.runners.schedulers.slurm import Allowed, Partitions, allowed
from tests.clusters import Slurm
from tests.conftest import Simulated

ENFORCED = {
    "ClusterName": "tux",
    "AccountingStorageType": "accounting_storage/slurmdbd",
    "AccountingStorageEnforce": "associations,limits,qos",
}


@dataclass
class Sacctmgr:
    """A replacement for sacctmgr with fixed answers."""

    associations: str = "physics||normal|normal,short||||\n"
    """Account, partition, default QOS, QOS, MaxSubmitJobs, GrpSubmitJobs, MaxJobs, MaxWall."""
    qos: str = "normal|||||\n"
    """Name, MaxSubmitJobsPerUser, MaxSubmitJobsPerAccount, GrpSubmitJobs, MaxJobsPerUser, MaxWall."""
    default: str = "physics\n"
    asked: list[tuple[str, ...]] = field(default_factory=list)

    def __call__(self, *words: str) -> str:
        self.asked.append(words)
        if "qos" in words:
            [names] = (word.removeprefix("name=").split(",") for word in words if word.startswith("name="))
            return "".join(f"{line}\n" for line in self.qos.splitlines() if line.split("|")[0] in names)
        return self.default if "user" in words else self.associations

    def allows(self, partition: str = "debug", of_partition: str | None = None, **table: str) -> Allowed:
        asked = Partitions((partition,), (of_partition,) if of_partition else ())
        return allowed(self, ENFORCED, "ann", ClusterTable.model_validate(table), asked)


def test_limits_of_the_default_qos_override_those_of_the_association() -> None:
    asked = Sacctmgr("physics||normal|normal|50|30|4|02:00:00\n", "normal|20|||8|00:30:00\n")
    assert asked.allows() == Allowed(
        jobs=Limit(20, "MaxSubmitJobsPerUser of QOS normal"),
        running=Limit(8, "MaxJobsPerUser of QOS normal"),
        wall_s=Limit(1800, "MaxWall of QOS normal"),
    )


def test_limits_of_the_association_apply_if_the_qos_has_none() -> None:
    asked = Sacctmgr("physics||normal|normal|50|30|4|1-00:00:00\n")
    mine = "your association with account physics"
    assert asked.allows() == Allowed(
        Limit(30, f"GrpSubmitJobs of {mine}"), Limit(4, f"MaxJobs of {mine}"), Limit(86400, f"MaxWall of {mine}")
    )


@pytest.mark.parametrize("default", ["", "\n"])
def test_a_user_without_a_default_account_has_the_first_account(default: str) -> None:
    asked = Sacctmgr("robots||normal|normal|3|||\n", default=default)
    assert asked.allows().jobs == Limit(3, "MaxSubmitJobs of your association with account robots")


def test_the_qos_of_the_partition_overrides_others() -> None:
    asked = Sacctmgr(qos="normal|20||||\nwide|200||||\n")
    assert asked.allows(of_partition="wide").jobs == Limit(200, "MaxSubmitJobsPerUser of QOS wide")


def test_the_requested_account_partition_and_qos_select_the_limits() -> None:
    associations = "physics||normal|normal|1|||\nrobots||normal|normal,short|2|||\nrobots|debug|normal|normal|3|||\n"
    asked = Sacctmgr(associations, qos="normal|||||\nshort||9|||\n")
    assert asked.allows("long").jobs == Limit(1, "MaxSubmitJobs of your association with account physics")
    assert asked.allows("long", account="robots").jobs.most == 2  # type: ignore[union-attr]
    assert asked.allows(account="Robots").jobs.most == 3  # type: ignore[union-attr]
    several = Sacctmgr("robots||normal|normal,short||||\n", qos="short||9|||\n")
    assert several.allows(account="robots", qos="short").jobs == Limit(9, "MaxSubmitJobsPerAccount of QOS short")


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ({"account": "chemistry"}, "account 'chemistry' is not yours on this cluster; you have physics$"),
        ({"qos": "high"}, "QOS 'high' is not open to account 'physics'; it has normal, short$"),
    ],
)
def test_the_error_for_a_foreign_account_or_qos_names_the_users_own(table: dict[str, str], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        Sacctmgr().allows(**table)


@pytest.mark.parametrize(
    "config",
    [
        {"AccountingStorageType": "accounting_storage/none"},
        {"AccountingStorageType": "(null)", "AccountingStorageEnforce": "none"},
        {**ENFORCED, "AccountingStorageEnforce": "none"},
        {},
    ],
)
def test_sacctmgr_is_not_called_if_accounting_enforces_no_limits(config: dict[str, str]) -> None:
    asked = Sacctmgr()
    assert allowed(asked, config, "ann", ClusterTable(account="chemistry"), Partitions((), ())) == Allowed()
    assert asked.asked == []


def test_limits_are_unknown_if_accounting_does_not_answer() -> None:
    def deaf(*words: str) -> str:
        raise Missing("Unable to contact slurm database")

    assert allowed(deaf, ENFORCED, "ann", ClusterTable(), Partitions((), ())) == Allowed()


@pytest.mark.parametrize("associations", ["", "Welcome to the cluster\n"])
def test_a_user_without_an_association_has_only_the_limits_of_the_usual_qos(associations: str) -> None:
    assert Sacctmgr(associations, "normal|7||||\n").allows(account="chemistry").jobs == Limit(
        7, "MaxSubmitJobsPerUser of QOS normal"
    )


SCONTROL = """#!/bin/sh
{scontrol} "$@" | sed -e 's|^AccountingStorageType .*|AccountingStorageType = accounting_storage/slurmdbd|' \\
    -e 's/^AccountingStorageEnforce .*/AccountingStorageEnforce = associations,limits,qos/'
"""
SACCTMGR = """#!/bin/sh
case "$*" in
    *" associations "*) echo 'physics||normal|normal,short||||' ;;
    *" user "*) echo physics ;;
    *" qos "*) echo 'normal|6|||2|00:20:00' ;;
esac
"""


@pytest.fixture
def limited(
    simulate: Callable[..., Simulated], slurm: Slurm, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Callable[[str], Simulated]:
    """Return a function that makes a project for a SLURM with accounting and limits."""
    scontrol = shutil.which("scontrol") or "scontrol"
    tools = tmp_path / "tools"
    tools.mkdir()
    for name, script in (("scontrol", SCONTROL.format(scontrol=scontrol)), ("sacctmgr", SACCTMGR)):
        (tools / name).write_text(script)
        (tools / name).chmod(0o755)
    monkeypatch.setenv("PATH", f"{tools}:{os.environ['PATH']}")

    def make(table: str) -> Simulated:
        made = simulate()
        config = made.folder / "sierra.toml"
        config.write_text(config.read_text() + f"[runners.slurm]\n{table}\n")
        return made

    return make


ASKED = ("run", "size=1", "--runs", "40", "--on", "slurm", "--no-figures")


@pytest.mark.integration
def test_a_dry_run_obeys_accounting_limits_and_names_their_origin(limited: Callable[[str], Simulated]) -> None:
    told = limited("array_tasks = 30").quick(*ASKED, "-n", "--explain").stdout
    for line in (
        "array_tasks +5 +the number of jobs that the site allows \\(MaxSubmitJobsPerUser of QOS normal\\)",
        "jobs at a time +6 +the site's limit: MaxSubmitJobsPerUser of QOS normal",
        "jobs that run at a time +2 +the site's limit: MaxJobsPerUser of QOS normal",
        "longest wall +1200 +the site's limit: MaxWall of QOS normal",
        "longest array +1001 +the site's limit: MaxArraySize",
    ):
        assert re.search(f"^{line}$", told, re.MULTILINE), told


@pytest.mark.integration
@pytest.mark.parametrize(
    ("table", "words"),
    [
        ("wall = 1800", "more than the site allows, 1200 s (MaxWall of QOS normal)"),
        ('account = "chemistry"', "account 'chemistry' is not yours on this cluster; you have physics"),
        ('qos = "high"', "QOS 'high' is not open to account 'physics'; it has normal, short"),
    ],
)
def test_a_violation_of_accounting_limits_is_refused_in_one_line(
    limited: Callable[[str], Simulated], table: str, words: str
) -> None:
    project = limited(table)
    for more in (("-n",), ()):
        done = project.quick(*ASKED, *more)
        assert done.returncode == 2
        [line] = [line for line in done.stderr.splitlines() if line.startswith("sierra:")]
        assert words in line
    assert project.executed().total() == 0
    assert project.work() == []


@pytest.mark.nightly
def test_nodes_are_probed_first_on_a_site_that_allows_one_job_at_a_time(
    simulate: Callable[..., Simulated], slurm: Slurm, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))  # these nodes were never probed
    monkeypatch.setattr(runner, "FULL_S", 0.5)
    submit = scheduler.Slurm.submit

    def one_at_a_time(self: scheduler.Slurm, request: Request) -> str:
        if slurm.command("squeue", "-h", "-t", "PENDING,RUNNING") or len(request.elements) > 1:
            raise Full("SLURM: QOSMaxSubmitJobPerUserLimit")
        return submit(self, request)

    monkeypatch.setattr(scheduler.Slurm, "submit", one_at_a_time)
    project = simulate()
    done = sierra.open(project.folder).run("size=1", runs=2, runner="slurm", figures=False)
    assert (done.executed, done.missing) == (2, 0)
    assert sorted(project.executed().values()) == [1, 1]
