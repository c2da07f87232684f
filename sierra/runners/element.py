"""What a task of a cluster starts on its node: it executes the runs of one element by the worker, and packs what they leave.

    python3 -I -S FOLDER/element.py FOLDER INDEX

Three files on the standard library alone (Python 3.8 or newer) lie in the session's folder, FOLDER, on the file system that
nodes and login nodes share: this one, `worker.py`, which executes, and `machine.py`, which says what a node is. Beside them:

    element.json            what all elements of the session have in common: see `Settings`
    elements/INDEX.jobs     the element's jobs: gzip, lines of JSON; the first is what the others have in common
    results/INDEX.<attempt>.pack    what one attempt at the element has recorded
    cancelled               where it is there, nothing more is begun

An *attempt* is one time that an element is executed: a task may be requeued, its node may be lost, and the first copy may
live on beside the second. So each attempt writes into a file of its own, made with O_EXCL, and begins with reading what
other attempts at its element have recorded: it executes only what is missing. Runs execute in a folder of the node's own
(`scratch`), which is removed at the end; nothing but packs is written to the shared side, and locks are not needed there.

A pack is only ever appended to. It is a sequence of records: a line of JSON, and where that has a `size`, as many bytes and a
line feed after it. What is not there as a whole, to the last line feed, is not there yet; nothing follows it but in the
writer's memory. A record that can't be written whole is taken back (truncated), and the attempt ends. Events:

    attempt     first, once: attempt, session, element, job, node, started, cpus, memory (bytes), gpus, allocation (the
                scheduler's variables), facts (`machine.facts`), variables (those that `record` names), python
    start       a run has begun: execution, time
    end         a run has ended, by itself or by a limit: all fields of sierra.model.Result but `directory`, `attempt`
                and `environment`; `files`: a list of [path, bytes, sha256], in the order of the payload: `stdout`, `stderr`
                (left out where empty), and `output/…` for each of the outputs; `size`: all of it
    trouble     why the attempt could not go on, in a line: reason
    finished    all that was missing has been executed: time

A run that was interrupted (the task was asked to end, by a time limit or by somebody) has a start and no end.

Before anything executes, every file that `needs` names is hashed, once: where it is another than on the host that submitted,
that is the trouble, and nothing executes. SIGTERM ends what runs, with the grace time that jobs have. Where FOLDER, or the
attempt's own pack, has been removed, nobody waits for the results any more: what runs is ended. Exit status 0: finished; 1:
asked to end; 3: trouble, which is said on stderr too.
"""
