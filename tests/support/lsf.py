"""Programs that stand for LSF: array tasks are processes of this machine, and their states are files in a folder."""

from __future__ import annotations

import sys
from pathlib import Path

PROGRAM = """\
#!{python}
import os, re, signal, subprocess, sys
from pathlib import Path

root = Path({root!r})
name, words = os.path.basename(sys.argv[0]), sys.argv[1:]

def state(task):
    if task.with_suffix(".status").exists():
        return "DONE" if task.with_suffix(".status").read_text().strip() == "0" else "EXIT"
    return "RUN"

if name == "bsub" and words == ["-V"]:
    print("10.1.0")
elif name == "bsub":
    script = sys.stdin.read()
    said = dict(re.findall(r"^#BSUB (-\\S+) (.*)$", script, re.M))
    job, indices = re.fullmatch(r"(.*)\\[([0-9,]+)\\]", said["-J"]).groups()
    number = str(100 + len(list(root.glob("*.script"))))
    (root / f"{{number}}.script").write_text(script)
    for index in indices.split(","):
        task = root / f"{{job}}|{{number}}|{{index}}"
        given = dict(LSB_JOBID=number, LSB_JOBINDEX=index, LSB_DJOB_NUMPROC=said["-n"], LSF_LIM_MEM_MB="512", LSF_GPUS="3")
        log = said["-oo"].replace("%J", number).replace("%I", str(int(index) - 1))
        run = 'echo $$ > "$1.pid"; sh "$2" > "$3" 2>&1; echo $? > "$1.new"; mv "$1.new" "$1.status"'
        subprocess.run(
            ["setsid", "--fork", "sh", "-c", run, "sh", str(task), str(root / f"{{number}}.script"), log],
            env={{"PATH": os.defpath, "LSF_TMPDIR": str(root / "disk"), **given}}, stdin=subprocess.DEVNULL, check=True,
        )
        while not task.with_suffix(".pid").exists():
            pass
    print(f"Job <{{number}}> is submitted to default queue <normal>.")
elif name == "bjobs":
    for task in sorted(root.glob(words[-1] + "|*.pid")):
        _, number, index = task.stem.split("|")
        print(number, index, state(task), "here", sep="|")
elif name == "bkill":
    number, index = re.fullmatch(r"(\\d+)\\[(\\d+)\\]", words[0]).groups()
    for task in root.glob(f"*|{{number}}|{{index}}.pid"):
        os.killpg(int(task.read_text()), signal.SIGTERM)
"""


def install(root: Path) -> Path:
    """Write the programs; return their folder. The states of jobs are in `root`."""
    (root / "disk").mkdir(parents=True)
    programs = root / "bin"
    programs.mkdir()
    for name in ("bsub", "bjobs", "bkill"):
        (programs / name).write_text(PROGRAM.format(python=sys.executable, root=str(root)))
        (programs / name).chmod(0o755)
    return programs
