"""Clusters: the costs and savings of packing runs, on a real SLURM with one node of two cores.

    python tests/bench/bench_clusters.py [runs] [--slow]

The compared jobs are written by hand, and loop over the same program with xargs: one makes a folder and two
files for each run, one does nothing else. All times begin at submission; SIERRA's end at the last run's record, the jobs'
at their last line. Another job is an array of one task for each run, with six times as many slots. `--slow`: the time and
memory for 100,000 runs, from submission to the last record.
"""

from __future__ import annotations

import argparse
import os
import shutil
import signal
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

from idle import project

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))
SIERRA = str(Path(sys.executable).with_name("sierra"))
EACH = 'mkdir "$1" && cd "$1" && /bin/true "$1" >stdout 2>stderr'
LOOP = f"""#!/bin/sh
seq %d | xargs -P2 -n1 sh -c '{EACH}' sh
touch done
"""
ARRAY = f"""#!/bin/sh
sh -c '{EACH}' sh "$SLURM_ARRAY_TASK_ID"
touch "done-$SLURM_ARRAY_TASK_ID"
"""
BARE = """#!/bin/sh
seq %d | xargs -P2 -n1 /bin/true
touch done
"""
TIMES = 5
FOLLOWED_S = 60.0


def main() -> None:
    from tests import clusters

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="?", type=int, default=1000)
    parser.add_argument("--slow", action="store_true", help="only the slow benchmarks")
    arguments = parser.parse_args()
    if os.geteuid() != 0 or not all(shutil.which(name, path=os.environ["PATH"] + clusters.SBIN) for name in clusters.PROGRAMS):
        print("clusters: a SLURM can't be started here (as root, on Debian: make system)")
        return
    with clusters.folder() as folder, clusters.Slurm(folder, nodes=1, cpus=2) as cluster:
        os.environ.update(cluster.environment, XDG_CACHE_HOME=str(folder / "cache"))
        asked(clustered(folder / "first", "array_tasks = 1\ncpus = 2\n"), 4)  # the first batch of a day probes nodes
        if arguments.slow:
            many(folder, 100 * arguments.runs)
            return
        packed(folder, arguments.runs)
        idle(folder)
    with clusters.folder() as folder, clusters.Slurm(folder, nodes=3, cpus=4) as cluster:
        os.environ.update(cluster.environment)
        array(folder, arguments.runs)


def packed(folder: Path, runs: int) -> None:
    """Compare a batch of runs that do nothing, on two slots, with one job that loops over them."""
    for elements, cpus in ((1, 2), (2, 1)):
        here = clustered(folder / f"{elements}x{cpus}", f"array_tasks = {elements}\ncpus = {cpus}\n")
        taken = [(*asked(here, runs), *(looped(folder, script, runs) for script in (LOOP, BARE))) for _ in range(TIMES)]
        ours, whole, loop, bare = (statistics.median(times) for times in zip(*taken, strict=True))
        say(f"{runs} runs of true, {elements} x {cpus} cores / xargs -P2, with folders", ours, loop, "at most 1.5")
        say(f"{runs} runs of true, {elements} x {cpus} cores / xargs -P2, nothing more", ours, bare, "at most 1.5")
        print(f"  the whole sierra run: {whole:.2f} s", flush=True)


def looped(folder: Path, script: str, runs: int) -> float:
    """Return the seconds of a job that loops over runs."""
    return submitted(folder / "loop", script % runs, "-c2")


def array(folder: Path, runs: int) -> None:
    """Measure an array with one task for each run, which is bad practice."""
    one = submitted(folder / "array", ARRAY, "-c1", f"--array=0-{runs - 1}", count=runs)
    say(f"{runs} runs of true, an array on 12 slots / xargs -P2, with folders", one, looped(folder, LOOP, runs), "over 40 s")


def asked(here: Path, runs: int) -> tuple[float, float]:
    """Return the seconds from the submission of a new batch to its last record, and the seconds of the whole command."""
    shutil.rmtree(here / ".sierra", ignore_errors=True)
    began = time.time()
    with subprocess.Popen(words(runs), cwd=here, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE) as process:
        handed_over = wait(lambda: handed(here), process)
        said = process.communicate()[1].decode()
    returned = time.time() - began
    if process.returncode != 0 or handed_over is None:
        sys.exit(f"sierra run: exit status {process.returncode}: {said}")
    recorded = max(file.parent.stat().st_ctime for file in here.glob(".sierra/segments/*/executions.parquet"))
    return recorded - handed_over, returned


def words(runs: int, *more: str) -> list[str]:
    return [SIERRA, "run", "population_size=1,2,3,4", "--runs", str(runs // 4), "--on", "slurm", "--no-figures", *more]


def handed(here: Path) -> float | None:
    """Return the time of submission of a job; None before it."""
    return next((file.stat().st_mtime for file in here.glob(".sierra/work/*/sent/0.json")), None)


def wait(there: Callable[[], float | None], process: subprocess.Popen[bytes]) -> float | None:
    while (found := there()) is None and process.poll() is None:
        time.sleep(0.005)
    return found


def submitted(folder: Path, script: str, *options: str, count: int = 1) -> float:
    """Return the seconds from the submission of a job to its last line, or to that of the last of `count` array tasks."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    began = time.time()
    subprocess.run(["sbatch", "--quiet", "--output=/dev/null", *options], input=script, text=True, check=True, cwd=folder)
    while len(done := list(folder.glob("done*"))) < count:
        time.sleep(0.02 if count == 1 else 0.5)
    return max(file.stat().st_mtime for file in done) - began


def clustered(folder: Path, table: str) -> Path:
    return project(folder, f"[runners.slurm]\n{table}")


def say(what: str, ours: float, theirs: float, promise: str) -> None:
    told = f"  ({promise})" if promise else ""
    print(f"{what:58} {ours:8.2f} s  {theirs:8.2f} s  ratio {ours / theirs:5.2f}{told}", flush=True)


def many(folder: Path, runs: int) -> None:
    """Measure submission and recording of many runs, and the files on the shared disk in between."""
    here = clustered(folder / "many", "cpus = 2\n")
    own = files(here)
    began = time.time()
    peak = peak_of(words(runs, "--detach"), here)
    whole = time.time() - began
    [session] = [path for path in here.glob(".sierra/work/*") if path.is_dir()]
    submission = (session / "sent" / "0.json").stat().st_mtime - (session / "context.json").stat().st_mtime
    print(f"{runs} runs, --detach: {whole:.1f} s, of which submitting {submission:.1f} s  (under 5 s)")
    print(f"  peak memory of sierra {peak:.0f} MB  (under 200 MB)", flush=True)
    while subprocess.run(["squeue", "--noheader"], capture_output=True, check=True).stdout:
        time.sleep(2)
    executed = time.time() - began - whole
    print(f"  executed in {executed:.0f} s; files in addition to the project's own: {files(here) - own}  (at most 100)")
    began = time.time()
    peak = peak_of([SIERRA, "attach", session.name, "--no-figures"], here)
    recorded = time.time() - began
    print(f"  recorded by sierra attach in {recorded:.0f} s, peak memory {peak:.0f} MB; files then: {files(here) - own}")
    say("  all / xargs -P2, nothing more", whole + executed + recorded, 10 * looped(folder, BARE, runs // 10), "")
    print(f"  {counted_by_sql(here)}", flush=True)


def counted_by_sql(here: Path) -> str:
    """Describe the records: numbers of executions, of runs, of executions per run, and of successful ones."""
    text = (
        "SELECT count(*) AS executions, count(DISTINCT execution) AS different, count(DISTINCT run) AS of_runs, "
        "count(*) FILTER (status = 'ok') AS good, (SELECT count(*) FROM batch_runs) AS asked FROM executions"
    )
    done = subprocess.run([SIERRA, "sql", "--json", text], cwd=here, capture_output=True, text=True, check=True)
    return " ".join(done.stdout.split())


def idle(folder: Path) -> None:
    """Measure the costs of following queued jobs: queries to the scheduler, and CPU time."""
    subprocess.run(["sbatch", "--quiet", "-c2", "--output=/dev/null", "--wrap=sleep 1000"], check=True)
    here = clustered(folder / "idle", "")
    log = counted(folder / "counted")
    around = {**os.environ, "PATH": f"{folder / 'counted'}:{os.environ['PATH']}"}
    pipes = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    with subprocess.Popen(words(1000), cwd=here, env=around, **pipes) as process:  # type: ignore[call-overload]
        wait(lambda: handed(here), process)
        time.sleep(5)
        asked, used = len(log.read_text().splitlines()), cpu_of(process.pid)
        time.sleep(FOLLOWED_S)
        asked, used = len(log.read_text().splitlines()) - asked, cpu_of(process.pid) - used
        process.send_signal(signal.SIGTERM)
    subprocess.run(["scancel", "--user=root"], check=True)
    what = f"following an idle queue for {FOLLOWED_S:.0f} s"
    print(f"{what}: {asked} calls of the scheduler's commands, {100 * used / FOLLOWED_S:.2f} % of a core  (under 1 %)")


def counted(folder: Path) -> Path:
    """Write wrappers of SLURM's commands that log each call; return the log file."""
    folder.mkdir()
    log = folder / "calls"
    log.touch()
    for name in ("sbatch", "squeue", "scancel", "scontrol"):
        (folder / name).write_text(f'#!/bin/sh\necho {name} >> "{log}"\nexec "{shutil.which(name)}" "$@"\n')
        (folder / name).chmod(0o755)
    return log


def cpu_of(pid: int) -> float:
    """Return the CPU seconds of a process and of the children that it has waited for."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return sum(int(field) for field in fields[11:15]) / os.sysconf("SC_CLK_TCK")


def peak_of(argv: list[str], here: Path) -> float:
    """Return the peak memory of a command in MB; it must succeed."""
    process = subprocess.Popen(argv, cwd=here, stdout=subprocess.DEVNULL)
    _, status, usage = os.wait4(process.pid, 0)
    if status != 0:
        sys.exit(f"{' '.join(argv)}: ended with {status}")
    return usage.ru_maxrss / 1024


def files(folder: Path) -> int:
    return sum(len(names) for _, _, names in os.walk(folder))


if __name__ == "__main__":
    main()
