"""A small PBS in one folder: `qsub`, `qstat` and `qdel` with the observed behaviour of OpenPBS 23.06.

No server runs: each command reads and writes one file, under a lock. Scripts really execute, in processes that outlive the
command, in the user's home folder, with the few variables that PBS sets. It uses only the standard library, because the
commands run this file. It has these properties of a real PBS:

- an array of one index is refused, and so is an empty script on standard input (here: any script there);
- ended jobs are unknown (153), or, with a history, reported as ended (35);
- ended array tasks of a running array are X; the array's exit status is 0 (or 1) for any status of its tasks, and
  without a history the tasks show it, too;
- only the array is held, or waits for others, and not its array tasks;
- a job at its time limit gets a signal to end, and only a history reports this later;
- the output of a job is copied to the host of `qsub`, even to `/dev/null`, which may take long; until then its state is E;
- long lines of text are wrapped by a line feed and a tab; a quotation mark may make the JSON invalid;
- jobs that wait for others are held by the system; if those fail, they are deleted; and so are jobs that wait for one
  that is not known (any more): they are accepted nevertheless.
"""

from __future__ import annotations

import contextlib
import fcntl
import getopt
import json
import os
import pwd
import re
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NoReturn

HOST = "pbs1"
OPTIONS = "a:A:C:e:hj:J:k:l:m:M:N:o:p:P:q:r:S:v:VW:z"
VERSION = "23.06.06"
CALLER = ("HOME", "LANG", "LOGNAME", "PATH", "MAIL", "SHELL", "TZ")
DEFAULTS: dict[str, Any] = {
    "slots": 8,
    "cpus": 4,
    "queues": ["workq"],
    "max_queued": 1000,
    "max_run": 100,
    "max_array_size": 10000,
    "history": False,
    "down": False,
    "dies": False,
    "broken_json": False,
    "always_V": False,
    "slow": "",
    "copying": 0,
    "array_status": 0,
}


class Server:
    """The server as tests use it: its folder of commands must be first on the PATH."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self.bin = folder / "bin"
        self.bin.mkdir(parents=True)
        (folder / "state.json").write_text(json.dumps({**DEFAULTS, "next": 1, "jobs": {}}))
        for command in ("qsub", "qstat", "qdel"):
            program = self.bin / command
            program.write_text(
                f"#!{sys.executable} -IS\nimport sys\nsys.path.insert(0, {str(Path(__file__).parent)!r})\n"
                f"import pbs\npbs.main({str(folder)!r}, {command!r}, sys.argv[1:])\n"
            )
            program.chmod(0o755)

    def set(self, **settings: Any) -> None:
        """Change settings, as an administrator does."""
        with opened(self._folder) as state:
            state.update(settings)

    def change(self, number: int, **attributes: Any) -> None:
        """Set attributes of a job (`comment`, `hold`), as a scheduler or an administrator does."""
        with opened(self._folder) as state:
            state["jobs"][str(number)].update(attributes)

    def calls(self) -> list[list[str]]:
        """Return the commands that were called since the last call of this method."""
        log = self._folder / "calls"
        lines = log.read_text().splitlines() if log.exists() else []
        log.write_text("")
        return [json.loads(line) for line in lines]

    def waiting(self) -> None:
        """Keep all jobs queued."""
        self.set(slots=0)

    def begin(self) -> None:
        """Let queued jobs begin."""
        with opened(self._folder) as state:
            state["slots"] = 8
            schedule(self._folder, state)

    def end(self) -> None:
        """End all running jobs."""
        with opened(self._folder) as state:
            state["slots"] = 0
            for job in state["jobs"].values():
                for task in job["tasks"].values():
                    kill(task)


@contextlib.contextmanager
def opened(folder: Path) -> Iterator[dict[str, Any]]:
    """Yield the server's state under a lock, and write it back."""
    with (folder / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        file = folder / "state.json"
        state: dict[str, Any] = json.loads(file.read_text())
        try:
            yield state
        finally:
            file.with_suffix(".new").write_text(json.dumps(state))
            file.with_suffix(".new").replace(file)


def main(folder: str, command: str, words: list[str]) -> None:
    with (Path(folder) / "calls").open("a") as log:
        log.write(json.dumps([command, *words]) + "\n")
    if words == ["--version"]:
        print(f"pbs_version = {VERSION}")
        return
    with opened(Path(folder)) as state:
        if state["down"]:
            refuse(command, f"cannot connect to server {HOST} (errno=15010)", 111, before="Connection refused\n")
        {"qsub": qsub, "qstat": qstat, "qdel": qdel}[command](Path(folder), state, words)
        if state["dies"]:
            state.update(dies=False, down=True)
            refuse(command, "Premature end of message", 1)
    while command == "qstat" and state["slow"] and not Path(state["slow"]).exists():
        time.sleep(0.02)


def refuse(command: str, words: str, status: int, *, before: str = "") -> NoReturn:
    sys.stderr.write(f"{before}{command}: {words}\n")
    sys.stderr.flush()
    raise SystemExit(status)


def qsub(folder: Path, state: dict[str, Any], words: list[str]) -> None:
    try:
        given, files = getopt.getopt(words, OPTIONS)
        if not files:
            refuse("qsub", "script not a file", 2)
        text = Path(files[0]).read_text()
        said, rest = getopt.getopt(directives(text), OPTIONS)
        if rest:
            refuse("qsub", f"directive error: {' '.join(rest)}", 2)
    except getopt.GetoptError as error:
        refuse("qsub", f"invalid option -- '{error.opt}'", 2)
    options: dict[str, list[str]] = {}
    for name, value in (*said, *given):
        options.setdefault(name[1], []).append(value)
    places = wanted(options)
    check(state, options, places or [None])
    number = str(state["next"])
    state["next"] += 1
    script = folder / f"{number}.SC"
    script.write_text(text)
    variables = {f"PBS_O_{name}": os.environ[name] for name in CALLER if name in os.environ}
    variables |= {"PBS_O_WORKDIR": str(Path.cwd()), "PBS_O_QUEUE": "workq"}
    if "V" in options or state["always_V"]:
        variables |= os.environ
    variables |= dict(pair.split("=", 1) for value in options.get("v", []) for pair in value.split(","))
    depend = [word.removeprefix("depend=") for word in options.get("W", []) if word.startswith("depend=")]
    state["jobs"][number] = {
        "name": options.get("N", [Path(files[0]).name])[-1],
        "queue": options.get("q", ["workq"])[-1],
        "owner": pwd.getpwuid(os.geteuid()).pw_name,
        "shell": options.get("S", ["/bin/sh"])[-1],
        "output": options.get("o", ["out"])[-1],
        "script": str(script),
        "variables": variables,
        "array": places is not None,
        "depend": depend[-1] if depend else "",
        "in_vain": bool(depend) and not found(state, depend[-1].rpartition(":")[2]),
        "tasks": {str(place): {"state": "Q", "pid": None, "status": None} for place in places or [""]},
        "comment": never(state, options),
        "hold": "n",
        "wall": wall(options),
    }
    schedule(folder, state)
    if not state["dies"]:
        print(identity(number, state["jobs"][number]))


def directives(text: str) -> list[str]:
    """Return the directives of a script, up to its first command."""
    words: list[str] = []
    for line in text.splitlines():
        if line.startswith("#PBS "):
            words += shlex.split(line[5:])
        elif line and not line.startswith("#"):
            break
    return words


def wanted(options: dict[str, list[str]]) -> list[int] | None:
    if "J" not in options:
        return None
    match = re.fullmatch(r"(\d+)-(\d+)(?::(\d+))?(?:%\d+)?", options["J"][-1])
    if not match or int(match[1]) >= int(match[2]):
        refuse("qsub", "illegal -J value", 2)
    if options.get("r", ["y"])[-1] == "n":
        refuse("qsub", " cannot submit non-rerunable Array Job", 2)
    return list(range(int(match[1]), int(match[2]) + 1, int(match[3] or 1)))


def check(state: dict[str, Any], options: dict[str, list[str]], places: Sequence[int | None]) -> None:
    if len(options.get("N", [""])[-1]) > 15:
        refuse("qsub", "illegal -N value", 2)
    if options.get("q", ["workq"])[-1] not in state["queues"]:
        refuse("qsub", "Unknown queue", 170)
    if len(places) > state["max_array_size"]:
        refuse("qsub", "Array job exceeds server or queue size limit", 2)
    there = sum(task["status"] is None for job in state["jobs"].values() for task in job["tasks"].values())
    if there + len(places) > state["max_queued"]:
        refuse("qsub", "would exceed complex's per-user limit", 1)


def never(state: dict[str, Any], options: dict[str, list[str]]) -> str:
    """Return the scheduler's comment on a request that no node satisfies."""
    asked = [int(cores) for words in options.get("l", []) for cores in re.findall(r"ncpus=(\d+)", words)]
    if max(asked, default=1) <= state["cpus"]:
        return ""
    most = state["cpus"]
    return f"Can Never Run: Insufficient amount of resource: ncpus (R: {max(asked)} A: {most} T: {most})"


def wall(options: dict[str, list[str]]) -> float | None:
    """Return the time limit of a job in seconds."""
    found = re.search(r"walltime=(\d+):(\d+):(\d+)", " ".join(options.get("l", [])))
    return int(found[1]) * 3600 + int(found[2]) * 60 + int(found[3]) if found else None


def identity(number: str, job: dict[str, Any], place: str = "") -> str:
    return f"{number}[{place}].{HOST}" if job["array"] else f"{number}.{HOST}"


def found(state: dict[str, Any], text: str) -> tuple[str, str] | None:
    """Return the number of a known job, and the position of the array task."""
    match = re.fullmatch(r"(\d+)(?:\[(\d*)\])?(?:\.\S+)?", text)
    job = state["jobs"].get(match[1]) if match else None
    return None if not match or job is None or not known(state, job) else (match[1], match[2] or "")


def known(state: dict[str, Any], job: dict[str, Any]) -> bool:
    return bool(state["history"] or alive(job))


def alive(job: dict[str, Any]) -> bool:
    return any(task["status"] is None for task in job["tasks"].values())


def schedule(folder: Path, state: dict[str, Any]) -> None:
    """Begin jobs that have a slot; delete jobs that wait for a failed one."""
    free = state["slots"] - sum(task["state"] in "RE" for job in state["jobs"].values() for task in job["tasks"].values())
    for number, job in state["jobs"].items():
        waits = job["depend"] and after(state, job)
        for place, task in job["tasks"].items():
            if task["state"] == "Q" and free > 0 and not waits and not job["comment"] and job["hold"] == "n":
                begin(folder, number, place, job, task)
                free -= 1


def after(state: dict[str, Any], job: dict[str, Any]) -> bool:
    first = state["jobs"][re.split(r"[\[.]", job["depend"].partition(":")[2])[0]]
    failed = job["in_vain"] or any(task["status"] for task in first["tasks"].values())
    for task in job["tasks"].values():
        if failed and not alive(first) and task["state"] == "Q":
            task.update(state="F", status=271)
    return alive(first)


def begin(folder: Path, number: str, place: str, job: dict[str, Any], task: dict[str, Any]) -> None:
    home = os.environ.get("HOME", "/")
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTERM})  # until its executor can handle it
    environment = {
        "HOME": home,
        "PATH": "/usr/bin:/bin",
        "LOGNAME": job["owner"],
        "PBS_JOBNAME": job["name"],
        **job["variables"],
    }
    environment |= {"PBS_JOBID": identity(number, job, place), "PBS_ENVIRONMENT": "PBS_BATCH"}
    if place:
        environment |= {"PBS_ARRAY_INDEX": place, "PBS_ARRAY_ID": identity(number, job)}
    words = [str(folder), number, place, job["shell"], job["script"]]
    code = f"import sys; sys.path.insert(0, {str(Path(__file__).parent)!r}); import pbs; pbs.execute(*sys.argv[1:])"
    process = subprocess.Popen(
        [sys.executable, "-IS", "-c", code, *words],
        cwd=home,
        env=environment,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGTERM})
    process.returncode = 0  # no wait: init reaps it
    task.update(state="R", pid=process.pid)


def execute(folder: str, number: str, place: str, shell: str, script: str) -> None:
    """Execute one task, as PBS on a node does, and report its end to the server; end with the task's process group."""
    task: subprocess.Popen[bytes] | None = None
    asked = False

    def end(*_: object) -> None:
        nonlocal asked
        asked = True
        if task is not None:
            with contextlib.suppress(ProcessLookupError):  # the task has ended by itself
                os.killpg(task.pid, signal.SIGTERM)

    signal.signal(signal.SIGTERM, end)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGTERM})
    with opened(Path(folder)) as state:  # wait until the server has recorded its start
        limit = state["jobs"][number]["wall"]
    spool = Path(folder) / f"{number}.{place}.OU"
    with spool.open("w") as output:
        task = subprocess.Popen([shell, script], stdout=output, stderr=output, process_group=0)
    if asked:
        end()
    status, over = -1, False
    try:
        status = task.wait(limit)
    except subprocess.TimeoutExpired:
        end()
        status, over = task.wait(), True
    with opened(Path(folder)) as state:
        job = state["jobs"][number]
        job["tasks"][place]["state"] = "E"
    if not job["output"].startswith("localhost:"):
        time.sleep(state["copying"])
    with opened(Path(folder)) as state:
        deliver(spool, job["output"].removeprefix("localhost:"))
        state["jobs"][number]["tasks"][place].update(state="F", status=-29 if over else 256 - status if status < 0 else status)
        schedule(Path(folder), state)


def deliver(spool: Path, target: str) -> None:
    """Copy a task's output to the path of the job."""
    if target != "/dev/null":
        spool.replace(target if not target.startswith("/dev/") else spool.with_name("undelivered"))


def kill(task: dict[str, Any]) -> None:
    if task["state"] == "R":
        with contextlib.suppress(ProcessLookupError):
            os.kill(task["pid"], signal.SIGTERM)
    elif task["state"] == "Q":
        task.update(state="F", status=271)


def qdel(folder: Path, state: dict[str, Any], words: list[str]) -> None:
    status = 0
    for word in words:
        meant = found(state, word)
        if meant is None:
            sys.stderr.write(f"qdel: Unknown Job Id {word}\n")
            status = 153
        elif not alive(state["jobs"][meant[0]]):
            sys.stderr.write(f"qdel: Job has finished {word}\n")
            status = 35
        else:
            tasks = state["jobs"][meant[0]]["tasks"]
            if meant[1] and tasks[meant[1]]["status"] is not None:
                sys.stderr.write(f"qdel: Request invalid for finished array subjob {word}\n")
                status = 55
            for task in [tasks[meant[1]]] if meant[1] else tasks.values():
                kill(task)
    schedule(folder, state)
    if status:
        raise SystemExit(status)


def qstat(folder: Path, state: dict[str, Any], words: list[str]) -> None:
    try:
        given, ids = getopt.getopt(words, "BQftxF:")
    except getopt.GetoptError as error:
        refuse("qstat", f"invalid option -- '{error.opt}'", 2)
    options = dict(given)
    if "-x" in options and not state["history"]:
        refuse("qstat", "PBS is not configured to maintain job history", 2)
    if "-B" in options:
        limit = {name: f"[u:PBS_GENERIC={state[name]}]" for name in ("max_queued", "max_run")}
        print(folded("Server", HOST, {"default_queue": "workq", **limit, "max_array_size": state["max_array_size"]}))
        return
    if "-Q" in options:
        for queue in ids or state["queues"]:
            if queue not in state["queues"]:
                refuse("qstat", f"Unknown queue {queue}", 170)
            print(folded("Queue", queue, {"queue_type": "Execution", "resources_max.walltime": "24:00:00"}))
        return
    status, records = listed(state, ids)
    if "-F" not in options:
        print("\n".join(folded("Job Id", name, record) for name, record in records.items()))
    else:
        answer = {"timestamp": int(time.time()), "pbs_version": VERSION, **({"Jobs": records} if records else {})}
        text = json.dumps(answer, indent="\t")
        print(text.replace('"Checkpoint": "u"', '"Checkpoint": "u"u"') if state["broken_json"] else text)
    if status:
        raise SystemExit(status)


def listed(state: dict[str, Any], ids: list[str]) -> tuple[int, dict[str, dict[str, Any]]]:
    """Return the exit status and records of these jobs, or of all that have not ended."""
    numbers, status = list(state["jobs"]), 0
    if ids:
        numbers = []
        for text in ids:
            meant = found(state, text)
            if meant is None:
                sys.stderr.write(f"qstat: Unknown Job Id {text}\n")
                status = 153
            elif not alive(state["jobs"][meant[0]]):
                sys.stderr.write(f"qstat: {text} Job has finished, use -x or -H to obtain historical job information\n")
                status = 35
            else:
                numbers.append(meant[0])
    records: dict[str, dict[str, Any]] = {}
    for number in numbers:
        job = state["jobs"][number]
        if alive(job):
            records |= described(number, job, state)
    return status, records


def described(number: str, job: dict[str, Any], state: dict[str, Any]) -> dict[str, dict[str, Any]]:
    records = {}
    common = {
        "Job_Name": job["name"],
        "Job_Owner": f"{job['owner']}@{HOST}",
        "queue": job["queue"],
        "Checkpoint": "u",
        "Variable_List": job["variables"],
        **({"comment": job["comment"]} if job["comment"] else {}),
        **({"depend": job["depend"]} if job["depend"] else {}),
    }
    waits = bool(job["depend"]) and any(task["state"] == "Q" for task in job["tasks"].values())
    hold = "s" if waits else job["hold"]
    if job["array"]:
        states = {task["state"] for task in job["tasks"].values()}
        letter = "H" if hold != "n" else "B" if states != {"Q"} else "Q"
        whole = {"job_state": letter, "Hold_Types": hold, "array": "True", "Exit_status": state["array_status"]}
        records[identity(number, job)] = common | whole
    for place, task in job["tasks"].items():
        holds = task["state"] == "Q" and hold != "n" and not job["array"]
        letter = "H" if holds else task["state"]
        if letter == "F":
            letter = "X" if job["array"] else "F"
        record = {**common, "job_state": letter, "Hold_Types": hold}
        if place:
            record |= {"array_index": int(place)}
        if task["pid"]:
            record |= {"exec_host": f"{HOST}/0"}
        if task["status"] is not None:
            record |= {"Exit_status": task["status"]}
        if letter == "X" and not state["history"]:
            record |= {"comment": "Subjob finished", "Exit_status": state["array_status"]}
            record.pop("exec_host", None)
        records[identity(number, job, place)] = record
    return records


def folded(kind: str, name: str, record: dict[str, Any]) -> str:
    lines = [f"{kind}: {name}"]
    for key, value in record.items():
        text = ",".join(f"{one}={inner}" for one, inner in value.items()) if isinstance(value, dict) else str(value)
        line = f"    {key} = {text}"
        lines.append("\n\t".join(line[start : start + 78] for start in range(0, len(line), 78)))
    return "\n".join(lines) + "\n"
