"""The project for measurements, whose simulator does nothing, and the costs of a command."""

from __future__ import annotations

import os
import subprocess
import time
from pathlib import Path

TOML = """
template = "template.xml"
command = "/bin/true {input}"
seed = "/experiment/@seed"
[variables]
population_size = "//swarm/@count"
"""
TEMPLATE = '<experiment seed="1"><swarm count="3"/></experiment>\n'


def project(folder: Path, more: str = "", *, command: str = "/bin/true {input}") -> Path:
    """Make the project in a folder, unless it exists; `more` is added to its sierra.toml."""
    folder.mkdir(exist_ok=True)
    (folder / "sierra.toml").write_text(TOML.replace("/bin/true {input}", command) + more)
    (folder / "template.xml").write_text(TEMPLATE)
    return folder


def measured(here: Path, *words: str, code: int = 0) -> tuple[float, float, int]:
    """Execute a command in a folder; return the seconds, the CPU seconds, and the largest memory in bytes.

    `code`: its exit code.
    """
    began = time.perf_counter()
    process = subprocess.Popen(words, cwd=here, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    _, status, used = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    assert process.returncode == code, f"{words} fails"
    return time.perf_counter() - began, used.ru_utime + used.ru_stime, used.ru_maxrss * 1024
