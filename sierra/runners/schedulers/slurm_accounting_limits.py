"""Limits that accounting (slurmdbd) sets for a user of SLURM, by association and by quality of service (QOS).

For each kind of limit, the first one that is set is effective: that of the partition's QOS, of the job's QOS, or of the user's
association. An association inherits its account's limits, except limits on groups. (Source: "Resource Limits" in SLURM's
documentation.) Without accounting, or if accounting enforces nothing, nothing is queried. If accounting cannot be reached,
nothing is known, and sbatch will report what it refuses.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence

from sierra.config.cluster_table import ClusterTable
from sierra.errors import ConfigError, Missing
from sierra.runners.schedulers.base import Limit, least
from sierra.util.lazy_definitions import dataclass

Ask = Callable[..., str]
"""A function that returns the output of a command with these words; it raises Missing."""
Row = Mapping[str, str]

ASSOCIATION = (*("Account", "Partition", "DefaultQOS", "QOS"), *("MaxSubmitJobs", "GrpSubmitJobs", "MaxJobs", "MaxWall"))
QOS = ("Name", "MaxSubmitJobsPerUser", "MaxSubmitJobsPerAccount", "GrpSubmitJobs", "MaxJobsPerUser", "MaxWall")
USUAL = "normal"
"""The QOS of users who have none."""


@dataclass(frozen=True, slots=True)
class Allowed:
    """The limits of each kind."""

    jobs: Limit | None = None
    running: Limit | None = None
    wall_s: Limit | None = None


@dataclass(frozen=True, slots=True)
class Partitions:
    """The requested partitions, and their QOS."""

    names: tuple[str, ...]
    qos: tuple[str, ...]


def allowed(ask: Ask, config: Row, user: str, table: ClusterTable, partitions: Partitions) -> Allowed:
    """Return the limits of this user. Raises ConfigError for an account or a QOS that the user does not have."""
    enforced = set(re.findall(r"\w+", config.get("AccountingStorageEnforce", "")))
    if not config.get("AccountingStorageType", "").endswith("slurmdbd") or not enforced & {"associations", "limits", "qos"}:
        return Allowed()
    try:
        association = _association(ask, config.get("ClusterName", ""), user, table, partitions)
        names = dict.fromkeys((*partitions.qos, _qos(association, table, strict="qos" in enforced)))
        return _allowed(association, _qualities(ask, names)) if "limits" in enforced else Allowed()
    except Missing:
        return Allowed()


def seconds(text: str) -> float | None:
    """Return the seconds of a limit as SLURM writes it, for example `1-12:00:00`; None if there is no limit."""
    match = re.fullmatch(r"(?:(\d+)-)?(\d+):(\d+):(\d+)", text)
    if match is None:
        return None
    days, hours, minutes, rest = (int(part or 0) for part in match.groups())
    return float(((days * 24 + hours) * 60 + minutes) * 60 + rest)


def _rows(ask: Ask, what: str, columns: Sequence[str], *where: str) -> list[Row]:
    output = ask("sacctmgr", "--noheader", "--parsable2", "show", what, "where", *where, f"format={','.join(columns)}")
    return [
        dict(zip(columns, line.split("|"), strict=True)) for line in output.splitlines() if line.count("|") == len(columns) - 1
    ]


def _association(ask: Ask, cluster: str, user: str, table: ClusterTable, partitions: Partitions) -> Row:
    """Return the association of the requested account, or of the user's default; empty if there is none.

    Raises ConfigError if the user does not have the requested account.
    """
    limits = _rows(ask, "associations", ASSOCIATION, f"user={user}", f"cluster={cluster}")
    accounts = dict.fromkeys(row["Account"].lower() for row in limits)
    if table.account is not None and limits and table.account.lower() not in accounts:
        raise ConfigError(f"account {table.account!r} is not yours on this cluster; you have {', '.join(accounts)}")
    usual = (row["DefaultAccount"] for row in _rows(ask, "user", ("DefaultAccount",), f"name={user}"))
    account = table.account or next(filter(None, usual), next(iter(accounts), ""))
    mine = {row["Partition"]: row for row in limits if row["Account"].lower() == account.lower()}
    return next((mine[name] for name in (*partitions.names, "") if name in mine), {})


def _qos(association: Row, table: ClusterTable, *, strict: bool) -> str:
    """Return the QOS that a job will have. Raises ConfigError if the account does not have the requested one."""
    names = [name for name in association.get("QOS", "").split(",") if name]
    if table.qos is not None and names and strict and table.qos.lower() not in names:
        raise ConfigError(f"QOS {table.qos!r} is not open to account {association['Account']!r}; it has {', '.join(names)}")
    return table.qos or association.get("DefaultQOS") or (names[0] if len(names) == 1 else USUAL)


def _qualities(ask: Ask, names: Mapping[str, object]) -> list[Row]:
    """Return the rows of these qualities of service, in this order."""
    rows = {row["Name"]: row for row in _rows(ask, "qos", QOS, f"name={','.join(names)}")}
    return [rows[name.lower()] for name in names if name.lower() in rows]


def _allowed(association: Row, qualities: Sequence[Row]) -> Allowed:
    def first(of_qos: str, of_association: str = "", read: Callable[[str], float | None] = _number) -> Limit | None:
        sources = [(f"QOS {row['Name']}", row, of_qos) for row in qualities]
        sources.append((f"your association with account {association.get('Account')}", association, of_association))
        limits = ((whose, name, read(row.get(name, ""))) for whose, row, name in sources)
        return next((Limit(most, f"{name} of {whose}") for whose, name, most in limits if most is not None), None)

    return Allowed(
        jobs=least(
            first("MaxSubmitJobsPerUser", "MaxSubmitJobs"),
            first("MaxSubmitJobsPerAccount"),
            first("GrpSubmitJobs", "GrpSubmitJobs"),
        ),
        running=first("MaxJobsPerUser", "MaxJobs"),
        wall_s=first("MaxWall", "MaxWall", seconds),
    )


def _number(text: str) -> float | None:
    return float(text) if text.isdigit() else None
