"""The schema of the store's tables: each column with its type, its unit and its description.

`sierra schema` prints this schema, `schemas/store.sql` is generated from it, and every segment is written with it.
The tables of the runs' own outputs are not here: the runs define their columns.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any


@dataclass(frozen=True, slots=True)
class Column:
    name: str
    type: str
    meaning: str
    unit: str = ""


@dataclass(frozen=True, slots=True)
class Table:
    name: str
    meaning: str
    columns: tuple[Column, ...]


ID, TEXT, INT, REAL, FLAG, TIME, LIST, BYTES = (
    "VARCHAR",
    "VARCHAR",
    "BIGINT",
    "DOUBLE",
    "BOOLEAN",
    "TIMESTAMP WITH TIME ZONE",
    "VARCHAR[]",
    "BLOB",
)


def _table(name: str, meaning: str, *columns: tuple[str, ...]) -> Table:
    return Table(name, meaning, tuple(Column(*column) for column in columns))


RECORDED = {
    table.name: table
    for table in (
        _table(
            "batches",
            "Batches: the ordered set of experiments that a query expands to.",
            ("batch", ID, "the batch's id: a Merkle hash over its experiments"),
            ("created", TIME, "when it was first submitted"),
            ("query", TEXT, "the criteria as they were first submitted"),
            ("axes", LIST, "names of the independent variables, in order"),
            ("controller", TEXT, "the controller; NULL if none was named"),
            ("scenario", TEXT, "the scenario; NULL if none was named"),
            ("overrides", LIST, "the further values that were set for all runs, each as XPATH=VALUE"),
            ("platform", TEXT, "the platform, which drives the simulator"),
            ("experiments", INT, "number of its experiments", "1"),
            ("runs", INT, "number of its runs in all experiments together", "1"),
            ("base_seed", INT, "the number that all seeds derive from"),
            ("spec", ID, "the specification that all its runs share"),
            ("template", TEXT, "the template's path in the project"),
            ("template_sha256", ID, "SHA-256 of the template file"),
            ("lamport", INT, "its position in the logical order, as in sessions"),
        ),
        _table(
            "experiments",
            "Points in the space of the independent variables; each variable is a further column here.",
            ("experiment", ID, "the experiment's id: a Merkle hash over its values and runs"),
            ("batch", ID, "the batch that it belongs to"),
            ("ordinal", INT, "its position in the batch, from 0"),
        ),
        _table(
            "batch_runs",
            "The runs of each experiment of each batch; a run may belong to several.",
            ("batch", ID, "the batch"),
            ("ordinal", INT, "the experiment's position in the batch, from 0"),
            ("number", INT, "the run's number in the experiment, from 0"),
            ("run", ID, "the run"),
            ("seed", INT, "its seed"),
            ("input", ID, "SHA-256 of its first input file; the file itself is in objects"),
            ("other_inputs", LIST, "SHA-256 of its other input files, which specs.files names"),
            ("spec", ID, "the specification that it shares with the other runs of the batch"),
        ),
        _table(
            "specs",
            "Run specifications, which runs share: a spec, inputs and a seed make a run.",
            ("spec", ID, "the spec's id"),
            ("platform", TEXT, "the platform, which drives the simulator"),
            ("command", LIST, "program and arguments, before paths of this machine are inserted"),
            ("variables", TEXT, "declared environment variables, as JSON"),
            ("source", ID, "the tree of the code (an SWHID); NULL if the runs have no source"),
            ("image", ID, "content identity of the container image; NULL without one"),
            ("host_access", LIST, "access of runs to the host, outside the image: network, gpu, each device and each mount"),
            ("files", LIST, "names of the input files that each run gets"),
        ),
        _table(
            "executions",
            "Executions of runs: when, where and by which programs each run was executed, and how it ended. If an execution "
            "was evaluated again by changed rules, status, reason and ingest_rules are those of the last evaluation; the table "
            "all_judgements has all evaluations.",
            ("execution", ID, "the execution's id"),
            ("run", ID, "the run"),
            ("session", ID, "the session that executed it"),
            ("batch", ID, "the batch that it was executed for"),
            ("started", TIME, "when its program started"),
            ("ended", TIME, "when its program ended"),
            ("status", TEXT, "ok, failed, timeout, memory, cpu, output, mismatch or interrupted"),
            ("reason", TEXT, "why the status is not ok, in one line"),
            ("exit_code", INT, "the program's exit status; NULL if a signal ended it"),
            ("signal", INT, "the signal that ended it; NULL if none did"),
            ("wall_s", REAL, "time from start to end", "s"),
            (
                "user_s",
                REAL,
                "CPU time in user mode of all its processes that ended; in a container, measured from outside",
                "s",
            ),
            ("system_s", REAL, "CPU time in kernel mode, measured in the same way", "s"),
            (
                "max_rss_bytes",
                INT,
                "peak resident memory of its largest process (at least the worker's); in a container, measured from outside",
                "bytes",
            ),
            ("host", TEXT, "host name"),
            ("slot", INT, "the slot of the worker that executed it"),
            ("result", ID, "Merkle hash of the names and digests of its outputs"),
            ("log_tail", TEXT, "the end of its standard error, or of its standard output if standard error is empty"),
            ("environment", ID, "the environment in which it ran"),
            ("programs", ID, "fingerprint of the programs outside source and image"),
            ("ingest_rules", ID, "hash of the rules by which it was evaluated: [outputs] and [success] of the project"),
            ("purpose", TEXT, "run, or another purpose; only executions for run count in statistics"),
            ("isolation", ID, "how it was isolated in a container; NULL if it was not"),
            ("attempt", ID, "on a cluster, the attempt at an array task that executed it; NULL otherwise"),
            ("lamport", INT, "its position in the logical order, as in sessions"),
        ),
        _table(
            "attempts",
            "Attempts on clusters: each time that an array task, which has a share of a batch's runs, was executed on a node.",
            ("attempt", ID, "the attempt's id"),
            ("session", ID, "the session that it belongs to"),
            ("batch", ID, "the batch"),
            ("array_task", INT, "the index of the array task; a session with n array tasks gives each of them every n-th run"),
            ("scheduler", TEXT, "the scheduler that started it, with its version"),
            ("job", TEXT, "the scheduler's id of the job, or of this task of the job"),
            ("node", TEXT, "host name of the node"),
            ("started", TIME, "when it started"),
            ("ended", TIME, "when it last recorded something"),
            (
                "clock_offset_s",
                REAL,
                "how far the node's clock was ahead of the shared file system's clock; if over 2 s, all times are by "
                "the file system's clock",
                "s",
            ),
            ("cpus", INT, "cores that were allocated to it", "1"),
            ("memory", INT, "memory that was allocated to it; NULL if unknown", "bytes"),
            ("gpus", TEXT, "GPUs that were allocated to it, by the scheduler's names"),
            ("allocation", TEXT, "other facts that the scheduler reported on the node, as JSON"),
            ("runs", INT, "runs that it executed to their end", "1"),
            ("interrupted_runs", INT, "runs that it started and did not finish", "1"),
            ("state", TEXT, "finished, or cut off"),
            ("error", TEXT, "why it could not continue, as reported by itself or else by the scheduler"),
            ("environment", ID, "the environment in which it ran"),
        ),
        _table(
            "duplicates",
            "Runs that were executed once more than requested, because two attempts at one array task ran at the same time.",
            ("execution", ID, "the run's recorded execution: the one that was seen first"),
            ("run", ID, "the run"),
            ("attempt", ID, "the attempt that executed the copy"),
            ("result", ID, "Merkle hash of the copy's outputs, as in executions"),
            ("same", FLAG, "whether these outputs equal the recorded execution's"),
        ),
        _table(
            "isolations",
            "Isolations: how executions were isolated in containers, each recorded once.",
            ("isolation", ID, "hash of all columns below"),
            ("engine", TEXT, "the container engine"),
            ("version", TEXT, "versions of the engine and of the program with which it starts containers"),
            ("rootless", FLAG, "whether the engine ran without root privileges"),
            ("mode", TEXT, "run: one container for each run; worker: one container for all runs of a slot (weaker isolation)"),
            ("image", ID, "content identity of the image"),
            ("user", TEXT, "the user that a container's processes have on the host"),
            ("network", TEXT, "none, host, or not isolated (none was requested but is not possible here)"),
            ("devices", LIST, "devices of the host that runs could use; gpu stands for NVIDIA GPUs"),
            (
                "mounts",
                TEXT,
                "files and folders of the host that runs could read, as JSON: path in the container, path on the host",
            ),
            ("limits_asked", TEXT, "limits that were requested of the engine, as JSON: memory in bytes, cpus, pids"),
            (
                "limits_enforced",
                TEXT,
                "limits that the engine enforces here; others are ignored, except memory, which the worker then monitors",
            ),
            ("argv", LIST, "the command that starts a container, without the parts that differ for each run"),
        ),
        _table(
            "judgements",
            "Later evaluations of recorded executions: by changed rules, from the recorded files, without executing anything.",
            ("judgement", ID, "the judgement's id"),
            ("execution", ID, "the execution"),
            ("run", ID, "its run"),
            ("session", ID, "the session that evaluated it again"),
            ("batch", ID, "the batch for which it was evaluated"),
            ("judged_at", TIME, "when it was evaluated"),
            ("status", TEXT, "as in executions"),
            ("reason", TEXT, "why the status is not ok, in one line"),
            ("ingest_rules", ID, "hash of the rules: [outputs] and [success] of the project"),
            ("lamport", INT, "its position in the logical order, as in sessions"),
        ),
        _table(
            "findings",
            "Problems that were found after an execution was recorded; from then on its status is not ok.",
            ("execution", ID, "the execution, or its judgement that is not ok"),
            ("found_at", TIME, "when the problem was found"),
            ("status", TEXT, "the new status"),
            ("reason", TEXT, "the reason, in one line"),
            ("lamport", INT, "its position in the logical order, as in sessions"),
        ),
        _table(
            "artifacts",
            "Files that executions left, and their logs, as they were last evaluated.",
            ("execution", ID, "the execution"),
            ("run", ID, "the run"),
            ("path", TEXT, "path in the output folder; for logs, stdout or stderr"),
            ("kind", TEXT, "table, file or log"),
            ("output", TEXT, "the declared or detected output that it belongs to, which is the table's name"),
            ("size", INT, "its size", "bytes"),
            (
                "sha256",
                ID,
                "SHA-256 of its bytes; of a log over 1 MiB, SHA-256 of the part that is kept: its beginning and end",
            ),
            ("rows", INT, "rows that it added to its table", "1"),
            (
                "table_layout",
                TEXT,
                "layout of its table, as JSON: its file, the type of each column, whether its last line is complete",
            ),
            ("counted_rows", INT, "rows in the file itself, counted independently of the reader", "1"),
        ),
        _table(
            "sessions",
            "Sessions: submissions of a query by one process, recorded when they end.",
            ("session", ID, "the session's id"),
            ("batch", ID, "the batch that was requested"),
            ("query", TEXT, "the query as it was submitted"),
            ("started", TIME, "when the query was submitted"),
            ("ended", TIME, "when the session ended"),
            ("runner", TEXT, "where runs were executed"),
            ("engine", TEXT, "the container engine"),
            (
                "slots",
                INT,
                "runs at a time; on a cluster, cores of all array tasks together, and NULL if it submitted none",
                "1",
            ),
            ("executed", INT, "runs executed", "1"),
            ("reexecuted", INT, "runs among them that had been executed before", "1"),
            ("reused", INT, "runs whose recorded successful execution was reused", "1"),
            ("failed", INT, "runs of the batch that were executed and have no successful execution", "1"),
            ("missing", INT, "runs of the batch that were not executed", "1"),
            ("interrupted", FLAG, "whether the user interrupted it"),
            ("sierra", TEXT, "SIERRA's version"),
            ("environment", ID, "the environment in which it ran"),
            ("source", ID, "the recorded state of the source"),
            ("programs", ID, "fingerprint of the programs with which its runs were, or would have been, executed"),
            ("ingest_rules", ID, "hash of the rules, as in executions"),
            ("batch_rules", ID, "hash of the rules and of the allowed differences between runs of the batch (mismatch)"),
            (
                "lamport",
                INT,
                "its position in the logical order: a greater number is later, independent of clocks; old records have "
                "negative numbers, in the order of their times, and so come first",
            ),
        ),
        _table(
            "replays",
            "Replays: recorded runs that were executed again from the record alone, and compared with it.",
            ("replay", ID, "the replay's id, which is also the session of its executions"),
            ("kind", TEXT, "the kind of record that was replayed: batch, experiment, run or execution"),
            ("target", ID, "the id of the replayed record"),
            ("batch", ID, "the batch that was replayed, or that contains the replayed record"),
            ("started", TIME, "when it was submitted"),
            ("ended", TIME, "when its verdict was known"),
            ("runner", TEXT, "where runs were executed"),
            ("engine", TEXT, "the container engine"),
            ("runs", INT, "runs compared", "1"),
            (
                "verdict",
                TEXT,
                "identical, equal, within tolerance, equivalent, different or failed: the worst verdict of its experiments",
            ),
            ("tolerances", TEXT, "tolerances that were requested, as JSON: by output, by column"),
            ("environment", ID, "the environment in which it ran"),
            ("programs", ID, "fingerprint of the programs with which it was executed"),
            ("lamport", INT, "its position in the logical order, as in sessions"),
        ),
        _table(
            "verdicts",
            "Verdicts: how far each output of a replayed run agrees with its record.",
            ("replay", ID, "the replay"),
            ("run", ID, "the run"),
            ("recorded", ID, "the recorded execution"),
            ("execution", ID, "the execution that was compared with it; NULL if there is none"),
            ("path", TEXT, "the output's path; NULL if the verdict is about the whole run"),
            ("verdict", TEXT, "identical, equal, within tolerance, different or failed"),
            ("reason", TEXT, "the reason in one line; empty if they are identical"),
            ("row", INT, "the first row (or line) in which they differ, from 0"),
            ("column", TEXT, "the column of the first difference"),
            ("recorded_value", TEXT, "the recorded value at the first difference"),
            ("replayed_value", TEXT, "the replayed value at the first difference"),
            ("max_abs", REAL, "the greatest absolute difference in that column, in its unit"),
            ("max_rel", REAL, "the greatest difference relative to the recorded number", "1"),
            ("max_ulp", REAL, "the greatest difference in units in the last place", "1"),
        ),
        _table(
            "equivalences",
            "Metrics of nondeterministic experiments that a replay compared over all runs, by two one-sided tests (TOST).",
            ("replay", ID, "the replay"),
            ("experiment", ID, "the experiment"),
            ("metric", TEXT, "the metric's name in [equivalence]"),
            ("output", TEXT, "the output"),
            ("column", TEXT, "the column of the output"),
            ("measure", TEXT, "how each run was reduced to one number"),
            ("recorded_mean", REAL, "the recorded mean, in the column's unit"),
            ("replayed_mean", REAL, "the replayed mean"),
            ("n", INT, "number of pairs of runs", "1"),
            ("difference", REAL, "the mean of the differences between paired runs"),
            ("low", REAL, "lower end of the confidence interval (level 1 - 2 alpha) of the difference"),
            ("high", REAL, "upper end of the confidence interval"),
            ("margin", REAL, "the interval must lie between -margin and +margin"),
            (
                "alpha",
                REAL,
                "significance level: greatest probability of finding means equivalent that differ by the margin",
                "1",
            ),
            ("p", REAL, "the greater p-value of the two tests", "1"),
            ("power", REAL, "power: probability of finding equal means equivalent", "1"),
            ("equivalent", FLAG, "whether the interval lies within the margins"),
            ("reason", TEXT, "the reason, in one line"),
        ),
        _table(
            "environments",
            "Environments of executions (operating system, hardware, libraries, variables), each recorded once.",
            ("environment", ID, "hash of all columns below"),
            ("host", TEXT, "host name"),
            ("os", TEXT, "operating system, by its own name"),
            ("kernel", TEXT, "kernel release"),
            ("machine", TEXT, "processor architecture"),
            ("cpu", TEXT, "processor model"),
            ("cpu_flags", LIST, "processor features that change arithmetic or its speed, such as avx2 and fma"),
            ("cores", INT, "usable cores", "1"),
            ("memory", INT, "main memory", "bytes"),
            ("gpus", LIST, "GPUs, by name or by vendor and device ids, each with its driver"),
            ("libc", TEXT, "C library and its version"),
            ("container", TEXT, "the container in which SIERRA ran, with its image if known; NULL if in no container"),
            ("locale", TEXT, "SIERRA's locale; runs use the declared one"),
            ("timezone", TEXT, "SIERRA's time zone; runs use the declared one"),
            (
                "limits",
                TEXT,
                "process limits (ulimit) as JSON, soft and hard by name, in bytes, seconds or numbers; null for no limit",
            ),
            ("modules", LIST, "environment modules that were loaded"),
            (
                "variables",
                TEXT,
                "environment variables as JSON: those known to change results, and those in [environment] record",
            ),
            ("python", TEXT, "version of the Python that ran SIERRA"),
            ("sierra", TEXT, "SIERRA's version"),
            ("distributions", TEXT, "Python distributions installed where SIERRA ran, one name==version per line"),
            ("lock", ID, "SHA-256 of the column distributions"),
        ),
        _table(
            "sources",
            "Sources: states of the code of runs, each recorded once.",
            ("source", ID, "hash of all columns below except files"),
            ("tree", ID, "the tree of the code that identifies runs, as an SWHID"),
            ("vcs", TEXT, "git, or none"),
            ("commit", ID, "the commit that was checked out"),
            ("branch", TEXT, "the branch that was checked out"),
            ("dirty", FLAG, "whether files of the tree differ from the commit; NULL outside git"),
            ("remote", TEXT, "the remote's address, without credentials"),
            ("described", TEXT, "the commit relative to the nearest tag, as given by git describe --always --dirty --tags"),
            ("folder", TEXT, "the project's folder relative to the root of the repository; . if it is the root"),
            ("submodules", TEXT, "submodules, as JSON: path and commit; NULL if there are none"),
            ("files", ID, "SHA-256 of the list of files, which is in objects: one mode, hash and path per line"),
        ),
        _table(
            "blobs",
            "Files of sources outside git, by the hash that git would give them; the list of a source's files has this hash.",
            ("blob", ID, "git's hash of the file"),
            ("sha256", ID, "SHA-256 of the file; the file itself is in objects"),
        ),
        _table(
            "ingest_rules",
            "The rules by which executions were evaluated, so that other executions can be evaluated by the same rules.",
            ("ingest_rules", ID, "hash of the rules, as in executions"),
            ("declared", TEXT, "the tables [outputs] and [success] of sierra.toml, as JSON"),
        ),
        _table(
            "programs",
            "Dependencies of executions outside source and image: programs, libraries, Python distributions, files.",
            ("programs", ID, "fingerprint of the set of programs that was used together"),
            (
                "name",
                TEXT,
                "the name that the command uses; for a library, the name that the loader uses; for a file in the project or in "
                "a mount, {project}/… or {mount}/…",
            ),
            ("kind", TEXT, "program, library, distributions (packages installed for a Python), file or link"),
            (
                "version",
                TEXT,
                "for a program, the first line of its version text; for distributions, one name==version per line; else NULL",
            ),
            ("path", TEXT, "where it was found; several folders are separated by :"),
            ("sha256", ID, "SHA-256 of the file; for distributions, of their names and versions, or of their content"),
        ),
        _table(
            "images",
            "Container images in which runs were, or would have been, executed, each recorded once.",
            (
                "image",
                ID,
                "content identity: sha256: and the digest of an OCI image's configuration; squashfs: and that of a file system",
            ),
            ("kind", TEXT, "oci or squashfs"),
            ("architecture", TEXT, "the OCI name: amd64, arm64, …; NULL if the image does not state it"),
            ("layers", LIST, "digests of the layers' files (OCI's diff_ids), lowest layer first; empty for a squashfs"),
            ("name", TEXT, "the name that the project uses"),
            ("file", TEXT, "path of the image file, relative to the project's root if it is in the project; NULL for a tag"),
            ("sha256", ID, "SHA-256 of that file"),
            ("squashfs", ID, "SHA-256 of the squashfs that SIERRA made from it for apptainer; NULL if it made none"),
            (
                "manifests",
                TEXT,
                "digests of its manifests as JSON, by the form in which they were seen; each form has another digest",
            ),
            ("created", TIME, "when it was created, as the image states"),
            ("labels", TEXT, "its labels, as JSON"),
            ("variables", TEXT, "environment variables that it sets for its programs, as JSON"),
            ("packages", TEXT, "installed packages, as JSON: for each of dpkg, apk and python a list of name==version"),
            ("recipe", TEXT, "how it was made, if known: a definition file, or a history"),
            (
                "files",
                ID,
                "SHA-256 of the list of its files, which is in objects: one JSON object per line with path, type, size, sha256",
            ),
            ("size", INT, "total size of its files", "bytes"),
        ),
        _table(
            "objects",
            "Recorded files by the hash of their content, in parts of at most 8 MiB; files that became tables are included "
            "unless [store] raw is false.",
            ("sha256", ID, "SHA-256 of the whole file"),
            ("part", INT, "position of this part, from 0"),
            ("size", INT, "size of the whole file", "bytes"),
            ("content", BYTES, "the part's bytes"),
        ),
    )
}

LATER: dict[str, tuple[str, ...]] = {}
"""By table, the last columns that were added within this format: older files lack them, and their values are NULL there."""

DERIVED = {
    table.name: table
    for table in (
        _table(
            "runs",
            "Runs, one row each; the independent variables are further columns.",
            ("run", ID, "the run's id"),
            ("seed", INT, "its seed"),
            ("number", INT, "its number in its experiment, from 0; the smallest number if it belongs to several experiments"),
            ("input", ID, "SHA-256 of its first input file; the file itself is in objects"),
            ("spec", ID, "the specification that it shares with other runs"),
            (
                "status",
                TEXT,
                "ok if it has an effective execution; otherwise the status of its last execution (stale if that is ok); "
                "missing if there is none",
            ),
            ("execution", ID, "the effective execution for the batch that was submitted last"),
            ("executions", INT, "number of its executions", "1"),
        ),
        _table(
            "effective",
            "The effective execution of each run in each batch: the last successful one with the programs and the rules of the "
            "batch's last session. Statistics, figures and outputs use no other execution.",
            ("batch", ID, "the batch"),
            ("ordinal", INT, "the experiment's position in the batch, from 0"),
            ("run", ID, "the run"),
            ("execution", ID, "the execution"),
            ("judgement", ID, "the effective judgement of that execution, as in all_judgements"),
            ("submitted", TIME, "when the batch was last submitted"),
            ("lamport", INT, "position of that session in the logical order, as in sessions"),
        ),
        _table(
            "all_judgements",
            "All judgements of executions: the first, made when the execution was recorded, and later ones by changed rules.",
            ("judgement", ID, "the judgement; the first one has the id of its execution"),
            ("judged_at", TIME, "when it was evaluated"),
            ("place", INT, "its position in the logical order; the first judgement has the position of its execution"),
            *(
                (column.name, column.type, f"{column.meaning}; by this judgement", column.unit)
                if column.name in ("status", "reason", "ingest_rules")
                else (column.name, column.type, column.meaning, column.unit)
                for column in RECORDED["executions"].columns
            ),
        ),
        _table(
            "all_artifacts",
            "Artifacts by each judgement; the table artifacts has only those by the last judgement.",
            ("execution", ID, "the judgement"),
            *((column.name, column.type, column.meaning, column.unit) for column in RECORDED["artifacts"].columns[1:]),
        ),
        _table(
            "nondeterminism",
            "Runs whose output changed between successful executions with the same programs, replays included.",
            ("run", ID, "the run"),
            ("programs", ID, "fingerprint of the programs"),
            ("executions", INT, "successful executions with these programs", "1"),
            ("results", INT, "number of different results", "1"),
            (
                "verdict",
                TEXT,
                "the worst verdict of a replay (equal, within tolerance: by the declared rules); NULL if only bytes are known",
            ),
        ),
        _table(
            "points",
            "Runs with the values of the independent variables, which are further columns. A run that belongs to experiments "
            "with different values of one variable has a row for each value.",
            ("run", ID, "the run"),
            ("number", INT, "its smallest number in its experiments, from 0"),
        ),
    )
}

RESERVED = frozenset(
    (
        "batch",
        "experiment",
        "run",
        "number",
        "seed",
        "execution",
        "row",
        "file",
        "session",
        "ordinal",
        "runs",
        "succeeded",
        "failed",
    )
) | {column.name for table in DERIVED.values() if not table.name.startswith("all_") for column in table.columns}
"""Names that are not allowed for axes, because a column of the store has them."""

BESIDE_OUTPUTS = frozenset(("run", "execution", "file", "number", "filename", "file_row_number"))
"""Names that output columns cannot have in the store; such a column gets a trailing underscore."""

TABLE_NAMES = frozenset(RECORDED) | frozenset(DERIVED)


def check_name(name: str) -> bool:
    """Check that an output may have this name: it must not hide a table of the store; case is ignored."""
    return name.lower() not in TABLE_NAMES


@cache
def arrow_schema(name: str) -> Any:
    """Return a recorded table's schema as a pyarrow.Schema."""
    import pyarrow as pa

    types = {
        "VARCHAR": pa.string(),
        "BIGINT": pa.int64(),
        "DOUBLE": pa.float64(),
        "BOOLEAN": pa.bool_(),
        "TIMESTAMP WITH TIME ZONE": pa.timestamp("us", tz="UTC"),
        "VARCHAR[]": pa.list_(pa.string()),
        "BLOB": pa.large_binary(),
    }
    return pa.schema([(column.name, types[column.type]) for column in RECORDED[name].columns])


def is_table(name: str, schema: Any) -> bool:
    """Check if a file with this Arrow schema holds the columns of a recorded table: all of them, or an older version's."""
    import pyarrow as pa

    whole = arrow_schema(name)
    older = len(whole) - len(LATER.get(name, ()))
    return any(schema.equals(pa.schema(list(whole)[:end])) for end in range(older, len(whole) + 1))


def sql() -> str:
    """Return the whole schema as SQL with comments: the content of `schemas/store.sql`."""
    parts = []
    for table in (*RECORDED.values(), *DERIVED.values()):
        lines = [f"-- {table.meaning}", f"CREATE TABLE {table.name} ("]
        for column in table.columns:
            unit = f" [{column.unit}]" if column.unit else ""
            comma = "" if column is table.columns[-1] else ","
            lines.append(f'    "{column.name}" {column.type}{comma}  -- {column.meaning}{unit}')
        parts.append("\n".join([*lines, ");"]))
    return "\n\n".join(parts) + "\n"
