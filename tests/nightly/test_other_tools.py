"""The studies on the page about other tools give the shown means, with each tool that is installed.

A tool is found in `PATH`, or in a virtual environment of its name in the folder that SIERRA_OTHER_TOOLS names.
"""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import pytest

from tests.support.pages import DOCS, as_user, blocks, follow

PAGE = DOCS / "explanation" / "other-tools.md"
TOOLS = {
    "Snakemake": "import snakemake",
    "DVC": "import dvc",
    "Hydra": "import hydra",
    "Sacred": "import sacred",
    "MLflow": "import mlflow",
    "AiiDA": "import aiida, aiida_shell",
}
QUIET = {"DVC_NO_ANALYTICS": "1", "MLFLOW_DISABLE_TELEMETRY": "true"}


def write_simulator(folder: Path) -> None:
    for block in blocks(PAGE, "The study"):
        (folder / block.title).write_text(block.text, "utf-8")


def test_study_with_sierra_gives_the_shown_means(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    as_user(monkeypatch)
    write_simulator(tmp_path)
    follow(PAGE, tmp_path, "SIERRA")


@pytest.mark.parametrize("tool", TOOLS)
def test_study_with_another_tool_gives_the_shown_means(tool: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    programs = Path(os.environ.get("SIERRA_OTHER_TOOLS", tmp_path), tool.lower(), "bin")
    monkeypatch.setenv("PATH", f"{programs}{os.pathsep}{os.environ['PATH']}")
    (tmp_path / "aiida").mkdir(exist_ok=True)
    monkeypatch.setenv("AIIDA_PATH", str(tmp_path / "aiida"))
    for name, value in QUIET.items():
        monkeypatch.setenv(name, value)
    python = shutil.which("python3")
    assert python is not None
    if subprocess.run([python, "-c", TOOLS[tool]], capture_output=True, check=False).returncode:
        pytest.skip(f"needs {tool}")
    write_simulator(tmp_path)
    follow(PAGE, tmp_path, tool, timeout_s=900)


def test_each_tool_of_the_page_is_tried() -> None:
    headings = [line.split()[1] for line in PAGE.read_text("utf-8").splitlines() if line.startswith("## ")]
    assert headings == ["The", "SIERRA", *TOOLS, "The"]
