"""The zip of the programs for other hosts."""

from __future__ import annotations

import io
import json
import re
import subprocess
import sys
import zipfile
from pathlib import Path

from sierra.util.worker_zip import packed
from sierra.worker.program import HERE

TRACER = {"file_trace", "observers", "trace_log", "traced_processes", "changed_names", "channels", "file_names", "python_files"}
TRACER |= {"observed_record"}


def test_its_bytes_depend_only_on_the_sources() -> None:
    first = packed()
    packed.cache_clear()
    assert packed() == first
    with zipfile.ZipFile(io.BytesIO(first)) as archive:
        members = archive.infolist()
    assert {member.date_time for member in members} == {(1980, 1, 1, 0, 0, 0)}
    assert [member.filename for member in members] == sorted(member.filename for member in members)


def test_it_has_all_modules_that_nodes_need() -> None:
    names = set(zipfile.ZipFile(io.BytesIO(packed())).namelist())
    assert {path.name for path in Path(HERE).glob("*.py")} - names == {"__init__.py"}


def test_its_modules_never_load_an_installed_sierra(tmp_path: Path) -> None:
    program = tmp_path / "worker.pyz"
    program.write_bytes(packed())
    code = f"""
import runpy, sys
programs = runpy.run_path({str(program)!r})
programs["add_package"]()
import sierra.worker.worker, sierra.worker.conductor, sierra.worker.array_task
modules = [module for name, module in sys.modules.items() if name.startswith("sierra.worker.")]
print(sorted({{module.__file__.rpartition("/")[0] for module in modules}}))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == f"['{program}']\n"


def test_it_loads_the_tracer_only_for_observed_runs(tmp_path: Path) -> None:
    program, folder = tmp_path / "worker.pyz", tmp_path / "runs"
    program.write_bytes(packed())
    folder.mkdir()
    run = {"run": "a", "execution": "a", "argv": ["/bin/true"], "environment": {}, "files": {}, "limits": {}}
    command = [sys.executable, "-X", "importtime", "-I", "-S", str(program), str(folder), "1"]
    jobs = tmp_path / "jobs"
    jobs.write_text(f'{json.dumps(run)}\n{{"end": true}}\n')
    with jobs.open() as lines:
        done = subprocess.run(command, stdin=lines, capture_output=True, text=True, check=True)
    loaded = set(re.findall(r"sierra\.worker\.(\w+)", done.stderr))
    assert "run_folder" in loaded
    assert not loaded & TRACER
