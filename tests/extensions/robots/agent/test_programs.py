"""The zip of the programs that execute runs on robots."""

from __future__ import annotations

import io
import subprocess
import sys
import zipfile
from pathlib import Path

from sierra.extensions.robots import agent
from sierra.util.worker_zip import packed

FOLDER = Path(agent.__file__).parent
IN_ZIP = "extensions/robots/agent/"


def test_it_adds_the_agent_to_the_programs_of_nodes() -> None:
    names, added = (zipfile.ZipFile(io.BytesIO(data)).namelist() for data in (packed(), packed(FOLDER)))
    assert added == sorted(added)
    assert not any("robot" in name or "/" in name for name in names)
    above = ["extensions/__init__.py", "extensions/robots/__init__.py"]
    assert {*added} == {*names, *above, *(IN_ZIP + path.name for path in FOLDER.glob("*.py"))}


def test_its_modules_never_load_an_installed_sierra(tmp_path: Path) -> None:
    program = tmp_path / "worker.pyz"
    program.write_bytes(packed(FOLDER))
    code = f"""
import importlib, runpy, sys
runpy.run_path({str(program)!r})["add_package"]()
for name in {[path.stem for path in FOLDER.glob("[!_]*.py")]}:
    importlib.import_module("sierra.extensions.robots.agent." + name)
modules = [module for name, module in sys.modules.items() if name.startswith("sierra.") and name != "sierra.worker"]
print(len(modules), sorted({{module.__file__.partition(".pyz/")[0] for module in modules}}))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    count, _, folders = done.stdout.partition(" ")
    assert folders == f"['{tmp_path}/worker']\n"
    assert int(count) > len([*FOLDER.glob("*.py")])
