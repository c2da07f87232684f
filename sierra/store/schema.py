"""The schema of the store's tables: each column with its type, its unit and a sentence.

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
            "What a query expands to: an ordered set of experiments.",
            ("batch", ID, "the batch's id: a Merkle hash over its experiments"),
            ("created", TIME, "when it was first asked for"),
            ("query", TEXT, "the criteria as they were first asked for"),
            ("axes", LIST, "names of the independent variables, in order"),
            ("controller", TEXT, "the controller, where one was named"),
            ("scenario", TEXT, "the scenario, where one was named"),
            ("overrides", LIST, "what was set for all runs beside, each as XPATH=VALUE"),
            ("platform", TEXT, "how the simulator is driven"),
            ("experiments", INT, "experiments in it", "1"),
            ("runs", INT, "runs in it, all experiments together", "1"),
            ("base_seed", INT, "the number that all seeds derive from"),
            ("spec", ID, "what all its runs have in common"),
            ("template", TEXT, "the template's path in the project"),
            ("template_sha256", ID, "SHA-256 of the template file"),
            ("lamport", INT, "its place in the logical order, as in sessions"),
        ),
        _table(
            "experiments",
            "Points in the space of the independent variables; each of those is a further column here.",
            ("experiment", ID, "the experiment's id: a Merkle hash over its values and runs"),
            ("batch", ID, "the batch it belongs to"),
            ("ordinal", INT, "its place in the batch, from 0"),
        ),
        _table(
            "batch_runs",
            "Which run belongs to which experiment of which batch; a run may belong to many.",
            ("batch", ID, "the batch"),
            ("ordinal", INT, "the experiment's place in the batch, from 0"),
            ("number", INT, "the run's number in the experiment, from 0"),
            ("run", ID, "the run"),
            ("seed", INT, "its seed"),
            ("input", ID, "SHA-256 of its first input file; the file itself is in objects"),
            ("other_inputs", LIST, "SHA-256 of its further input files, named as in specs.files"),
            ("spec", ID, "what it has in common with the other runs of the batch"),
        ),
        _table(
            "specs",
            "What runs have in common: with an input and a seed, a spec makes a run.",
            ("spec", ID, "the spec's id"),
            ("platform", TEXT, "how the simulator is driven"),
            ("command", LIST, "program and arguments, before paths of a machine are filled in"),
            ("variables", TEXT, "declared environment variables, as JSON"),
            ("source", ID, "the tree of the code (an SWHID); NULL where no source counts"),
            ("image", ID, "content identity of the container image; NULL without one"),
            ("host_access", LIST, "what runs reach beyond it: network, gpu, each device and each mount"),
            ("files", LIST, "names of the input files that each run gets"),
        ),
        _table(
            "executions",
            "One time that a run was executed: when, where, by what, and how it ended. Where it was judged anew by other "
            "rules, status, reason and ingest_rules are those of the last judgement; judged has all.",
            ("execution", ID, "the execution's id"),
            ("run", ID, "the run"),
            ("session", ID, "the asking that executed it"),
            ("batch", ID, "the batch that it was executed for"),
            ("started", TIME, "when its program was started"),
            ("ended", TIME, "when its program had ended"),
            ("status", TEXT, "ok, failed, timeout, memory, cpu, output, mismatch or interrupted"),
            ("reason", TEXT, "why it is not ok, in a line"),
            ("exit_code", INT, "the program's exit status; NULL where a signal ended it"),
            ("signal", INT, "the signal that ended it"),
            ("wall_s", REAL, "from start to end", "s"),
            (
                "user_s",
                REAL,
                "CPU time in user mode, of all its processes that ended; in a container, as measured",
                "s",
            ),
            ("system_s", REAL, "CPU time in the kernel, likewise", "s"),
            (
                "max_rss_bytes",
                INT,
                "greatest resident size of its greatest process (the worker's own size at least); in a container, as seen",
                "bytes",
            ),
            ("host", TEXT, "host name"),
            ("slot", INT, "the slot of the worker that executed it"),
            ("result", ID, "Merkle hash of its outputs' names and digests"),
            ("log_tail", TEXT, "the end of its standard error, or of its standard output where that is empty"),
            ("environment", ID, "what was around it"),
            ("programs", ID, "fingerprint of the programs outside source and image"),
            ("ingest_rules", ID, "hash of what the project declares of outputs and success"),
            ("purpose", TEXT, "run, or what else it was executed for; only those of run count in statistics"),
            ("isolation", ID, "how it was contained; NULL where it was not"),
            ("attempt", ID, "on a cluster, the attempt at an element in which it was executed; NULL elsewhere"),
            ("lamport", INT, "its place in the logical order, as in sessions"),
        ),
        _table(
            "attempts",
            "On clusters: one time that an element, a share of a batch's runs, was executed by a task of a job.",
            ("attempt", ID, "the attempt's id"),
            ("session", ID, "the asking that it was for"),
            ("batch", ID, "the batch"),
            ("array_task", INT, "the index of the array task: it has every n-th run of the session"),
            ("scheduler", TEXT, "what started it, with its version"),
            ("job", TEXT, "the scheduler's id of the job, or of this task of it"),
            ("node", TEXT, "host name of the node"),
            ("started", TIME, "when it began"),
            ("ended", TIME, "when it had last recorded something"),
            (
                "clock_offset_s",
                REAL,
                "how far the node's clock was ahead of the shared file system's; all times are by the latter, if over 2 s",
                "s",
            ),
            ("cpus", INT, "cores that it had", "1"),
            ("memory", INT, "memory that it had; NULL where that was not said", "bytes"),
            ("gpus", TEXT, "graphics processors that it had, as the scheduler calls them"),
            ("allocation", TEXT, "what else the scheduler said of it on the node, as JSON"),
            ("runs", INT, "runs that it has executed to their end", "1"),
            ("interrupted_runs", INT, "runs that it began, and did not end", "1"),
            ("state", TEXT, "finished, or cut off"),
            ("error", TEXT, "why it could not go on, as it said, or else the scheduler"),
            ("environment", ID, "what was around it"),
        ),
        _table(
            "duplicates",
            "Runs that were executed once more than was asked, because two attempts at one element lived at a time.",
            ("execution", ID, "the execution of the run that is recorded: that which was seen first"),
            ("run", ID, "the run"),
            ("attempt", ID, "the attempt that executed the copy"),
            ("result", ID, "Merkle hash of the copy's outputs, as in executions"),
            ("same", FLAG, "whether they are the recorded execution's"),
        ),
        _table(
            "isolations",
            "How executions were contained, recorded once.",
            ("isolation", ID, "hash of all below"),
            ("engine", TEXT, "what contained them"),
            ("version", TEXT, "its version, and that of what it starts containers with"),
            ("rootless", FLAG, "whether it ran without root's rights"),
            ("mode", TEXT, "run: a container for each; worker: one for all runs of a slot, which is weaker"),
            ("image", ID, "content identity of the image"),
            ("user", TEXT, "who a process of a container is outside of it"),
            ("network", TEXT, "none, host, or not isolated where none was asked for and can't be had"),
            ("devices", LIST, "devices of the host that runs could use; gpu for NVIDIA's"),
            ("mounts", TEXT, "files and folders of the host that runs could read, as JSON: path inside, path outside"),
            ("limits_asked", TEXT, "limits that the engine was to enforce, as JSON: memory in bytes, cpus, pids"),
            (
                "limits_enforced",
                TEXT,
                "those that it does enforce here; others are ignored, but for memory: the worker watches over it",
            ),
            ("argv", LIST, "the command that starts a container, but for what is a run's own"),
        ),
        _table(
            "judgements",
            "One time that a recorded execution was judged anew: by other rules, from its recorded files, not executed.",
            ("judgement", ID, "the judgement's id"),
            ("execution", ID, "the execution"),
            ("run", ID, "its run"),
            ("session", ID, "the asking that judged it anew"),
            ("batch", ID, "the batch that it was judged for"),
            ("judged_at", TIME, "when"),
            ("status", TEXT, "as in executions"),
            ("reason", TEXT, "why it is not ok, in a line"),
            ("ingest_rules", ID, "hash of the rules: what the project declares of outputs and success"),
            ("lamport", INT, "its place in the logical order, as in sessions"),
        ),
        _table(
            "findings",
            "What was found out about an execution after it was recorded; it is not ok from then on.",
            ("execution", ID, "the execution, or the judgement of it that is not ok"),
            ("found_at", TIME, "when"),
            ("status", TEXT, "what it is now"),
            ("reason", TEXT, "why, in a line"),
            ("lamport", INT, "its place in the logical order, as in sessions"),
        ),
        _table(
            "artifacts",
            "Every file that an execution left, and its logs; as it was judged last.",
            ("execution", ID, "the execution"),
            ("run", ID, "the run"),
            ("path", TEXT, "path in the output folder; for logs, stdout or stderr"),
            ("kind", TEXT, "table, file or log"),
            ("output", TEXT, "the declared or found output that it belongs to: the table's name"),
            ("size", INT, "its size", "bytes"),
            ("sha256", ID, "SHA-256 of its bytes; of a log over 1 MiB, of what is kept of it, its beginning and end"),
            ("rows", INT, "rows it gave its table", "1"),
            (
                "table_layout",
                TEXT,
                "what its table looks like, as JSON: its file, what each column holds, whether its last line is whole",
            ),
            ("counted_rows", INT, "rows that the file itself has, by a count that does not depend on how it was read", "1"),
        ),
        _table(
            "sessions",
            "One asking of one query by one process, once it has ended.",
            ("session", ID, "the session's id"),
            ("batch", ID, "the batch asked for"),
            ("query", TEXT, "as it was asked"),
            ("started", TIME, "when it was asked"),
            ("ended", TIME, "when it was answered"),
            ("runner", TEXT, "where runs were executed"),
            ("engine", TEXT, "what contained them"),
            (
                "slots",
                INT,
                "runs at a time; on a cluster, cores of all elements together, and NULL where it submitted none",
                "1",
            ),
            ("executed", INT, "runs executed", "1"),
            ("reexecuted", INT, "of these, runs that had been executed before", "1"),
            ("reused", INT, "runs whose recorded execution was good", "1"),
            ("failed", INT, "runs of the batch without a good execution, of those executed", "1"),
            ("missing", INT, "runs of the batch that were not executed", "1"),
            ("interrupted", FLAG, "whether the user ended it"),
            ("sierra", TEXT, "SIERRA's version"),
            ("environment", ID, "what was around it"),
            ("source", ID, "the source's full state"),
            ("programs", ID, "fingerprint of the programs that its runs are, or would have been, executed with"),
            ("ingest_rules", ID, "hash of what the project declares of outputs and success, as in executions"),
            ("batch_rules", ID, "hash of the same and of what may differ between siblings"),
            (
                "lamport",
                INT,
                "its place in the logical order: the greater, the later, whatever clocks said; negative in old records, which "
                "come first, by time",
            ),
        ),
        _table(
            "replays",
            "One replay: recorded runs executed again, from the record alone, and compared with it.",
            ("replay", ID, "the replay's id; its executions have it as their session"),
            ("kind", TEXT, "what was replayed: batch, experiment, run or execution"),
            ("target", ID, "its id"),
            ("batch", ID, "the batch it is of"),
            ("started", TIME, "when it was asked for"),
            ("ended", TIME, "when its verdict was known"),
            ("runner", TEXT, "where runs were executed"),
            ("engine", TEXT, "what contained them"),
            ("runs", INT, "runs compared", "1"),
            (
                "verdict",
                TEXT,
                "identical, equal, within tolerance, equivalent, different or failed: the worst of its experiments",
            ),
            ("tolerances", TEXT, "tolerances that were asked for, as JSON: by output, by column"),
            ("environment", ID, "what was around it"),
            ("programs", ID, "fingerprint of the programs that it was executed with"),
            ("lamport", INT, "its place in the logical order, as in sessions"),
        ),
        _table(
            "verdicts",
            "How far each output of a replayed run agrees with its record.",
            ("replay", ID, "the replay"),
            ("run", ID, "the run"),
            ("recorded", ID, "the execution that is the record"),
            ("execution", ID, "the execution that was compared with it; NULL where there is none"),
            ("path", TEXT, "the output's path; NULL where it is about the whole run"),
            ("verdict", TEXT, "identical, equal, within tolerance, different or failed"),
            ("reason", TEXT, "in a line; empty where they are identical"),
            ("row", INT, "the first row (or line) in which they differ, from 0"),
            ("column", TEXT, "the column of that"),
            ("recorded_value", TEXT, "the recorded value there"),
            ("replayed_value", TEXT, "the value found there"),
            ("max_abs", REAL, "the greatest distance in that column, in its unit"),
            ("max_rel", REAL, "the greatest distance relative to the recorded number", "1"),
            ("max_ulp", REAL, "the greatest distance in units in the last place", "1"),
        ),
        _table(
            "equivalences",
            "Metrics that a replay compared over all runs of experiments that are not deterministic: two one-sided tests.",
            ("replay", ID, "the replay"),
            ("experiment", ID, "the experiment"),
            ("metric", TEXT, "the metric's name in [equivalence]"),
            ("output", TEXT, "the output"),
            ("column", TEXT, "the column of it"),
            ("measure", TEXT, "what each run was reduced to"),
            ("recorded_mean", REAL, "the recorded mean, in the column's unit"),
            ("replayed_mean", REAL, "the mean found"),
            ("n", INT, "pairs of runs", "1"),
            ("difference", REAL, "the mean of the differences, run by run"),
            ("low", REAL, "the interval of confidence 1 - 2 alpha around it"),
            ("high", REAL, "its other end"),
            ("margin", REAL, "what the interval must lie within, on both sides of 0"),
            ("alpha", REAL, "the probability at most to find equivalent what is a margin apart", "1"),
            ("p", REAL, "the greater p value of the two tests", "1"),
            ("power", REAL, "the probability to find equivalent what is the same", "1"),
            ("equivalent", FLAG, "whether the interval lies within the margins"),
            ("reason", TEXT, "in a line"),
        ),
        _table(
            "environments",
            "What was around executions, recorded once.",
            ("environment", ID, "hash of all below"),
            ("host", TEXT, "host name"),
            ("os", TEXT, "operating system, as it calls itself"),
            ("kernel", TEXT, "the kernel's release"),
            ("machine", TEXT, "the processor's architecture"),
            ("cpu", TEXT, "the processor's model"),
            ("cpu_flags", LIST, "the processor's features that change arithmetic or its speed, as avx2 and fma"),
            ("cores", INT, "cores that could be used", "1"),
            ("memory", INT, "main memory", "bytes"),
            ("gpus", LIST, "graphics processors, by name or by the ids of vendor and device, each with its driver"),
            ("libc", TEXT, "C library and its version"),
            ("container", TEXT, "what SIERRA ran in, with its image where that could be told; NULL for no container"),
            ("locale", TEXT, "SIERRA's locale; runs have the declared one"),
            ("timezone", TEXT, "SIERRA's time zone; runs have the declared one"),
            ("limits", TEXT, "limits of processes as JSON, soft and hard by name in bytes, seconds or pieces; null for none"),
            ("modules", LIST, "environment modules that were loaded"),
            ("variables", TEXT, "known variables that change results, and those in [environment] record, as JSON"),
            ("python", TEXT, "version of the Python that ran SIERRA"),
            ("sierra", TEXT, "SIERRA's version"),
            ("distributions", TEXT, "what was installed where SIERRA ran, a line name==version each"),
            ("lock", ID, "SHA-256 of distributions"),
        ),
        _table(
            "sources",
            "States of the code that runs were made from, recorded once.",
            ("source", ID, "hash of all below but files"),
            ("tree", ID, "the tree that counts, as an SWHID"),
            ("vcs", TEXT, "git, or none"),
            ("commit", ID, "the commit checked out"),
            ("branch", TEXT, "the branch checked out"),
            ("dirty", FLAG, "whether files that count differ from the commit; NULL outside git"),
            ("remote", TEXT, "the remote's address, without credentials"),
            ("described", TEXT, "the commit by the nearest tag, as git describe --always --dirty --tags has it"),
            ("folder", TEXT, "the project's folder, from the root of the repository; . where it is the root"),
            ("submodules", TEXT, "the repositories inside, as JSON: path and commit; NULL without any"),
            ("files", ID, "SHA-256 of the list of files in objects: a mode, a hash and a path a line"),
        ),
        _table(
            "blobs",
            "Files of sources outside git, by the hash that git gives them, which stands in the list of a source's files.",
            ("blob", ID, "git's hash"),
            ("sha256", ID, "SHA-256 of the file; the file itself is in objects"),
        ),
        _table(
            "ingest_rules",
            "What projects declared of outputs and success, so that another execution can be judged by the same rules.",
            ("ingest_rules", ID, "as in executions"),
            ("declared", TEXT, "the tables outputs and success of sierra.toml, as JSON"),
        ),
        _table(
            "programs",
            "What executions depend on outside source and image: programs, libraries, Python distributions, files.",
            ("programs", ID, "hash of the set that was used together"),
            (
                "name",
                TEXT,
                "as the command calls it; of a library, as the loader does; of what lies in the project or is mounted, "
                "{project}/… or {mount}/…",
            ),
            ("kind", TEXT, "program, library, distributions (what a Python has installed), file or link"),
            (
                "version",
                TEXT,
                "of a program, the first line that it says of itself; of distributions, a line name==version each; else NULL",
            ),
            ("path", TEXT, "where it was found; of several folders, with : between them"),
            ("sha256", ID, "SHA-256 of the file; of distributions, of their names and versions, or of their content"),
        ),
        _table(
            "images",
            "Container images that runs were executed in, or were to be, recorded once.",
            (
                "image",
                ID,
                "content identity: sha256: and the digest of an OCI image's configuration; squashfs: and that of a file system",
            ),
            ("kind", TEXT, "oci or squashfs"),
            ("architecture", TEXT, "as OCI calls it: amd64, arm64, …; NULL where the image does not say"),
            ("layers", LIST, "digests of the layers' files (OCI's diff_ids), from the lowest; none of a squashfs"),
            ("name", TEXT, "as the project named it"),
            ("file", TEXT, "where it was a file: its path, from the project's root if it lay there; NULL for a tag"),
            ("sha256", ID, "SHA-256 of that file"),
            ("squashfs", ID, "SHA-256 of the squashfs that SIERRA made of it for apptainer; NULL where it made none"),
            ("manifests", TEXT, "digests of its manifests as JSON, by the form they were seen in: they differ by form"),
            ("created", TIME, "when it was made, as it says"),
            ("labels", TEXT, "its labels, as JSON"),
            ("variables", TEXT, "what it sets for its programs, as JSON"),
            ("packages", TEXT, "what is installed, as JSON: by dpkg, apk and python, a list of name==version each"),
            ("recipe", TEXT, "what is known of how it was made: a definition file, or a history"),
            ("files", ID, "SHA-256 of the list of its files in objects: a JSON object a line, with path, type, size, sha256"),
            ("size", INT, "size of its files", "bytes"),
        ),
        _table(
            "objects",
            "Files by the hash of their content, in parts of 8 MiB at most; those of tables unless [store] raw is false.",
            ("sha256", ID, "SHA-256 of the whole file"),
            ("part", INT, "place of this part, from 0"),
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
            ("number", INT, "its number in its experiment, from 0 (the least, where it belongs to several)"),
            ("input", ID, "SHA-256 of its first input file; the file itself is in objects"),
            ("spec", ID, "what it has in common with other runs"),
            ("status", TEXT, "ok where an execution counts; else that of the last (stale if ok), missing if there is none"),
            ("execution", ID, "the execution that counts for the batch last asked for"),
            ("executions", INT, "how many times it was executed", "1"),
        ),
        _table(
            "effective",
            "The execution that counts for a run in a batch: the last good one with the programs and by the rules of the "
            "batch's last asking. Statistics, figures and outputs see no other.",
            ("batch", ID, "the batch"),
            ("ordinal", INT, "the experiment's place in the batch, from 0"),
            ("run", ID, "the run"),
            ("execution", ID, "the execution"),
            ("judgement", ID, "the judgement of it that counts, as in judged"),
            ("submitted", TIME, "when the batch was last asked for"),
            ("lamport", INT, "the place of that in the logical order, as in sessions"),
        ),
        _table(
            "all_judgements",
            "Every judgement of every execution: the first, made when it was recorded, and those that were made anew.",
            ("judgement", ID, "the judgement; the first has the id of its execution"),
            ("judged_at", TIME, "when"),
            ("place", INT, "its place in the logical order; that of the first judgement is the execution's"),
            *(
                (column.name, column.type, f"{column.meaning}; by this judgement", column.unit)
                if column.name in ("status", "reason", "ingest_rules")
                else (column.name, column.type, column.meaning, column.unit)
                for column in RECORDED["executions"].columns
            ),
        ),
        _table(
            "all_artifacts",
            "The rows of artifacts by each judgement; artifacts has those of the last one alone.",
            ("execution", ID, "the judgement"),
            *((column.name, column.type, column.meaning, column.unit) for column in RECORDED["artifacts"].columns[1:]),
        ),
        _table(
            "nondeterminism",
            "Runs of which several good executions with the same programs, replays included, left other bytes.",
            ("run", ID, "the run"),
            ("programs", ID, "fingerprint of the programs"),
            ("executions", INT, "good executions with these programs", "1"),
            ("results", INT, "how many results they have", "1"),
            (
                "verdict",
                TEXT,
                "the worst that a replay found: equal and within tolerance are as declared; NULL if only bytes are known",
            ),
        ),
        _table(
            "points",
            "Where runs stand in the space of the independent variables, which are further columns; a run that belongs to "
            "experiments with different values of one variable has a row for each.",
            ("run", ID, "the run"),
            ("number", INT, "its least number in its experiments, from 0"),
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
