"""Redaction: the decision about each column of the records, so that they no longer show who executed runs, where and when.

A column without a decision stops the command. Ids of batches,
experiments, runs, executions and sessions, hashes of outputs and of programs, and all rows and files that runs wrote stay as
they are. Rewritten are:

    TIME          all times are moved by one duration, so that the last one is midnight of the package's date: durations stay
    HOST          host-1, host-2, …: the same name for the same host everywhere
    ROBOT         robot-1, robot-2, …: the name of a robot
    PACKAGE       package-1, package-2, …: the id of an imported package, which may be published with names
    ATTEMPT       attempt-1, attempt-2, …: the original has the names of a job and of a node
    PLACE         the folder of a path, unless it is in the project or belongs to the system: /redacted/1/argos3
    HIDDEN        the text "redacted"
    NOTHING       NULL
    ENVIRONMENT, SOURCE, ISOLATION      the id of such a record, which follows from its rewritten columns
    ROW           a value that depends on others of its row: see `sierra.packages.anonymity.redact_rows`

The table `redactions` names the sessions whose records were rewritten. Texts that are kept may contain names all the same: see
`sierra.packages.anonymity.content_search`.
"""

from __future__ import annotations

from collections.abc import Mapping
from enum import Enum, auto

from sierra.errors import Damaged

VERSION = "sierra redaction 1"
"""The version of these rules, which the table `redactions` names."""


class Rule(Enum):
    """The decision about a column."""

    KEEP = auto()
    TIME = auto()
    HOST = auto()
    ROBOT = auto()
    PACKAGE = auto()
    ATTEMPT = auto()
    HIDDEN = auto()
    PLACE = auto()
    NOTHING = auto()
    ENVIRONMENT = auto()
    SOURCE = auto()
    ISOLATION = auto()
    ROW = auto()


K, T, E = Rule.KEEP, Rule.TIME, Rule.ENVIRONMENT


def _rules(kept: str, **others: Rule) -> Mapping[str, Rule]:
    """Return the decisions about a table: the columns in `kept` stay as they are."""
    return {**dict.fromkeys(kept.split(), K), **others}


RULES: Mapping[str, Mapping[str, Rule]] = {
    "batches": _rules(
        "batch query axes controller scenario overrides platform experiments runs base_seed spec template template_sha256 "
        "lamport",
        created=T,
    ),
    "experiments": _rules("experiment batch ordinal"),
    "batch_runs": _rules("batch ordinal number run seed input other_inputs spec"),
    "specs": _rules("spec platform command variables source image host_access files named_inputs shared_files around robots"),
    "executions": _rules(
        "execution run session batch status reason exit_code signal wall_s user_s system_s max_rss_bytes slot result log_tail "
        "programs ingest_rules purpose lamport",
        attempt=Rule.ATTEMPT,
        started=T,
        ended=T,
        host=Rule.HOST,
        environment=E,
        isolation=Rule.ISOLATION,
    ),
    "attempts": _rules(
        "session batch array_task scheduler clock_offset_s cpus memory gpus runs interrupted_runs state error",
        started=T,
        ended=T,
        attempt=Rule.ATTEMPT,
        node=Rule.HOST,
        job=Rule.NOTHING,
        allocation=Rule.NOTHING,
        environment=E,
    ),
    "robots": _rules(
        "execution place robot_group status reason machine processor kernel firmware calibration_sha256 battery_start "
        "battery_end offset_start_ns offset_end_ns rtt_ns clock_remark uneven_ns start_skew_ns "
        "exit_code signal",
        robot=Rule.ROBOT,
        host=Rule.HOST,
        boot_id=Rule.NOTHING,
        environment=E,
        isolation=Rule.ISOLATION,
        clock_start_ns=Rule.NOTHING,
        clock_end_ns=Rule.NOTHING,
        started=T,
        ended=T,
    ),
    "trials": _rules(
        "execution valid reason note block position poses arena order_rule order_seed stopped files lamport",
        operator=Rule.HIDDEN,
        facts=Rule.NOTHING,
        marked=T,
    ),
    "duplicates": _rules("execution run result same", attempt=Rule.ATTEMPT),
    "isolations": _rules(
        "engine version rootless mode image network devices limits_asked limits_enforced",
        isolation=Rule.ROW,
        user=Rule.ROW,
        mounts=Rule.ROW,
        argv=Rule.ROW,
    ),
    "judgements": _rules("judgement execution run session batch status reason ingest_rules lamport", judged_at=T),
    "findings": _rules("execution status reason lamport", found_at=T),
    "artifacts": _rules("execution run path kind output size sha256 rows table_layout counted_rows"),
    "sessions": _rules(
        "session batch query runner engine slots executed reexecuted reused failed missing interrupted sierra programs "
        "ingest_rules batch_rules lamport build target",
        started=T,
        ended=T,
        environment=E,
        source=Rule.SOURCE,
    ),
    "builds": _rules(
        "build session batch purpose source command folder produces variables image host_access programs engine exit_code "
        "reason compiler flags result log lamport processors",
        started=T,
        ended=T,
        host=Rule.HOST,
    ),
    "build_products": _rules("build session name size sha256"),
    "shared_files": _rules("shared name sha256 size executable"),
    "replays": _rules(
        "replay kind target batch runner engine runs verdict tolerances programs lamport", started=T, ended=T, environment=E
    ),
    "verdicts": _rules(
        "replay run recorded execution path verdict reason row column recorded_value replayed_value max_abs max_rel max_ulp"
    ),
    "equivalences": _rules(
        "replay experiment metric output column measure recorded_mean replayed_mean n difference low high margin alpha p power "
        "equivalent reason"
    ),
    "captures": _rules("execution session batch run recorded rendering files frames ticks_per_second verdict reason lamport"),
    "renderings": _rules("execution batch run rendering"),
    "environments": _rules(
        "os kernel machine cpu cpu_flags cores memory gpus libc limits python sierra distributions lock packages",
        environment=Rule.ROW,
        workspaces=Rule.ROW,
        host=Rule.ROW,
        container=Rule.ROW,
        locale=Rule.ROW,
        timezone=Rule.ROW,
        modules=Rule.ROW,
        variables=Rule.ROW,
    ),
    "sources": _rules(
        "tree files",
        source=Rule.ROW,
        vcs=Rule.ROW,
        commit=Rule.ROW,
        branch=Rule.ROW,
        dirty=Rule.ROW,
        remote=Rule.ROW,
        described=Rule.ROW,
        folder=Rule.ROW,
        submodules=Rule.ROW,
    ),
    "blobs": _rules("blob sha256"),
    "ingest_rules": _rules("ingest_rules declared"),
    "programs": _rules("programs kind version sha256", name=Rule.PLACE, path=Rule.PLACE),
    "observations": _rules("execution method notes distributions", files=Rule.ROW, reason=Rule.ROW),
    "files_read": _rules("use size", files=Rule.ROW, path=Rule.ROW, sha256=Rule.ROW),
    "listings": _rules("names", sha256=Rule.ROW),
    "files_written": _rules("execution use", path=Rule.PLACE),
    "channels": _rules("execution use", name=Rule.PLACE),
    "endings": _rules("execution kind text"),
    "stale_sessions": _rules("session stale", path=Rule.PLACE),
    "reused_executions": _rules("session run execution"),
    "unused_changes": _rules("session spec programs", name=Rule.PLACE),
    "images": _rules(
        "image kind architecture layers name sha256 squashfs manifests labels variables packages recipe files size variants",
        file=Rule.PLACE,
        created=Rule.NOTHING,
    ),
    "deliverables": _rules("deliverable batch batches kind name definition sql data files sha256s made_by lamport", made=T),
    "studies": _rules("study batch query rule schedule alpha correction lamport", begun=T),
    "looks": _rules("look study number batch runs level decision reason lamport", decided=T),
    "look_intervals": _rules("look condition ordinal n value low high method half_width wanted holds needed"),
    "imports": _rules("batches lamport", package=Rule.PACKAGE, title=Rule.HIDDEN, date=Rule.HIDDEN, imported_at=T),
    "imported_sessions": _rules("session batch lamport", packages=Rule.PACKAGE),
    "objects": _rules("sha256 part size content"),
    "redactions": _rules("session batch rules"),
}
"""The decision about each column, by table. Texts in columns that are kept are searched for names."""


def rule(table: str, column: str) -> Rule:
    """Return the decision about a column. Raises Damaged if there is none."""
    try:
        return RULES[table][column]
    except KeyError:
        raise Damaged(f"the table {table} has a column {column!r} that this SIERRA cannot make anonymous") from None
