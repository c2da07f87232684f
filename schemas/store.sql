-- Batches: the ordered set of experiments that a query expands to.
CREATE TABLE batches (
    "batch" VARCHAR,  -- the batch's id: a Merkle hash over its experiments
    "created" TIMESTAMP WITH TIME ZONE,  -- when it was first submitted
    "query" VARCHAR,  -- the criteria as they were first submitted
    "axes" VARCHAR[],  -- names of the independent variables, in order
    "controller" VARCHAR,  -- the controller; NULL if none was named
    "scenario" VARCHAR,  -- the scenario; NULL if none was named
    "overrides" VARCHAR[],  -- the further values that were set for all runs, each as XPATH=VALUE
    "platform" VARCHAR,  -- the platform, which drives the simulator
    "experiments" BIGINT,  -- number of its experiments [1]
    "runs" BIGINT,  -- number of its runs in all experiments together [1]
    "base_seed" BIGINT,  -- the number that all seeds derive from
    "spec" VARCHAR,  -- the specification that all its runs share
    "template" VARCHAR,  -- the template's path in the project
    "template_sha256" VARCHAR,  -- SHA-256 of the template file
    "lamport" BIGINT  -- its position in the logical order, as in sessions
);

-- Points in the space of the independent variables; each variable is a further column here.
CREATE TABLE experiments (
    "experiment" VARCHAR,  -- the experiment's id: a Merkle hash over its values and runs
    "batch" VARCHAR,  -- the batch that it belongs to
    "ordinal" BIGINT  -- its position in the batch, from 0
);

-- The runs of each experiment of each batch; a run may belong to several.
CREATE TABLE batch_runs (
    "batch" VARCHAR,  -- the batch
    "ordinal" BIGINT,  -- the experiment's position in the batch, from 0
    "number" BIGINT,  -- the run's number in the experiment, from 0
    "run" VARCHAR,  -- the run
    "seed" BIGINT,  -- its seed
    "input" VARCHAR,  -- SHA-256 of its first input file; the file itself is in objects
    "other_inputs" VARCHAR[],  -- SHA-256 of its other input files, which specs.files names
    "spec" VARCHAR  -- the specification that it shares with the other runs of the batch
);

-- Run specifications, which runs share: a spec, inputs and a seed make a run.
CREATE TABLE specs (
    "spec" VARCHAR,  -- the spec's id
    "platform" VARCHAR,  -- the platform, which drives the simulator
    "command" VARCHAR[],  -- program and arguments, before paths of this machine are inserted
    "variables" VARCHAR,  -- declared environment variables, as JSON
    "source" VARCHAR,  -- the tree of the code (an SWHID); NULL if the runs have no source
    "image" VARCHAR,  -- content identity of the container image; NULL without one
    "host_access" VARCHAR[],  -- access of runs to the host, outside the image: network, gpu, each device and each mount
    "files" VARCHAR[],  -- names of the input files that each run gets
    "named_inputs" VARCHAR[],  -- those of the files that are part of the spec's id; NULL or empty: none
    "shared_files" VARCHAR,  -- the files beside the inputs, as in shared_files; NULL: none
    "around" VARCHAR,  -- services and the commands before and after the run's command, as JSON; NULL if there are none
    "robots" VARCHAR  -- commands of groups of places on robots that differ from command, as JSON; NULL for runs without robots
);

-- Executions of runs: when, where and by which programs each run was executed, and how it ended. If an execution was evaluated again by changed rules, status, reason and ingest_rules are those of the last evaluation; the table all_judgements has all evaluations.
CREATE TABLE executions (
    "execution" VARCHAR,  -- the execution's id
    "run" VARCHAR,  -- the run
    "session" VARCHAR,  -- the session that executed it
    "batch" VARCHAR,  -- the batch that it was executed for
    "started" TIMESTAMP WITH TIME ZONE,  -- when its program started
    "ended" TIMESTAMP WITH TIME ZONE,  -- when its program ended
    "status" VARCHAR,  -- ok, accepted (an end that [success] accept names), failed, timeout, memory, cpu, output, mismatch, stopped (by the operator), interrupted, or invalid (see trials)
    "reason" VARCHAR,  -- why the status is not ok, in one line; of an accepted end, this end
    "exit_code" BIGINT,  -- the program's exit status; NULL if a signal ended it
    "signal" BIGINT,  -- the signal that ended it; NULL if none did
    "wall_s" DOUBLE,  -- time from start to end [s]
    "user_s" DOUBLE,  -- CPU time in user mode of all its processes that ended; in a container, measured from outside [s]
    "system_s" DOUBLE,  -- CPU time in kernel mode, measured in the same way [s]
    "max_rss_bytes" BIGINT,  -- peak resident memory of its largest process (at least the worker's); in a container, measured from outside [bytes]
    "host" VARCHAR,  -- host name
    "slot" BIGINT,  -- the slot of the worker that executed it
    "result" VARCHAR,  -- Merkle hash of the names and digests of its outputs
    "log_tail" VARCHAR,  -- the end of its standard error, or of its standard output if standard error is empty
    "environment" VARCHAR,  -- the environment in which it ran
    "programs" VARCHAR,  -- fingerprint of the programs outside source and image
    "ingest_rules" VARCHAR,  -- hash of the rules by which it was evaluated: [outputs] and [success] of the project
    "purpose" VARCHAR,  -- run, replay or capture; only executions for run count in statistics
    "isolation" VARCHAR,  -- how it was isolated in a container; NULL if it was not
    "attempt" VARCHAR,  -- on a cluster, the attempt at an array task that executed it; NULL otherwise
    "lamport" BIGINT,  -- its position in the logical order, as in sessions
    "gpus" VARCHAR[],  -- the GPUs that it was given, by index or UUID; NULL or empty: none was given to it
    "gpu_limit" DOUBLE,  -- [limits] gpus by which it was given them; below 1 it was a share of one, and XLA_PYTHON_CLIENT_MEM_FRACTION was 0.9 times the share unless declared [1]
    "gpu_s" DOUBLE,  -- time in which its processes kept these GPUs busy, sampled each second; NULL if unknown (no NVML, MIG, in a shared container, or too short) [s]
    "gpu_memory_bytes" BIGINT  -- peak memory of its processes on GPUs, sampled in the same way; NULL if unknown [bytes]
);

-- Attempts on clusters: each time that an array task, which has a share of a batch's runs, was executed on a node.
CREATE TABLE attempts (
    "attempt" VARCHAR,  -- the attempt's id
    "session" VARCHAR,  -- the session that it belongs to
    "batch" VARCHAR,  -- the batch
    "array_task" BIGINT,  -- the index of the array task; a session with n array tasks gives each of them every n-th run
    "scheduler" VARCHAR,  -- the scheduler that started it, with its version
    "job" VARCHAR,  -- the scheduler's id of the job, or of this task of the job
    "node" VARCHAR,  -- host name of the node
    "started" TIMESTAMP WITH TIME ZONE,  -- when it started
    "ended" TIMESTAMP WITH TIME ZONE,  -- when it last recorded something
    "clock_offset_s" DOUBLE,  -- how far the node's clock was ahead of the shared file system's clock; if over 2 s, all times are by the file system's clock [s]
    "cpus" BIGINT,  -- cores that were allocated to it [1]
    "memory" BIGINT,  -- memory that was allocated to it; NULL if unknown [bytes]
    "gpus" VARCHAR,  -- GPUs that were allocated to it, by the scheduler's names
    "allocation" VARCHAR,  -- other facts that the scheduler reported on the node, as JSON
    "runs" BIGINT,  -- runs that it executed to their end [1]
    "interrupted_runs" BIGINT,  -- runs that it started and did not finish [1]
    "state" VARCHAR,  -- finished, or cut off
    "error" VARCHAR,  -- why it could not continue, as reported by itself or else by the scheduler
    "environment" VARCHAR  -- the environment in which it ran
);

-- Robots of executions: which robot had which place in a run, its host and its clock, and how its part ended. The view robot_clocks converts stamps of the robots to one time axis.
CREATE TABLE robots (
    "execution" VARCHAR,  -- the execution
    "place" BIGINT,  -- its place in the run: 1, 2, …; 0 is the base station
    "robot_group" VARCHAR,  -- the group of its place: robot, base, or a name in [robots.groups]
    "robot" VARCHAR,  -- the robot's name in the fleet
    "status" VARCHAR,  -- how its part ended: ok, failed, stopped, or lost
    "reason" VARCHAR,  -- what happened to it, in one line; NULL if nothing did
    "host" VARCHAR,  -- host name that it reported
    "machine" VARCHAR,  -- architecture of its processor, such as aarch64
    "processor" VARCHAR,  -- model of its processor
    "kernel" VARCHAR,  -- release and version of its kernel
    "boot_id" VARCHAR,  -- id of the boot of its kernel; another id shows that it was started again
    "environment" VARCHAR,  -- its environment, as in environments; NULL if none is recorded
    "firmware" VARCHAR,  -- the version of its firmware, as it was reported
    "calibration_sha256" VARCHAR,  -- SHA-256 of its calibration file
    "battery_start" DOUBLE,  -- charge of its battery before the run [%]
    "battery_end" DOUBLE,  -- charge of its battery after the run [%]
    "offset_start_ns" BIGINT,  -- its clock minus the clock of the submitting host, before the run [ns]
    "offset_end_ns" BIGINT,  -- its clock minus the clock of the submitting host, after the run [ns]
    "clock_start_ns" BIGINT,  -- its clock when the first offset was measured, since 1970-01-01 UTC [ns]
    "clock_end_ns" BIGINT,  -- its clock when the last offset was measured, since 1970-01-01 UTC [ns]
    "rtt_ns" BIGINT,  -- round-trip time of these measurements; offsets are uncertain by half of it [ns]
    "start_skew_ns" BIGINT,  -- start of its program minus the common start, by the submitting host's clock [ns]
    "started" TIMESTAMP WITH TIME ZONE,  -- when its program started, or the engine of its container if the image has no /bin/sh, by the submitting host's clock
    "ended" TIMESTAMP WITH TIME ZONE,  -- when its program ended, by the submitting host's clock
    "exit_code" BIGINT,  -- exit status of its program; NULL if a signal ended it or it is unknown
    "signal" BIGINT,  -- the signal that ended its program; NULL if none did
    "isolation" VARCHAR,  -- its isolation, as in isolations, with the version of its engine; NULL without a container
    "clock_remark" VARCHAR,  -- why its stamps cannot be converted: a clock was set during the run; NULL if they can
    "uneven_ns" BIGINT  -- largest error of a line through both offsets, because clocks did not move evenly; NULL without two [ns]
);

-- Supervised executions, each with the last remark on it; the table all_trials has all remarks. An execution whose last remark is that it is not valid has the status invalid. It counts nowhere, and its run is executed again.
CREATE TABLE trials (
    "execution" VARCHAR,  -- the execution
    "marked" TIMESTAMP WITH TIME ZONE,  -- when the remark was made
    "valid" BOOLEAN,  -- whether the trial counts; NULL if nobody decided, and then it counts
    "reason" VARCHAR,  -- why it is not valid, in one line
    "note" VARCHAR,  -- a free note
    "operator" VARCHAR,  -- who supervised it
    "block" BIGINT,  -- the block of the randomised order of trials, from 0
    "position" BIGINT,  -- its position in the order of trials, from 0
    "poses" VARCHAR,  -- the poses at which robots were placed, as JSON
    "arena" VARCHAR,  -- the name or version of the arena
    "order_rule" VARCHAR,  -- how the order of trials was made: blocked, random or as-designed
    "order_seed" BIGINT,  -- the number that the order derives from
    "stopped" BOOLEAN,  -- whether the operator stopped it; NULL if that is not known
    "facts" VARCHAR,  -- what declared commands printed before the trial, by name, as JSON
    "files" VARCHAR,  -- SHA-256 of declared files before the trial, by path, as JSON
    "lamport" BIGINT  -- position of the remark in the logical order, as in sessions
);

-- Runs that were executed once more than requested, because two attempts at one array task ran at the same time.
CREATE TABLE duplicates (
    "execution" VARCHAR,  -- the run's recorded execution: the one that was seen first
    "run" VARCHAR,  -- the run
    "attempt" VARCHAR,  -- the attempt that executed the copy
    "result" VARCHAR,  -- Merkle hash of the copy's outputs, as in executions
    "same" BOOLEAN  -- whether these outputs equal the recorded execution's
);

-- Isolations: how executions were isolated in containers, each recorded once.
CREATE TABLE isolations (
    "isolation" VARCHAR,  -- hash of all columns below
    "engine" VARCHAR,  -- the container engine
    "version" VARCHAR,  -- versions of the engine and of the program with which it starts containers
    "rootless" BOOLEAN,  -- whether the engine ran without root privileges
    "mode" VARCHAR,  -- run: one container for each run; worker: one container for all runs of a slot (weaker isolation)
    "image" VARCHAR,  -- content identity of the image
    "user" VARCHAR,  -- the user that a container's processes have on the host
    "network" VARCHAR,  -- none, host, not isolated (none was requested but is not possible here), or unknown
    "devices" VARCHAR[],  -- devices of the host that runs could use; gpu stands for NVIDIA GPUs
    "mounts" VARCHAR,  -- files and folders of the host that runs could read, as JSON: path in the container, path on the host
    "limits_asked" VARCHAR,  -- limits that were requested of the engine, as JSON: memory in bytes, cpus, pids
    "limits_enforced" VARCHAR,  -- limits that the engine enforces here; others are ignored, except memory, which the worker then monitors
    "argv" VARCHAR[]  -- the command that starts a container, without the parts that differ for each run
);

-- Later evaluations of recorded executions: by changed rules, from the recorded files, without executing anything.
CREATE TABLE judgements (
    "judgement" VARCHAR,  -- the judgement's id
    "execution" VARCHAR,  -- the execution
    "run" VARCHAR,  -- its run
    "session" VARCHAR,  -- the session that evaluated it again
    "batch" VARCHAR,  -- the batch for which it was evaluated
    "judged_at" TIMESTAMP WITH TIME ZONE,  -- when it was evaluated
    "status" VARCHAR,  -- as in executions
    "reason" VARCHAR,  -- why the status is not ok, in one line
    "ingest_rules" VARCHAR,  -- hash of the rules: [outputs] and [success] of the project
    "lamport" BIGINT  -- its position in the logical order, as in sessions
);

-- Problems that were found after an execution was recorded; from then on its status is not ok.
CREATE TABLE findings (
    "execution" VARCHAR,  -- the execution, or its judgement that is not ok
    "found_at" TIMESTAMP WITH TIME ZONE,  -- when the problem was found
    "status" VARCHAR,  -- the new status
    "reason" VARCHAR,  -- the reason, in one line
    "lamport" BIGINT  -- its position in the logical order, as in sessions
);

-- Files that executions left, and their logs, as they were last evaluated. A bag has a row for each of its tables, and an archive one for each file in it that became a table.
CREATE TABLE artifacts (
    "execution" VARCHAR,  -- the execution
    "run" VARCHAR,  -- the run
    "path" VARCHAR,  -- path in the output folder; for logs, stdout or stderr; late/PLACE/… for what a lost robot gave back later
    "kind" VARCHAR,  -- table, file or log; logs are no part of a result
    "output" VARCHAR,  -- the declared or detected output that it belongs to, which is the table's name
    "size" BIGINT,  -- its size [bytes]
    "sha256" VARCHAR,  -- SHA-256 of its bytes; of a log over 1 MiB, SHA-256 of the part that is kept: its beginning and end
    "rows" BIGINT,  -- rows that it added to its table [1]
    "table_layout" VARCHAR,  -- layout of its table, as JSON: its file, the type of each column, whether its last line is complete
    "counted_rows" BIGINT,  -- rows in the file itself, counted independently of the reader [1]
    "member" VARCHAR  -- the file in an archive that became the table; NULL: the file itself
);

-- Sessions: submissions of a query by one process, recorded when they end.
CREATE TABLE sessions (
    "session" VARCHAR,  -- the session's id
    "batch" VARCHAR,  -- the batch that was requested
    "query" VARCHAR,  -- the query as it was submitted
    "started" TIMESTAMP WITH TIME ZONE,  -- when the query was submitted
    "ended" TIMESTAMP WITH TIME ZONE,  -- when the session ended
    "runner" VARCHAR,  -- where runs were executed
    "engine" VARCHAR,  -- the container engine
    "slots" BIGINT,  -- runs at a time; on a cluster, those of all array tasks together, and NULL if it submitted none [1]
    "executed" BIGINT,  -- runs executed [1]
    "reexecuted" BIGINT,  -- runs among them that had been executed before [1]
    "reused" BIGINT,  -- runs whose recorded successful execution was reused [1]
    "failed" BIGINT,  -- runs of the batch that were executed and have no successful execution [1]
    "missing" BIGINT,  -- runs of the batch that were not executed [1]
    "interrupted" BOOLEAN,  -- whether the user interrupted it
    "sierra" VARCHAR,  -- SIERRA's version
    "environment" VARCHAR,  -- the environment in which it ran
    "source" VARCHAR,  -- the recorded state of the source; NULL if none is recorded
    "programs" VARCHAR,  -- fingerprint of the programs with which its runs were, or would have been, executed
    "ingest_rules" VARCHAR,  -- hash of the rules, as in executions
    "batch_rules" VARCHAR,  -- hash of the rules and of the allowed differences between runs of the batch (mismatch)
    "lamport" BIGINT,  -- its position in the logical order: a greater number is later, independent of clocks; old records have negative numbers, in the order of their times, and so come first
    "build" VARCHAR,  -- the build whose products its runs used, as in builds; NULL if there is no [build]
    "target" VARCHAR  -- the target that was requested; NULL if it was none
);

-- Builds: each time that the command of [build] was executed to make the products from the source.
CREATE TABLE builds (
    "build" VARCHAR,  -- the build's id: the hash of its inputs (the columns source to programs)
    "session" VARCHAR,  -- what executed it: a session of its own, or the replay
    "batch" VARCHAR,  -- the batch that it was executed for
    "purpose" VARCHAR,  -- run or replay
    "source" VARCHAR,  -- the tree of the code, as in specs
    "command" VARCHAR[],  -- program and arguments, before paths of this machine are inserted
    "folder" VARCHAR,  -- the folder in which it was executed, relative to the project
    "produces" VARCHAR[],  -- the patterns of its products, relative to the project
    "variables" VARCHAR,  -- declared environment variables, as JSON
    "image" VARCHAR,  -- content identity of the container image in which it was executed; NULL without one
    "host_access" VARCHAR[],  -- access to the host, as in specs
    "programs" VARCHAR,  -- fingerprint of the programs that it used, as in programs
    "host" VARCHAR,  -- host name
    "engine" VARCHAR,  -- the container engine
    "started" TIMESTAMP WITH TIME ZONE,  -- when its program started
    "ended" TIMESTAMP WITH TIME ZONE,  -- when its program ended
    "exit_code" BIGINT,  -- the program's exit status; NULL if a signal or the time limit ended it
    "reason" VARCHAR,  -- why it failed, in one line; NULL if it succeeded
    "compiler" VARCHAR,  -- first line of the version text of its compilers, or of its program; NULL if unknown
    "flags" VARCHAR,  -- declared variables that hold compilers and their flags, as JSON; NULL if there are none
    "result" VARCHAR,  -- Merkle hash of the names and digests of its products; NULL if it failed
    "log" VARCHAR,  -- SHA-256 of what it printed, which is in objects; if that is over 1 MiB, only its beginning and end are kept
    "lamport" BIGINT,  -- its position in the logical order, as in sessions
    "processors" VARCHAR[]  -- the processors that {arch} stands for, one after the other; NULL if the build does not use it
);

-- The products of builds: files of the project that its runs use; their content is not recorded.
CREATE TABLE build_products (
    "build" VARCHAR,  -- the build
    "session" VARCHAR,  -- what executed it, as in builds
    "name" VARCHAR,  -- the product's path in the project
    "size" BIGINT,  -- its size [bytes]
    "sha256" VARCHAR  -- SHA-256 of its bytes
);

-- Files of the project that lie beside the inputs in the folder of each run (`files` in `sierra.toml`).
CREATE TABLE shared_files (
    "shared" VARCHAR,  -- the set of files, as in specs
    "name" VARCHAR,  -- path of the file, in the project and in the folder of a run
    "sha256" VARCHAR,  -- SHA-256 of the file; the file itself is in objects
    "size" BIGINT,  -- its size [bytes]
    "executable" BOOLEAN  -- whether the owner may execute it
);

-- Replays: recorded runs that were executed again from the record alone, and compared with it.
CREATE TABLE replays (
    "replay" VARCHAR,  -- the replay's id, which is also the session of its executions
    "kind" VARCHAR,  -- the kind of record that was replayed: batch, experiment, run or execution
    "target" VARCHAR,  -- the id of the replayed record
    "batch" VARCHAR,  -- the batch that was replayed, or that contains the replayed record
    "started" TIMESTAMP WITH TIME ZONE,  -- when it was submitted
    "ended" TIMESTAMP WITH TIME ZONE,  -- when its verdict was known
    "runner" VARCHAR,  -- where runs were executed
    "engine" VARCHAR,  -- the container engine
    "runs" BIGINT,  -- runs compared [1]
    "verdict" VARCHAR,  -- identical, equal, within tolerance, equivalent, different or failed: the worst verdict of its experiments
    "tolerances" VARCHAR,  -- tolerances that were requested, as JSON: by output, by column; NULL if none were
    "environment" VARCHAR,  -- the environment in which it ran
    "programs" VARCHAR,  -- fingerprint of the programs with which it was executed
    "lamport" BIGINT  -- its position in the logical order, as in sessions
);

-- Verdicts: how far each output of a replayed run agrees with its record.
CREATE TABLE verdicts (
    "replay" VARCHAR,  -- the replay
    "run" VARCHAR,  -- the run
    "recorded" VARCHAR,  -- the recorded execution
    "execution" VARCHAR,  -- the execution that was compared with it; NULL if there is none
    "path" VARCHAR,  -- the output's path; NULL if the verdict is about the whole run
    "verdict" VARCHAR,  -- identical, equal, within tolerance, different or failed
    "reason" VARCHAR,  -- the reason in one line; empty if they are identical
    "row" BIGINT,  -- the first row (or line) in which they differ, from 0
    "column" VARCHAR,  -- the column of the first difference
    "recorded_value" VARCHAR,  -- the recorded value at the first difference
    "replayed_value" VARCHAR,  -- the replayed value at the first difference
    "max_abs" DOUBLE,  -- the greatest absolute difference in that column, in its unit
    "max_rel" DOUBLE,  -- the greatest difference relative to the recorded number [1]
    "max_ulp" DOUBLE  -- the greatest difference in units in the last place [1]
);

-- Metrics of nondeterministic experiments that a replay compared over all runs, by two one-sided tests (TOST).
CREATE TABLE equivalences (
    "replay" VARCHAR,  -- the replay
    "experiment" VARCHAR,  -- the experiment
    "metric" VARCHAR,  -- the metric's name in [equivalence]
    "output" VARCHAR,  -- the output
    "column" VARCHAR,  -- the column of the output
    "measure" VARCHAR,  -- how each run was reduced to one number
    "recorded_mean" DOUBLE,  -- the recorded mean, in the column's unit
    "replayed_mean" DOUBLE,  -- the replayed mean
    "n" BIGINT,  -- number of pairs of runs; NULL if the means were not compared [1]
    "difference" DOUBLE,  -- the mean of the differences between paired runs
    "low" DOUBLE,  -- lower end of the confidence interval (level 1 - 2 alpha) of the difference
    "high" DOUBLE,  -- upper end of the confidence interval
    "margin" DOUBLE,  -- the interval must lie between -margin and +margin
    "alpha" DOUBLE,  -- significance level: greatest probability of finding means equivalent that differ by the margin; NULL as n [1]
    "p" DOUBLE,  -- the greater p-value of the two tests [1]
    "power" DOUBLE,  -- power: probability of finding equal means equivalent [1]
    "equivalent" BOOLEAN,  -- whether the interval lies within the margins
    "reason" VARCHAR  -- the reason, in one line
);

-- Captures: measured runs that were executed once more with rendering, for their frames alone, and compared.
CREATE TABLE captures (
    "execution" VARCHAR,  -- the execution with rendering; its frames are among its artifacts
    "session" VARCHAR,  -- what executed it
    "batch" VARCHAR,  -- the batch for which it was executed
    "run" VARCHAR,  -- the run
    "recorded" VARCHAR,  -- the measured execution with which it was compared, or a later judgement of it
    "rendering" VARCHAR,  -- hash of its inputs, command, variables and services; the same rendering has the same hash
    "files" VARCHAR,  -- pattern of the names of its frames, relative to its output folder
    "frames" BIGINT,  -- number of frames that it left [1]
    "ticks_per_second" DOUBLE,  -- ticks, as the names of its frames have them, in a second of simulated time; NULL if unknown [1/s]
    "verdict" VARCHAR,  -- how far its other outputs agree with the measured ones: identical, equal, within tolerance, different or failed
    "reason" VARCHAR,  -- the reason in one line; empty if they are identical
    "lamport" BIGINT  -- its position in the logical order, as in sessions
);

-- Renderings of executions for capture, recorded before they begin: a finished one counts though its capture was killed.
CREATE TABLE renderings (
    "execution" VARCHAR,  -- the execution; it is not in executions if it has not finished
    "batch" VARCHAR,  -- the batch for which it is executed
    "run" VARCHAR,  -- the run
    "rendering" VARCHAR  -- hash of its rendering, as in captures
);

-- Environments of executions (operating system, hardware, libraries, variables), each recorded once.
CREATE TABLE environments (
    "environment" VARCHAR,  -- hash of all columns below
    "host" VARCHAR,  -- host name
    "os" VARCHAR,  -- operating system, by its own name
    "kernel" VARCHAR,  -- kernel release
    "machine" VARCHAR,  -- processor architecture
    "cpu" VARCHAR,  -- processor model
    "cpu_flags" VARCHAR[],  -- processor features that change arithmetic or its speed, such as avx2 and fma
    "cores" BIGINT,  -- usable cores [1]
    "memory" BIGINT,  -- main memory [bytes]
    "gpus" VARCHAR[],  -- GPUs, by name or by vendor and device ids, each with its driver
    "libc" VARCHAR,  -- C library and its version
    "container" VARCHAR,  -- the container in which SIERRA ran, with its image if known; NULL if in no container
    "locale" VARCHAR,  -- SIERRA's locale; runs use the declared one
    "timezone" VARCHAR,  -- SIERRA's time zone; runs use the declared one
    "limits" VARCHAR,  -- process limits (ulimit) as JSON, soft and hard by name, in bytes, seconds or numbers; null for no limit
    "modules" VARCHAR[],  -- environment modules that were loaded
    "variables" VARCHAR,  -- environment variables as JSON: those known to change results, and those in [environment] record
    "python" VARCHAR,  -- version of the Python that ran SIERRA, or its agent on a robot
    "sierra" VARCHAR,  -- SIERRA's version
    "distributions" VARCHAR,  -- Python distributions installed where SIERRA, or its agent on a robot, ran, one name==version per line
    "lock" VARCHAR,  -- SHA-256 of the column distributions
    "packages" VARCHAR,  -- packages of a robot's system, one name==version per line; NULL for other hosts
    "workspaces" VARCHAR  -- workspaces that a robot's setup line has sourced, one per line: folder, SHA-256 of its files, and commits of its repositories; NULL if there are none, and for other hosts
);

-- Sources: states of the code of runs, each recorded once.
CREATE TABLE sources (
    "source" VARCHAR,  -- hash of all columns below except files
    "tree" VARCHAR,  -- the tree of the code that identifies runs, as an SWHID
    "vcs" VARCHAR,  -- git, or none
    "commit" VARCHAR,  -- the commit that was checked out
    "branch" VARCHAR,  -- the branch that was checked out
    "dirty" BOOLEAN,  -- whether files of the tree differ from the commit; NULL outside git
    "remote" VARCHAR,  -- the remote's address, without credentials
    "described" VARCHAR,  -- the commit relative to the nearest tag, as given by git describe --always --dirty --tags
    "folder" VARCHAR,  -- the project's folder relative to the root of the repository; . if it is the root
    "submodules" VARCHAR,  -- submodules, as JSON: path and commit; NULL if there are none
    "files" VARCHAR  -- SHA-256 of the list of files, which is in objects: one mode, hash and path per line
);

-- Files of sources outside git, by the hash that git would give them; the list of a source's files has this hash.
CREATE TABLE blobs (
    "blob" VARCHAR,  -- git's hash of the file; in packages also the id of a submodule's commit, that of its tree (with its list of files), and the SHA-256 of data that git-lfs manages
    "sha256" VARCHAR  -- SHA-256 of the file; the file itself is in objects
);

-- The rules by which executions were evaluated, so that other executions can be evaluated by the same rules.
CREATE TABLE ingest_rules (
    "ingest_rules" VARCHAR,  -- hash of the rules, as in executions
    "declared" VARCHAR  -- the tables [outputs] and [success] of sierra.toml, as JSON
);

-- Dependencies of executions outside source and image: programs, libraries, Python distributions, files.
CREATE TABLE programs (
    "programs" VARCHAR,  -- fingerprint of the set of programs that was used together
    "name" VARCHAR,  -- the name that the command uses; for a library, the name that the loader uses; for a file in the project or in a mount, {project}/… or {mount}/…
    "kind" VARCHAR,  -- program, library, distributions (packages installed for a Python), file or link
    "version" VARCHAR,  -- for a program, the first line of its version text; for distributions, one name==version per line; else NULL
    "path" VARCHAR,  -- where it was found; several folders are separated by :
    "sha256" VARCHAR  -- SHA-256 of the file; for distributions, of their names and versions, or of their content
);

-- Observations of executions: how it was found out which files they used. Not every execution is observed.
CREATE TABLE observations (
    "execution" VARCHAR,  -- the execution
    "files" VARCHAR,  -- the set of files that it executed, read, looked for or listed, as in files_read
    "method" VARCHAR,  -- the program or the interface by which they were seen; none if the run could not be observed, collected if another system executed it
    "reason" VARCHAR,  -- why it may have used other files too, in one line; NULL if all were seen
    "notes" VARCHAR[],  -- what cannot be seen: files that a service or another machine may have read for it
    "distributions" VARCHAR[]  -- Python distributions whose files it used, as name==version, those of which it used most bytes first
);

-- Sets of files that executions used, outside their own folders; executions that used the same files share one.
CREATE TABLE files_read (
    "files" VARCHAR,  -- the set: a hash of the columns path, use and sha256
    "path" VARCHAR,  -- its path; {project}, {home} and {prefix} (a Python virtual environment) stand for folders, {gpu} for GPUs and drivers
    "use" VARCHAR,  -- executed, read, found (it was only looked for), missed (looked for and absent), listed (a folder whose names were read), linked (a link to a file that was read), link (any other link that was followed)
    "sha256" VARCHAR,  -- SHA-256 of its content (in a virtual environment, without the environment's own path), of the names in the folder, or of the path that the link leads to; NULL if it has none
    "size" BIGINT  -- its size [bytes]
);

-- Names in the folders that executions listed, without Python's caches and what the execution had written itself.
CREATE TABLE listings (
    "sha256" VARCHAR,  -- the SHA-256 of these names, as in files_read
    "names" VARCHAR[]  -- the names, sorted
);

-- Files that executions wrote, but not among their outputs, or removed outside their own folders.
CREATE TABLE files_written (
    "execution" VARCHAR,  -- the execution
    "path" VARCHAR,  -- its path, as in files_read; outside the run's own folder {run}, it is known of observed runs only
    "use" VARCHAR  -- written, removed, or reread (written and read again, so that other executions may have written it meanwhile); reread_new if the execution made the name itself, or a folder above it, and had not removed it before
);

-- Ports that executions were given, and ports, sockets, groups, shared memory and queues that observed ones used.
CREATE TABLE channels (
    "execution" VARCHAR,  -- the execution
    "name" VARCHAR,  -- its name: 127.0.0.1:PORT for any address of the host, with /udp for UDP; GROUP:PORT/udp; @NAME for an abstract Unix socket; the path of another one, as in files_read; or `shared memory KEY`, `semaphore KEY`, `message queue KEY`
    "use" VARCHAR  -- given (by {port}); listened; reused (listened with an option by which others may have the same name at the same time, or something that belongs to all); in_use (another program had it); searched (the same, but then the process chose another one); connected (to a server that is not the execution's own)
);

-- Remarks on how executions ended, beside their status.
CREATE TABLE endings (
    "execution" VARCHAR,  -- the execution
    "kind" VARCHAR,  -- left running (a process that still ran when the command had ended, and was ended), error (the error message with which standard error of a successful execution ends), error on stdout (the same, if it printed nothing on standard error), after marker (it was ended because its marker was met) or resumed (it continued from the checkpoint of an execution that was cut off)
    "text" VARCHAR  -- the process: its program and the first words; the error message; the seconds from marker to end; {checkpoint}
);

-- Sessions whose executions do not count in a later session's batch, because files that they used have changed.
CREATE TABLE stale_sessions (
    "session" VARCHAR,  -- the later session
    "stale" VARCHAR,  -- the session whose executions do not count
    "path" VARCHAR  -- one of the files that have changed, as in files_read
);

-- Executions that a session reused although something has changed, because no file that they used has. Each of them, or others of its experiment, were observed: files_read has the files. What differs is in unused_changes.
CREATE TABLE reused_executions (
    "session" VARCHAR,  -- the session that reused it
    "run" VARCHAR,  -- the run that it counts for; it has the input, seed and command of the run that was executed
    "execution" VARCHAR  -- the execution, perhaps of another run: one with another source
);

-- Files that differ between reused executions and the session that reused them, and that these executions did not use.
CREATE TABLE unused_changes (
    "session" VARCHAR,  -- the session that reused the executions
    "spec" VARCHAR,  -- the run specification of the executions
    "programs" VARCHAR,  -- the programs of the executions
    "name" VARCHAR  -- the file as in files_read, or the program as in programs
);

-- Container images in which runs were, or would have been, executed, each recorded once.
CREATE TABLE images (
    "image" VARCHAR,  -- content identity: sha256: and the digest of an OCI image's configuration; squashfs: and that of a file system; variants: and the hash of the images in the column variants
    "kind" VARCHAR,  -- oci or squashfs; variants for images for several processors
    "architecture" VARCHAR,  -- the OCI name: amd64, arm64, …; NULL if the image does not state it
    "layers" VARCHAR[],  -- digests of the layers' files (OCI's diff_ids), lowest layer first; empty for a squashfs
    "name" VARCHAR,  -- the name that the project uses
    "file" VARCHAR,  -- path of the image file, relative to the project's root if it is in the project; NULL for a tag
    "sha256" VARCHAR,  -- SHA-256 of that file
    "squashfs" VARCHAR,  -- SHA-256 of the squashfs that SIERRA made from it for apptainer; NULL if it made none
    "manifests" VARCHAR,  -- digests of its manifests as JSON, by the form in which they were seen; each form has another digest
    "created" TIMESTAMP WITH TIME ZONE,  -- when it was created, as the image states
    "labels" VARCHAR,  -- its labels, as JSON
    "variables" VARCHAR,  -- environment variables that it sets for its programs, as JSON
    "packages" VARCHAR,  -- installed packages, as JSON: for each of dpkg, apk and python a list of name==version
    "recipe" VARCHAR,  -- how it was made, if known: a definition file, or a history
    "files" VARCHAR,  -- SHA-256 of the list of its files, which is in objects: one JSON object per line with path, type, size, sha256; NULL for variants
    "size" BIGINT,  -- total size of its files; 0 for variants, whose images have rows of their own [bytes]
    "variants" VARCHAR[]  -- the images for several processors that one name with {arch} stands for, each as PROCESSOR=IMAGE; NULL for one image
);

-- Deliverables: figures, tables, videos and reports made from the store, with a row each time that one has changed.
CREATE TABLE deliverables (
    "deliverable" VARCHAR,  -- hash of all columns below except made and lamport
    "batch" VARCHAR,  -- the batch that it was made for
    "batches" VARCHAR[],  -- the batches whose data it shows
    "kind" VARCHAR,  -- figure, table, comparison, video or report
    "name" VARCHAR,  -- its name
    "definition" VARCHAR,  -- what it shows and how, with labels, units and notes, as JSON
    "sql" VARCHAR,  -- the SQL that computed its data
    "data" VARCHAR,  -- hash of the data that it shows
    "files" VARCHAR[],  -- its files, relative to the project
    "sha256s" VARCHAR[],  -- SHA-256 of each of these files
    "made_by" VARCHAR[],  -- SIERRA and the libraries that made it, as name==version
    "made" TIMESTAMP WITH TIME ZONE,  -- when it was made
    "lamport" BIGINT  -- position in the logical order, as in sessions
);

-- Sequential studies: a query, a rule about intervals, and the schedule of looks, recorded before the first look.
CREATE TABLE studies (
    "study" VARCHAR,  -- hash of the columns batch, rule, schedule, alpha and correction
    "batch" VARCHAR,  -- the batch of the first look
    "query" VARCHAR,  -- the criteria, in full
    "rule" VARCHAR,  -- when to stop, as in ci(coverage) < 0.02: half of the interval's width, in every experiment
    "schedule" VARCHAR,  -- the runs per experiment at each look, as a JSON list; fixed before the first look
    "alpha" DOUBLE,  -- the probability that an interval misses the true value at any of the looks [1]
    "correction" VARCHAR,  -- the correction for looking: bonferroni (level 1 - alpha / looks at each look)
    "begun" TIMESTAMP WITH TIME ZONE,  -- when it began
    "lamport" BIGINT  -- position in the logical order, as in sessions
);

-- Looks of studies at the data, each with the decision that was made.
CREATE TABLE looks (
    "look" VARCHAR,  -- hash of the columns study to reason and of its intervals
    "study" VARCHAR,  -- the study
    "number" BIGINT,  -- the look's number in the schedule, from 1
    "batch" VARCHAR,  -- the batch whose runs it looked at
    "runs" BIGINT,  -- runs per experiment, also those that failed [1]
    "level" DOUBLE,  -- confidence of its intervals, corrected for all looks of the schedule [1]
    "decision" VARCHAR,  -- reached, continue, not reached (at the last look), or stopped (an experiment has no successful run; the look may be repeated)
    "reason" VARCHAR,  -- the reason, in one line
    "decided" TIMESTAMP WITH TIME ZONE,  -- when it was made
    "lamport" BIGINT  -- position in the logical order, as in sessions
);

-- Intervals that looks saw: one for each condition of the rule and each experiment.
CREATE TABLE look_intervals (
    "look" VARCHAR,  -- the look
    "condition" VARCHAR,  -- the condition, as in the rule
    "ordinal" BIGINT,  -- the experiment's position in the batch, from 0
    "n" BIGINT,  -- runs with a value [1]
    "value" DOUBLE,  -- the statistic, in the column's unit; NULL without a run
    "low" DOUBLE,  -- lower end of the interval; NULL if there is none
    "high" DOUBLE,  -- upper end of the interval
    "method" VARCHAR,  -- the method of the interval; NULL if there is none
    "half_width" DOUBLE,  -- half of the interval's width
    "wanted" DOUBLE,  -- the half-width below which the condition holds; NULL if there is none
    "holds" BOOLEAN,  -- whether the condition holds
    "needed" BIGINT  -- estimated runs with which it would hold; NULL if it holds, or if there is no estimate [1]
);

-- Registered claims: the text of each claim of sierra.toml, recorded when it was first seen. A claim is planned if all executions that count for it belong to sessions with higher Lamport numbers.
CREATE TABLE registered_claims (
    "claim" VARCHAR,  -- hash of the column text
    "session" VARCHAR,  -- the session that recorded it, which has no row in sessions
    "name" VARCHAR,  -- its name in sierra.toml when it was recorded
    "text" VARCHAR,  -- its sentence, its queries with their runs, and how it is decided, in normal form, as JSON
    "registered" TIMESTAMP WITH TIME ZONE,  -- when it was recorded
    "lamport" BIGINT  -- position in the logical order, as in sessions
);

-- Imported packages, whose records were made in other stores.
CREATE TABLE imports (
    "package" VARCHAR,  -- the package's id: a hash over the names and hashes of its files
    "title" VARCHAR,  -- its title
    "date" VARCHAR,  -- its date of publication, as it states it
    "batches" VARCHAR[],  -- the batches that it has, those that were in the store before included
    "imported_at" TIMESTAMP WITH TIME ZONE,  -- when it was first imported
    "lamport" BIGINT  -- position of the import in the logical order, as in sessions
);

-- Sessions that came in packages: their executions were not made here.
CREATE TABLE imported_sessions (
    "session" VARCHAR,  -- the session
    "batch" VARCHAR,  -- the batch that was requested; empty if the session registered claims
    "packages" VARCHAR[],  -- the package that was imported, as in imports; then the package from which that one had the session, and so on
    "lamport" BIGINT  -- position of the import in the logical order, as in sessions
);

-- Redactions: sessions whose records were rewritten for an anonymous package. Hosts, folders, commits, times and parts of environments in these records are not the original ones; ids of runs, seeds, durations and outputs are.
CREATE TABLE redactions (
    "session" VARCHAR,  -- the session; for a replay, the replay
    "batch" VARCHAR,  -- the batch that its records belong to; empty for registered claims
    "rules" VARCHAR  -- the version of the rules by which the records were rewritten
);

-- Recorded files by the hash of their content, in parts of at most 8 MiB; files that became tables are included unless [store] raw is false.
CREATE TABLE objects (
    "sha256" VARCHAR,  -- SHA-256 of the whole file
    "part" BIGINT,  -- position of this part, from 0
    "size" BIGINT,  -- size of the whole file [bytes]
    "content" BLOB  -- the part's bytes
);

-- Runs, one row each; the independent variables are further columns.
CREATE TABLE runs (
    "run" VARCHAR,  -- the run's id
    "seed" BIGINT,  -- its seed
    "number" BIGINT,  -- its number in its experiment, from 0; the smallest number if it belongs to several experiments
    "input" VARCHAR,  -- SHA-256 of its first input file; the file itself is in objects
    "spec" VARCHAR,  -- the specification that it shares with other runs
    "status" VARCHAR,  -- ok or accepted if it has an effective execution; otherwise the status of its last execution (stale if that is ok or accepted); missing if there is none
    "outcome" VARCHAR,  -- success, or the end that [success] accept names, such as exit 3; NULL without an effective execution
    "execution" VARCHAR,  -- its effective execution in the batch that was submitted last; batches that were executed here come first
    "executions" BIGINT  -- number of its executions, without captures [1]
);

-- The effective execution of each run in each batch: the last one with a result by the programs and rules of the batch's last session. Statistics, figures and outputs use no other execution. If a batch was executed here, only executions that were made here count in it; otherwise only those of the package that was imported first.
CREATE TABLE effective (
    "batch" VARCHAR,  -- the batch
    "ordinal" BIGINT,  -- the experiment's position in the batch, from 0
    "run" VARCHAR,  -- the run
    "execution" VARCHAR,  -- the execution
    "judgement" VARCHAR,  -- the effective judgement of that execution, as in all_judgements
    "submitted" TIMESTAMP WITH TIME ZONE,  -- when the batch was last submitted
    "lamport" BIGINT,  -- position of that session in the logical order, as in sessions
    "outcome" VARCHAR  -- success, or the end that [success] accept names, such as exit 3
);

-- The execution of each run in each batch that a replay repeats: the effective one or, if there is none, the last one with the programs and rules of the batch's last session whose program has ended with an error.
CREATE TABLE ended (
    "batch" VARCHAR,  -- the batch
    "ordinal" BIGINT,  -- the experiment's position in the batch, from 0
    "run" VARCHAR,  -- the run
    "execution" VARCHAR,  -- the execution
    "judgement" VARCHAR,  -- the judgement of that execution, as in all_judgements
    "status" VARCHAR  -- its status by this judgement
);

-- All judgements of executions: the first, made when the execution was recorded, and later ones by changed rules.
CREATE TABLE all_judgements (
    "judgement" VARCHAR,  -- the judgement; the first one has the id of its execution
    "judged_at" TIMESTAMP WITH TIME ZONE,  -- when it was evaluated
    "place" BIGINT,  -- its position in the logical order; the first judgement has the position of its execution
    "execution" VARCHAR,  -- the execution's id
    "run" VARCHAR,  -- the run
    "session" VARCHAR,  -- the session that executed it
    "batch" VARCHAR,  -- the batch that it was executed for
    "started" TIMESTAMP WITH TIME ZONE,  -- when its program started
    "ended" TIMESTAMP WITH TIME ZONE,  -- when its program ended
    "status" VARCHAR,  -- ok, accepted (an end that [success] accept names), failed, timeout, memory, cpu, output, mismatch, stopped (by the operator), interrupted, or invalid (see trials); by this judgement
    "reason" VARCHAR,  -- why the status is not ok, in one line; of an accepted end, this end; by this judgement
    "exit_code" BIGINT,  -- the program's exit status; NULL if a signal ended it
    "signal" BIGINT,  -- the signal that ended it; NULL if none did
    "wall_s" DOUBLE,  -- time from start to end [s]
    "user_s" DOUBLE,  -- CPU time in user mode of all its processes that ended; in a container, measured from outside [s]
    "system_s" DOUBLE,  -- CPU time in kernel mode, measured in the same way [s]
    "max_rss_bytes" BIGINT,  -- peak resident memory of its largest process (at least the worker's); in a container, measured from outside [bytes]
    "host" VARCHAR,  -- host name
    "slot" BIGINT,  -- the slot of the worker that executed it
    "result" VARCHAR,  -- Merkle hash of the names and digests of its outputs
    "log_tail" VARCHAR,  -- the end of its standard error, or of its standard output if standard error is empty
    "environment" VARCHAR,  -- the environment in which it ran
    "programs" VARCHAR,  -- fingerprint of the programs outside source and image
    "ingest_rules" VARCHAR,  -- hash of the rules by which it was evaluated: [outputs] and [success] of the project; by this judgement
    "purpose" VARCHAR,  -- run, replay or capture; only executions for run count in statistics
    "isolation" VARCHAR,  -- how it was isolated in a container; NULL if it was not
    "attempt" VARCHAR,  -- on a cluster, the attempt at an array task that executed it; NULL otherwise
    "lamport" BIGINT,  -- its position in the logical order, as in sessions
    "gpus" VARCHAR[],  -- the GPUs that it was given, by index or UUID; NULL or empty: none was given to it
    "gpu_limit" DOUBLE,  -- [limits] gpus by which it was given them; below 1 it was a share of one, and XLA_PYTHON_CLIENT_MEM_FRACTION was 0.9 times the share unless declared [1]
    "gpu_s" DOUBLE,  -- time in which its processes kept these GPUs busy, sampled each second; NULL if unknown (no NVML, MIG, in a shared container, or too short) [s]
    "gpu_memory_bytes" BIGINT,  -- peak memory of its processes on GPUs, sampled in the same way; NULL if unknown [bytes]
    "packages" VARCHAR[]  -- packages in which the execution came, as in imported_sessions; NULL if it was made here
);

-- All judgements of executions, by the run that they may count for: their own run, and each run for which a session reused them.
CREATE TABLE all_candidates (
    "reusing" VARCHAR,  -- the session that reused the execution (see reused_executions); NULL for its own run
    "judgement" VARCHAR,  -- the judgement, as in all_judgements
    "judged_at" TIMESTAMP WITH TIME ZONE,  -- when it was evaluated
    "place" BIGINT,  -- its position in the logical order, as in all_judgements
    "execution" VARCHAR,  -- the execution's id
    "run" VARCHAR,  -- the run that it may count for
    "session" VARCHAR,  -- the session that executed it
    "batch" VARCHAR,  -- the batch that it was executed for
    "started" TIMESTAMP WITH TIME ZONE,  -- when its program started
    "ended" TIMESTAMP WITH TIME ZONE,  -- when its program ended
    "status" VARCHAR,  -- ok, accepted (an end that [success] accept names), failed, timeout, memory, cpu, output, mismatch, stopped (by the operator), interrupted, or invalid (see trials)
    "reason" VARCHAR,  -- why the status is not ok, in one line; of an accepted end, this end
    "exit_code" BIGINT,  -- the program's exit status; NULL if a signal ended it
    "signal" BIGINT,  -- the signal that ended it; NULL if none did
    "wall_s" DOUBLE,  -- time from start to end
    "user_s" DOUBLE,  -- CPU time in user mode of all its processes that ended; in a container, measured from outside
    "system_s" DOUBLE,  -- CPU time in kernel mode, measured in the same way
    "max_rss_bytes" BIGINT,  -- peak resident memory of its largest process (at least the worker's); in a container, measured from outside
    "host" VARCHAR,  -- host name
    "slot" BIGINT,  -- the slot of the worker that executed it
    "result" VARCHAR,  -- Merkle hash of the names and digests of its outputs
    "log_tail" VARCHAR,  -- the end of its standard error, or of its standard output if standard error is empty
    "environment" VARCHAR,  -- the environment in which it ran
    "programs" VARCHAR,  -- fingerprint of the programs outside source and image
    "ingest_rules" VARCHAR,  -- hash of the rules by which it was evaluated: [outputs] and [success] of the project
    "purpose" VARCHAR,  -- run, replay or capture; only executions for run count in statistics
    "isolation" VARCHAR,  -- how it was isolated in a container; NULL if it was not
    "attempt" VARCHAR,  -- on a cluster, the attempt at an array task that executed it; NULL otherwise
    "lamport" BIGINT,  -- its position in the logical order, as in sessions
    "gpus" VARCHAR[],  -- the GPUs that it was given, by index or UUID; NULL or empty: none was given to it
    "gpu_limit" DOUBLE,  -- [limits] gpus by which it was given them; below 1 it was a share of one, and XLA_PYTHON_CLIENT_MEM_FRACTION was 0.9 times the share unless declared
    "gpu_s" DOUBLE,  -- time in which its processes kept these GPUs busy, sampled each second; NULL if unknown (no NVML, MIG, in a shared container, or too short)
    "gpu_memory_bytes" BIGINT,  -- peak memory of its processes on GPUs, sampled in the same way; NULL if unknown
    "packages" VARCHAR[]  -- packages in which the execution came, as in imported_sessions; NULL if it was made here
);

-- All sessions, those included that stand beside others: sessions that came in packages, of batches that were also executed here or came in an earlier package. The table sessions does not have these.
CREATE TABLE all_sessions (
    "session" VARCHAR,  -- the session's id
    "batch" VARCHAR,  -- the batch that was requested
    "query" VARCHAR,  -- the query as it was submitted
    "started" TIMESTAMP WITH TIME ZONE,  -- when the query was submitted
    "ended" TIMESTAMP WITH TIME ZONE,  -- when the session ended
    "runner" VARCHAR,  -- where runs were executed
    "engine" VARCHAR,  -- the container engine
    "slots" BIGINT,  -- runs at a time; on a cluster, those of all array tasks together, and NULL if it submitted none [1]
    "executed" BIGINT,  -- runs executed [1]
    "reexecuted" BIGINT,  -- runs among them that had been executed before [1]
    "reused" BIGINT,  -- runs whose recorded successful execution was reused [1]
    "failed" BIGINT,  -- runs of the batch that were executed and have no successful execution [1]
    "missing" BIGINT,  -- runs of the batch that were not executed [1]
    "interrupted" BOOLEAN,  -- whether the user interrupted it
    "sierra" VARCHAR,  -- SIERRA's version
    "environment" VARCHAR,  -- the environment in which it ran
    "source" VARCHAR,  -- the recorded state of the source; NULL if none is recorded
    "programs" VARCHAR,  -- fingerprint of the programs with which its runs were, or would have been, executed
    "ingest_rules" VARCHAR,  -- hash of the rules, as in executions
    "batch_rules" VARCHAR,  -- hash of the rules and of the allowed differences between runs of the batch (mismatch)
    "lamport" BIGINT,  -- its position in the logical order: a greater number is later, independent of clocks; old records have negative numbers, in the order of their times, and so come first
    "build" VARCHAR,  -- the build whose products its runs used, as in builds; NULL if there is no [build]
    "target" VARCHAR  -- the target that was requested; NULL if it was none
);

-- All remarks on supervised executions, also those that later ones replace. The table trials has the last ones.
CREATE TABLE all_trials (
    "execution" VARCHAR,  -- the execution
    "marked" TIMESTAMP WITH TIME ZONE,  -- when the remark was made
    "valid" BOOLEAN,  -- whether the trial counts; NULL if nobody decided, and then it counts
    "reason" VARCHAR,  -- why it is not valid, in one line
    "note" VARCHAR,  -- a free note
    "operator" VARCHAR,  -- who supervised it
    "block" BIGINT,  -- the block of the randomised order of trials, from 0
    "position" BIGINT,  -- its position in the order of trials, from 0
    "poses" VARCHAR,  -- the poses at which robots were placed, as JSON
    "arena" VARCHAR,  -- the name or version of the arena
    "order_rule" VARCHAR,  -- how the order of trials was made: blocked, random or as-designed
    "order_seed" BIGINT,  -- the number that the order derives from
    "stopped" BOOLEAN,  -- whether the operator stopped it; NULL if that is not known
    "facts" VARCHAR,  -- what declared commands printed before the trial, by name, as JSON
    "files" VARCHAR,  -- SHA-256 of declared files before the trial, by path, as JSON
    "lamport" BIGINT  -- position of the remark in the logical order, as in sessions
);

-- Batches with imported sessions, and the origin that counts in each: this store, or a package.
CREATE TABLE origins (
    "batch" VARCHAR,  -- the batch
    "packages" VARCHAR[]  -- packages as in imported_sessions; NULL if executions that were made here count
);

-- Artifacts by each judgement; the table artifacts has only those by the last judgement.
CREATE TABLE all_artifacts (
    "execution" VARCHAR,  -- the judgement
    "run" VARCHAR,  -- the run
    "path" VARCHAR,  -- path in the output folder; for logs, stdout or stderr; late/PLACE/… for what a lost robot gave back later
    "kind" VARCHAR,  -- table, file or log; logs are no part of a result
    "output" VARCHAR,  -- the declared or detected output that it belongs to, which is the table's name
    "size" BIGINT,  -- its size [bytes]
    "sha256" VARCHAR,  -- SHA-256 of its bytes; of a log over 1 MiB, SHA-256 of the part that is kept: its beginning and end
    "rows" BIGINT,  -- rows that it added to its table [1]
    "table_layout" VARCHAR,  -- layout of its table, as JSON: its file, the type of each column, whether its last line is complete
    "counted_rows" BIGINT,  -- rows in the file itself, counted independently of the reader [1]
    "member" VARCHAR  -- the file in an archive that became the table; NULL: the file itself
);

-- Runs whose output changed between successful executions with the same programs, replays included and imported executions not.
CREATE TABLE nondeterminism (
    "run" VARCHAR,  -- the run
    "programs" VARCHAR,  -- fingerprint of the programs
    "executions" BIGINT,  -- successful executions with these programs [1]
    "results" BIGINT,  -- number of different results [1]
    "verdict" VARCHAR  -- the worst verdict of a replay (equal, within tolerance: by the declared rules); NULL if only bytes are known
);

-- Clocks of robots. A robot's stamp (ns since 1970-01-01 UTC) becomes one of the submitting host: stamp - offset_ns - round(drift * (stamp - clock_ns))::BIGINT
CREATE TABLE robot_clocks (
    "execution" VARCHAR,  -- the execution
    "place" BIGINT,  -- the robot's place in the run, as in robots
    "clock_ns" BIGINT,  -- its clock when the first offset was measured [ns]
    "offset_ns" BIGINT,  -- its clock minus the clock of the submitting host at that time [ns]
    "drift" DOUBLE,  -- how much the offset grows per second of its clock; NULL without a second measurement, and with a remark [s/s]
    "uncertainty_ns" DOUBLE,  -- largest error of converted stamps: half of the round-trip time of the measurements, and how unevenly both clocks have moved between them; NULL if there is only one measurement [ns]
    "remark" VARCHAR  -- why stamps cannot be converted: a clock was set during the run; NULL if they can
);

-- Runs with the values of the independent variables, which are further columns. A run that belongs to experiments with different values of one variable has a row for each value.
CREATE TABLE points (
    "run" VARCHAR,  -- the run
    "number" BIGINT  -- its smallest number in its experiments, from 0
);
