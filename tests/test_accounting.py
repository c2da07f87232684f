"""What accounting allows a user of SLURM, by what sacctmgr says; `test_slurmdbd` has a real one."""

from __future__ import annotations

from dataclasses import dataclass, field

import pytest

from sierra.config import ClusterTable
from sierra.errors import ConfigError, Missing
from sierra.runners.schedulers import Limit
from sierra.runners.schedulers.accounting import Allowed, Partitions, allowed

ENFORCED = {
    "ClusterName": "tux",
    "AccountingStorageType": "accounting_storage/slurmdbd",
    "AccountingStorageEnforce": "associations,limits,qos",
}


@dataclass
class Sacctmgr:
    """Answers as sacctmgr does."""

    associations: str = "physics||normal|normal,short||||\n"
    """Account, partition, default QOS, QOS, MaxSubmitJobs, GrpSubmitJobs, MaxJobs, MaxWall."""
    qos: str = "normal|||||\n"
    """Name, MaxSubmitJobsPerUser, MaxSubmitJobsPerAccount, GrpSubmitJobs, MaxJobsPerUser, MaxWall."""
    asked: list[tuple[str, ...]] = field(default_factory=list)

    def __call__(self, *words: str) -> str:
        self.asked.append(words)
        if "qos" in words:
            [names] = (word.removeprefix("name=").split(",") for word in words if word.startswith("name="))
            return "".join(f"{line}\n" for line in self.qos.splitlines() if line.split("|")[0] in names)
        return "physics\n" if "user" in words else self.associations

    def allows(self, partition: str = "debug", of_partition: str | None = None, **table: str) -> Allowed:
        asked = Partitions((partition,), (of_partition,) if of_partition else ())
        return allowed(self, ENFORCED, "ann", ClusterTable.model_validate(table), asked)


def test_limits_of_the_default_qos_come_before_those_of_the_association() -> None:
    asked = Sacctmgr("physics||normal|normal|50|30|4|02:00:00\n", "normal|20|||8|00:30:00\n")
    assert asked.allows() == Allowed(
        jobs=Limit(20, "MaxSubmitJobsPerUser of QOS normal"),
        running=Limit(8, "MaxJobsPerUser of QOS normal"),
        wall_s=Limit(1800, "MaxWall of QOS normal"),
    )


def test_what_no_qos_limits_the_association_does() -> None:
    asked = Sacctmgr("physics||normal|normal|50|30|4|1-00:00:00\n")
    mine = "your association with account physics"
    assert asked.allows() == Allowed(
        Limit(30, f"GrpSubmitJobs of {mine}"), Limit(4, f"MaxJobs of {mine}"), Limit(86400, f"MaxWall of {mine}")
    )


def test_the_qos_of_the_partition_comes_first() -> None:
    asked = Sacctmgr(qos="normal|20||||\nwide|200||||\n")
    assert asked.allows(of_partition="wide").jobs == Limit(200, "MaxSubmitJobsPerUser of QOS wide")


def test_what_is_asked_for_counts() -> None:
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
        ({"account": "chemistry"}, "account 'chemistry' is none of yours on this cluster; there are physics$"),
        ({"qos": "high"}, "QOS 'high' is none of account 'physics'; there are normal, short$"),
    ],
)
def test_an_account_or_qos_that_is_not_the_users_is_said_with_those_that_are(table: dict[str, str], words: str) -> None:
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
def test_where_nothing_is_enforced_nothing_is_asked(config: dict[str, str]) -> None:
    asked = Sacctmgr()
    assert allowed(asked, config, "ann", ClusterTable(account="chemistry"), Partitions((), ())) == Allowed()
    assert asked.asked == []


def test_where_accounting_does_not_answer_nothing_is_known() -> None:
    def deaf(*words: str) -> str:
        raise Missing("Unable to contact slurm database")

    assert allowed(deaf, ENFORCED, "ann", ClusterTable(), Partitions((), ())) == Allowed()


@pytest.mark.parametrize("associations", ["", "Welcome to the cluster\n"])
def test_a_user_without_an_association_has_only_the_limits_of_the_usual_qos(associations: str) -> None:
    assert Sacctmgr(associations, "normal|7||||\n").allows(account="chemistry").jobs == Limit(
        7, "MaxSubmitJobsPerUser of QOS normal"
    )
