-- What a query expands to: an ordered set of experiments.
CREATE TABLE batches (
    "batch" VARCHAR,  -- the batch's id: a Merkle hash over its experiments
    "created" TIMESTAMP WITH TIME ZONE,  -- when it was first asked for
    "query" VARCHAR,  -- the criteria as they were first asked for
    "axes" VARCHAR[],  -- names of the independent variables, in order
    "controller" VARCHAR,  -- the controller, where one was named
    "scenario" VARCHAR,  -- the scenario, where one was named
    "overrides" VARCHAR[],  -- what was set for all runs beside, each as XPATH=VALUE
    "platform" VARCHAR,  -- how the simulator is driven
    "experiments" BIGINT,  -- experiments in it [1]
    "runs" BIGINT,  -- runs in it, all experiments together [1]
    "base_seed" BIGINT,  -- the number that all seeds derive from
    "spec" VARCHAR,  -- what all its runs have in common
    "template" VARCHAR,  -- the template's path in the project
    "template_sha256" VARCHAR,  -- SHA-256 of the template file
    "lamport" BIGINT  -- its place in the logical order, as in sessions
);

-- Points in the space of the independent variables; each of those is a further column here.
CREATE TABLE experiments (
    "experiment" VARCHAR,  -- the experiment's id: a Merkle hash over its values and runs
    "batch" VARCHAR,  -- the batch it belongs to
    "ordinal" BIGINT  -- its place in the batch, from 0
);

-- Which run belongs to which experiment of which batch; a run may belong to many.
CREATE TABLE batch_runs (
    "batch" VARCHAR,  -- the batch
    "ordinal" BIGINT,  -- the experiment's place in the batch, from 0
    "number" BIGINT,  -- the run's number in the experiment, from 0
    "run" VARCHAR,  -- the run
    "seed" BIGINT,  -- its seed
    "input" VARCHAR,  -- SHA-256 of its first input file; the file itself is in objects
    "other_inputs" VARCHAR[],  -- SHA-256 of its further input files, named as in specs.files
    "spec" VARCHAR  -- what it has in common with the other runs of the batch
);

-- What runs have in common: with an input and a seed, a spec makes a run.
CREATE TABLE specs (
    "spec" VARCHAR,  -- the spec's id
    "platform" VARCHAR,  -- how the simulator is driven
    "command" VARCHAR[],  -- program and arguments, before paths of a machine are filled in
    "variables" VARCHAR,  -- declared environment variables, as JSON
    "source" VARCHAR,  -- the tree of the code (an SWHID); NULL where no source counts
    "image" VARCHAR,  -- content identity of the container image; NULL without one
    "host_access" VARCHAR[],  -- what runs reach beyond it: network, gpu, each device and each mount
    "files" VARCHAR[]  -- names of the input files that each run gets
);

-- One time that a run was executed: when, where, by what, and how it ended. Where it was judged anew by other rules, status, reason and ingest_rules are those of the last judgement; judged has all.
CREATE TABLE executions (
    "execution" VARCHAR,  -- the execution's id
    "run" VARCHAR,  -- the run
    "session" VARCHAR,  -- the asking that executed it
    "batch" VARCHAR,  -- the batch that it was executed for
    "started" TIMESTAMP WITH TIME ZONE,  -- when its program was started
    "ended" TIMESTAMP WITH TIME ZONE,  -- when its program had ended
    "status" VARCHAR,  -- ok, failed, timeout, memory, cpu, output, mismatch or interrupted
    "reason" VARCHAR,  -- why it is not ok, in a line
    "exit_code" BIGINT,  -- the program's exit status; NULL where a signal ended it
    "signal" BIGINT,  -- the signal that ended it
    "wall_s" DOUBLE,  -- from start to end [s]
    "user_s" DOUBLE,  -- CPU time in user mode, of all its processes that ended; in a container, as measured [s]
    "system_s" DOUBLE,  -- CPU time in the kernel, likewise [s]
    "max_rss_bytes" BIGINT,  -- greatest resident size of its greatest process (the worker's own size at least); in a container, as seen [bytes]
    "host" VARCHAR,  -- host name
    "slot" BIGINT,  -- the slot of the worker that executed it
    "result" VARCHAR,  -- Merkle hash of its outputs' names and digests
    "log_tail" VARCHAR,  -- the end of its standard error, or of its standard output where that is empty
    "environment" VARCHAR,  -- what was around it
    "programs" VARCHAR,  -- fingerprint of the programs outside source and image
    "ingest_rules" VARCHAR,  -- hash of what the project declares of outputs and success
    "purpose" VARCHAR,  -- run, or what else it was executed for; only those of run count in statistics
    "isolation" VARCHAR,  -- how it was contained; NULL where it was not
    "attempt" VARCHAR,  -- on a cluster, the attempt at an element in which it was executed; NULL elsewhere
    "lamport" BIGINT  -- its place in the logical order, as in sessions
);

-- On clusters: one time that an element, a share of a batch's runs, was executed by a task of a job.
CREATE TABLE attempts (
    "attempt" VARCHAR,  -- the attempt's id
    "session" VARCHAR,  -- the asking that it was for
    "batch" VARCHAR,  -- the batch
    "array_task" BIGINT,  -- the index of the array task: it has every n-th run of the session
    "scheduler" VARCHAR,  -- what started it, with its version
    "job" VARCHAR,  -- the scheduler's id of the job, or of this task of it
    "node" VARCHAR,  -- host name of the node
    "started" TIMESTAMP WITH TIME ZONE,  -- when it began
    "ended" TIMESTAMP WITH TIME ZONE,  -- when it had last recorded something
    "clock_offset_s" DOUBLE,  -- how far the node's clock was ahead of the shared file system's; all times are by the latter, if over 2 s [s]
    "cpus" BIGINT,  -- cores that it had [1]
    "memory" BIGINT,  -- memory that it had; NULL where that was not said [bytes]
    "gpus" VARCHAR,  -- graphics processors that it had, as the scheduler calls them
    "allocation" VARCHAR,  -- what else the scheduler said of it on the node, as JSON
    "runs" BIGINT,  -- runs that it has executed to their end [1]
    "interrupted_runs" BIGINT,  -- runs that it began, and did not end [1]
    "state" VARCHAR,  -- finished, or cut off
    "error" VARCHAR,  -- why it could not go on, as it said, or else the scheduler
    "environment" VARCHAR  -- what was around it
);

-- Runs that were executed once more than was asked, because two attempts at one element lived at a time.
CREATE TABLE duplicates (
    "execution" VARCHAR,  -- the execution of the run that is recorded: that which was seen first
    "run" VARCHAR,  -- the run
    "attempt" VARCHAR,  -- the attempt that executed the copy
    "result" VARCHAR,  -- Merkle hash of the copy's outputs, as in executions
    "same" BOOLEAN  -- whether they are the recorded execution's
);

-- How executions were contained, recorded once.
CREATE TABLE isolations (
    "isolation" VARCHAR,  -- hash of all below
    "engine" VARCHAR,  -- what contained them
    "version" VARCHAR,  -- its version, and that of what it starts containers with
    "rootless" BOOLEAN,  -- whether it ran without root's rights
    "mode" VARCHAR,  -- run: a container for each; worker: one for all runs of a slot, which is weaker
    "image" VARCHAR,  -- content identity of the image
    "user" VARCHAR,  -- who a process of a container is outside of it
    "network" VARCHAR,  -- none, host, or not isolated where none was asked for and can't be had
    "devices" VARCHAR[],  -- devices of the host that runs could use; gpu for NVIDIA's
    "mounts" VARCHAR,  -- files and folders of the host that runs could read, as JSON: path inside, path outside
    "limits_asked" VARCHAR,  -- limits that the engine was to enforce, as JSON: memory in bytes, cpus, pids
    "limits_enforced" VARCHAR,  -- those that it does enforce here; others are ignored, but for memory: the worker watches over it
    "argv" VARCHAR[]  -- the command that starts a container, but for what is a run's own
);

-- One time that a recorded execution was judged anew: by other rules, from its recorded files, not executed.
CREATE TABLE judgements (
    "judgement" VARCHAR,  -- the judgement's id
    "execution" VARCHAR,  -- the execution
    "run" VARCHAR,  -- its run
    "session" VARCHAR,  -- the asking that judged it anew
    "batch" VARCHAR,  -- the batch that it was judged for
    "judged_at" TIMESTAMP WITH TIME ZONE,  -- when
    "status" VARCHAR,  -- as in executions
    "reason" VARCHAR,  -- why it is not ok, in a line
    "ingest_rules" VARCHAR,  -- hash of the rules: what the project declares of outputs and success
    "lamport" BIGINT  -- its place in the logical order, as in sessions
);

-- What was found out about an execution after it was recorded; it is not ok from then on.
CREATE TABLE findings (
    "execution" VARCHAR,  -- the execution, or the judgement of it that is not ok
    "found_at" TIMESTAMP WITH TIME ZONE,  -- when
    "status" VARCHAR,  -- what it is now
    "reason" VARCHAR,  -- why, in a line
    "lamport" BIGINT  -- its place in the logical order, as in sessions
);

-- Every file that an execution left, and its logs; as it was judged last.
CREATE TABLE artifacts (
    "execution" VARCHAR,  -- the execution
    "run" VARCHAR,  -- the run
    "path" VARCHAR,  -- path in the output folder; for logs, stdout or stderr
    "kind" VARCHAR,  -- table, file or log
    "output" VARCHAR,  -- the declared or found output that it belongs to: the table's name
    "size" BIGINT,  -- its size [bytes]
    "sha256" VARCHAR,  -- SHA-256 of its bytes; of a log over 1 MiB, of what is kept of it, its beginning and end
    "rows" BIGINT,  -- rows it gave its table [1]
    "table_layout" VARCHAR,  -- what its table looks like, as JSON: its file, what each column holds, whether its last line is whole
    "counted_rows" BIGINT  -- rows that the file itself has, by a count that does not depend on how it was read [1]
);

-- One asking of one query by one process, once it has ended.
CREATE TABLE sessions (
    "session" VARCHAR,  -- the session's id
    "batch" VARCHAR,  -- the batch asked for
    "query" VARCHAR,  -- as it was asked
    "started" TIMESTAMP WITH TIME ZONE,  -- when it was asked
    "ended" TIMESTAMP WITH TIME ZONE,  -- when it was answered
    "runner" VARCHAR,  -- where runs were executed
    "engine" VARCHAR,  -- what contained them
    "slots" BIGINT,  -- runs at a time; on a cluster, cores of all elements together, and NULL where it submitted none [1]
    "executed" BIGINT,  -- runs executed [1]
    "reexecuted" BIGINT,  -- of these, runs that had been executed before [1]
    "reused" BIGINT,  -- runs whose recorded execution was good [1]
    "failed" BIGINT,  -- runs of the batch without a good execution, of those executed [1]
    "missing" BIGINT,  -- runs of the batch that were not executed [1]
    "interrupted" BOOLEAN,  -- whether the user ended it
    "sierra" VARCHAR,  -- SIERRA's version
    "environment" VARCHAR,  -- what was around it
    "source" VARCHAR,  -- the source's full state
    "programs" VARCHAR,  -- fingerprint of the programs that its runs are, or would have been, executed with
    "ingest_rules" VARCHAR,  -- hash of what the project declares of outputs and success, as in executions
    "batch_rules" VARCHAR,  -- hash of the same and of what may differ between siblings
    "lamport" BIGINT  -- its place in the logical order: the greater, the later, whatever clocks said; negative in old records, which come first, by time
);

-- One replay: recorded runs executed again, from the record alone, and compared with it.
CREATE TABLE replays (
    "replay" VARCHAR,  -- the replay's id; its executions have it as their session
    "kind" VARCHAR,  -- what was replayed: batch, experiment, run or execution
    "target" VARCHAR,  -- its id
    "batch" VARCHAR,  -- the batch it is of
    "started" TIMESTAMP WITH TIME ZONE,  -- when it was asked for
    "ended" TIMESTAMP WITH TIME ZONE,  -- when its verdict was known
    "runner" VARCHAR,  -- where runs were executed
    "engine" VARCHAR,  -- what contained them
    "runs" BIGINT,  -- runs compared [1]
    "verdict" VARCHAR,  -- identical, equal, within tolerance, equivalent, different or failed: the worst of its experiments
    "tolerances" VARCHAR,  -- tolerances that were asked for, as JSON: by output, by column
    "environment" VARCHAR,  -- what was around it
    "programs" VARCHAR,  -- fingerprint of the programs that it was executed with
    "lamport" BIGINT  -- its place in the logical order, as in sessions
);

-- How far each output of a replayed run agrees with its record.
CREATE TABLE verdicts (
    "replay" VARCHAR,  -- the replay
    "run" VARCHAR,  -- the run
    "recorded" VARCHAR,  -- the execution that is the record
    "execution" VARCHAR,  -- the execution that was compared with it; NULL where there is none
    "path" VARCHAR,  -- the output's path; NULL where it is about the whole run
    "verdict" VARCHAR,  -- identical, equal, within tolerance, different or failed
    "reason" VARCHAR,  -- in a line; empty where they are identical
    "row" BIGINT,  -- the first row (or line) in which they differ, from 0
    "column" VARCHAR,  -- the column of that
    "recorded_value" VARCHAR,  -- the recorded value there
    "replayed_value" VARCHAR,  -- the value found there
    "max_abs" DOUBLE,  -- the greatest distance in that column, in its unit
    "max_rel" DOUBLE,  -- the greatest distance relative to the recorded number [1]
    "max_ulp" DOUBLE  -- the greatest distance in units in the last place [1]
);

-- Metrics that a replay compared over all runs of experiments that are not deterministic: two one-sided tests.
CREATE TABLE equivalences (
    "replay" VARCHAR,  -- the replay
    "experiment" VARCHAR,  -- the experiment
    "metric" VARCHAR,  -- the metric's name in [equivalence]
    "output" VARCHAR,  -- the output
    "column" VARCHAR,  -- the column of it
    "measure" VARCHAR,  -- what each run was reduced to
    "recorded_mean" DOUBLE,  -- the recorded mean, in the column's unit
    "replayed_mean" DOUBLE,  -- the mean found
    "n" BIGINT,  -- pairs of runs [1]
    "difference" DOUBLE,  -- the mean of the differences, run by run
    "low" DOUBLE,  -- the interval of confidence 1 - 2 alpha around it
    "high" DOUBLE,  -- its other end
    "margin" DOUBLE,  -- what the interval must lie within, on both sides of 0
    "alpha" DOUBLE,  -- the probability at most to find equivalent what is a margin apart [1]
    "p" DOUBLE,  -- the greater p value of the two tests [1]
    "power" DOUBLE,  -- the probability to find equivalent what is the same [1]
    "equivalent" BOOLEAN,  -- whether the interval lies within the margins
    "reason" VARCHAR  -- in a line
);

-- What was around executions, recorded once.
CREATE TABLE environments (
    "environment" VARCHAR,  -- hash of all below
    "host" VARCHAR,  -- host name
    "os" VARCHAR,  -- operating system, as it calls itself
    "kernel" VARCHAR,  -- the kernel's release
    "machine" VARCHAR,  -- the processor's architecture
    "cpu" VARCHAR,  -- the processor's model
    "cpu_flags" VARCHAR[],  -- the processor's features that change arithmetic or its speed, as avx2 and fma
    "cores" BIGINT,  -- cores that could be used [1]
    "memory" BIGINT,  -- main memory [bytes]
    "gpus" VARCHAR[],  -- graphics processors, by name or by the ids of vendor and device, each with its driver
    "libc" VARCHAR,  -- C library and its version
    "container" VARCHAR,  -- what SIERRA ran in, with its image where that could be told; NULL for no container
    "locale" VARCHAR,  -- SIERRA's locale; runs have the declared one
    "timezone" VARCHAR,  -- SIERRA's time zone; runs have the declared one
    "limits" VARCHAR,  -- limits of processes as JSON, soft and hard by name in bytes, seconds or pieces; null for none
    "modules" VARCHAR[],  -- environment modules that were loaded
    "variables" VARCHAR,  -- known variables that change results, and those in [environment] record, as JSON
    "python" VARCHAR,  -- version of the Python that ran SIERRA
    "sierra" VARCHAR,  -- SIERRA's version
    "distributions" VARCHAR,  -- what was installed where SIERRA ran, a line name==version each
    "lock" VARCHAR  -- SHA-256 of distributions
);

-- States of the code that runs were made from, recorded once.
CREATE TABLE sources (
    "source" VARCHAR,  -- hash of all below but files
    "tree" VARCHAR,  -- the tree that counts, as an SWHID
    "vcs" VARCHAR,  -- git, or none
    "commit" VARCHAR,  -- the commit checked out
    "branch" VARCHAR,  -- the branch checked out
    "dirty" BOOLEAN,  -- whether files that count differ from the commit; NULL outside git
    "remote" VARCHAR,  -- the remote's address, without credentials
    "described" VARCHAR,  -- the commit by the nearest tag, as git describe --always --dirty --tags has it
    "folder" VARCHAR,  -- the project's folder, from the root of the repository; . where it is the root
    "submodules" VARCHAR,  -- the repositories inside, as JSON: path and commit; NULL without any
    "files" VARCHAR  -- SHA-256 of the list of files in objects: a mode, a hash and a path a line
);

-- Files of sources outside git, by the hash that git gives them, which stands in the list of a source's files.
CREATE TABLE blobs (
    "blob" VARCHAR,  -- git's hash
    "sha256" VARCHAR  -- SHA-256 of the file; the file itself is in objects
);

-- What projects declared of outputs and success, so that another execution can be judged by the same rules.
CREATE TABLE ingest_rules (
    "ingest_rules" VARCHAR,  -- as in executions
    "declared" VARCHAR  -- the tables outputs and success of sierra.toml, as JSON
);

-- What executions depend on outside source and image: programs, libraries, Python distributions, files.
CREATE TABLE programs (
    "programs" VARCHAR,  -- hash of the set that was used together
    "name" VARCHAR,  -- as the command calls it; of a library, as the loader does; of what lies in the project or is mounted, {project}/… or {mount}/…
    "kind" VARCHAR,  -- program, library, distributions (what a Python has installed), file or link
    "version" VARCHAR,  -- of a program, the first line that it says of itself; of distributions, a line name==version each; else NULL
    "path" VARCHAR,  -- where it was found; of several folders, with : between them
    "sha256" VARCHAR  -- SHA-256 of the file; of distributions, of their names and versions, or of their content
);

-- Container images that runs were executed in, or were to be, recorded once.
CREATE TABLE images (
    "image" VARCHAR,  -- content identity: sha256: and the digest of an OCI image's configuration; squashfs: and that of a file system
    "kind" VARCHAR,  -- oci or squashfs
    "architecture" VARCHAR,  -- as OCI calls it: amd64, arm64, …; NULL where the image does not say
    "layers" VARCHAR[],  -- digests of the layers' files (OCI's diff_ids), from the lowest; none of a squashfs
    "name" VARCHAR,  -- as the project named it
    "file" VARCHAR,  -- where it was a file: its path, from the project's root if it lay there; NULL for a tag
    "sha256" VARCHAR,  -- SHA-256 of that file
    "squashfs" VARCHAR,  -- SHA-256 of the squashfs that SIERRA made of it for apptainer; NULL where it made none
    "manifests" VARCHAR,  -- digests of its manifests as JSON, by the form they were seen in: they differ by form
    "created" TIMESTAMP WITH TIME ZONE,  -- when it was made, as it says
    "labels" VARCHAR,  -- its labels, as JSON
    "variables" VARCHAR,  -- what it sets for its programs, as JSON
    "packages" VARCHAR,  -- what is installed, as JSON: by dpkg, apk and python, a list of name==version each
    "recipe" VARCHAR,  -- what is known of how it was made: a definition file, or a history
    "files" VARCHAR,  -- SHA-256 of the list of its files in objects: a JSON object a line, with path, type, size, sha256
    "size" BIGINT  -- size of its files [bytes]
);

-- Files by the hash of their content, in parts of 8 MiB at most; those of tables unless [store] raw is false.
CREATE TABLE objects (
    "sha256" VARCHAR,  -- SHA-256 of the whole file
    "part" BIGINT,  -- place of this part, from 0
    "size" BIGINT,  -- size of the whole file [bytes]
    "content" BLOB  -- the part's bytes
);

-- Runs, one row each; the independent variables are further columns.
CREATE TABLE runs (
    "run" VARCHAR,  -- the run's id
    "seed" BIGINT,  -- its seed
    "number" BIGINT,  -- its number in its experiment, from 0 (the least, where it belongs to several)
    "input" VARCHAR,  -- SHA-256 of its first input file; the file itself is in objects
    "spec" VARCHAR,  -- what it has in common with other runs
    "status" VARCHAR,  -- ok where an execution counts; else that of the last (stale if ok), missing if there is none
    "execution" VARCHAR,  -- the execution that counts for the batch last asked for
    "executions" BIGINT  -- how many times it was executed [1]
);

-- The execution that counts for a run in a batch: the last good one with the programs and by the rules of the batch's last asking. Statistics, figures and outputs see no other.
CREATE TABLE effective (
    "batch" VARCHAR,  -- the batch
    "ordinal" BIGINT,  -- the experiment's place in the batch, from 0
    "run" VARCHAR,  -- the run
    "execution" VARCHAR,  -- the execution
    "judgement" VARCHAR,  -- the judgement of it that counts, as in judged
    "submitted" TIMESTAMP WITH TIME ZONE,  -- when the batch was last asked for
    "lamport" BIGINT  -- the place of that in the logical order, as in sessions
);

-- Every judgement of every execution: the first, made when it was recorded, and those that were made anew.
CREATE TABLE all_judgements (
    "judgement" VARCHAR,  -- the judgement; the first has the id of its execution
    "judged_at" TIMESTAMP WITH TIME ZONE,  -- when
    "place" BIGINT,  -- its place in the logical order; that of the first judgement is the execution's
    "execution" VARCHAR,  -- the execution's id
    "run" VARCHAR,  -- the run
    "session" VARCHAR,  -- the asking that executed it
    "batch" VARCHAR,  -- the batch that it was executed for
    "started" TIMESTAMP WITH TIME ZONE,  -- when its program was started
    "ended" TIMESTAMP WITH TIME ZONE,  -- when its program had ended
    "status" VARCHAR,  -- ok, failed, timeout, memory, cpu, output, mismatch or interrupted; by this judgement
    "reason" VARCHAR,  -- why it is not ok, in a line; by this judgement
    "exit_code" BIGINT,  -- the program's exit status; NULL where a signal ended it
    "signal" BIGINT,  -- the signal that ended it
    "wall_s" DOUBLE,  -- from start to end [s]
    "user_s" DOUBLE,  -- CPU time in user mode, of all its processes that ended; in a container, as measured [s]
    "system_s" DOUBLE,  -- CPU time in the kernel, likewise [s]
    "max_rss_bytes" BIGINT,  -- greatest resident size of its greatest process (the worker's own size at least); in a container, as seen [bytes]
    "host" VARCHAR,  -- host name
    "slot" BIGINT,  -- the slot of the worker that executed it
    "result" VARCHAR,  -- Merkle hash of its outputs' names and digests
    "log_tail" VARCHAR,  -- the end of its standard error, or of its standard output where that is empty
    "environment" VARCHAR,  -- what was around it
    "programs" VARCHAR,  -- fingerprint of the programs outside source and image
    "ingest_rules" VARCHAR,  -- hash of what the project declares of outputs and success; by this judgement
    "purpose" VARCHAR,  -- run, or what else it was executed for; only those of run count in statistics
    "isolation" VARCHAR,  -- how it was contained; NULL where it was not
    "attempt" VARCHAR,  -- on a cluster, the attempt at an element in which it was executed; NULL elsewhere
    "lamport" BIGINT  -- its place in the logical order, as in sessions
);

-- The rows of artifacts by each judgement; artifacts has those of the last one alone.
CREATE TABLE all_artifacts (
    "execution" VARCHAR,  -- the judgement
    "run" VARCHAR,  -- the run
    "path" VARCHAR,  -- path in the output folder; for logs, stdout or stderr
    "kind" VARCHAR,  -- table, file or log
    "output" VARCHAR,  -- the declared or found output that it belongs to: the table's name
    "size" BIGINT,  -- its size [bytes]
    "sha256" VARCHAR,  -- SHA-256 of its bytes; of a log over 1 MiB, of what is kept of it, its beginning and end
    "rows" BIGINT,  -- rows it gave its table [1]
    "table_layout" VARCHAR,  -- what its table looks like, as JSON: its file, what each column holds, whether its last line is whole
    "counted_rows" BIGINT  -- rows that the file itself has, by a count that does not depend on how it was read [1]
);

-- Runs of which several good executions with the same programs, replays included, left other bytes.
CREATE TABLE nondeterminism (
    "run" VARCHAR,  -- the run
    "programs" VARCHAR,  -- fingerprint of the programs
    "executions" BIGINT,  -- good executions with these programs [1]
    "results" BIGINT,  -- how many results they have [1]
    "verdict" VARCHAR  -- the worst that a replay found: equal and within tolerance are as declared; NULL if only bytes are known
);

-- Where runs stand in the space of the independent variables, which are further columns; a run that belongs to experiments with different values of one variable has a row for each.
CREATE TABLE points (
    "run" VARCHAR,  -- the run
    "number" BIGINT  -- its least number in its experiments, from 0
);
