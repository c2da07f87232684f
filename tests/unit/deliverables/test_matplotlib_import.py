"""Figures do not depend on settings of matplotlib, Qt or fonts in the environment, and its folders are not reported."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests import projects, stores

INLINE = {"MPLBACKEND": "module://matplotlib_inline.backend_inline"}
VARIABLES: dict[str, dict[str, str]] = {
    "Jupyter": INLINE,
    "Qt": {"MPLBACKEND": "QtAgg", "QT_QPA_PLATFORM": "none", "QT_PLUGIN_PATH": "/nonexistent", "QT_API": "none"},
    "date": {"SOURCE_DATE_EPOCH": "today"},
    "home": {"HOME": "/nonexistent", "XDG_CONFIG_HOME": "/nonexistent", "XDG_CACHE_HOME": "/proc", "MPLCONFIGDIR": "/proc/no"},
    "fonts": {"FONTCONFIG_FILE": "/nonexistent", "FONTCONFIG_PATH": "/nonexistent"},
    "file": {"MATPLOTLIBRC": "bad/matplotlibrc"},
}
ALL = {"all": {name: value for variables in VARIABLES.values() for name, value in variables.items()}}
pytestmark = pytest.mark.integration


def figures(root: Path, variables: dict[str, str]) -> dict[str, str]:
    """Return the SHA-256 of each figure's files by name, and all notes, as a new process draws with these variables."""
    command = [projects.SIERRA, "figures", "--format", "pdf,svg"]
    ended = subprocess.run(command, cwd=root, env=os.environ | variables, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stderr
    return {"said": ended.stderr} | {
        path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in (root / "figures").rglob("*.*")
    }


@pytest.mark.parametrize("variables", (ALL | VARIABLES).values(), ids=ALL | VARIABLES)
def test_figures_are_the_same_with_all_variables(recorded: Path, tmp_path: Path, variables: dict[str, str]) -> None:
    root = stores.copy(recorded, tmp_path / "project")
    (root / "bad").mkdir()
    (root / "bad/matplotlibrc").write_bytes(b"backend: none\nfont.size: 40\nno.key: 1\n\xff\n")
    assert figures(root, variables) == figures(root, {}) != {}


def test_a_file_with_settings_that_matplotlib_cannot_read_is_named(recorded: Path, tmp_path: Path) -> None:
    root = stores.copy(recorded, tmp_path / "project")
    (root / "matplotlibrc").write_bytes(b"\xff\n")
    ended = subprocess.run([projects.SIERRA, "figures"], cwd=root, capture_output=True, text=True, check=False)
    assert f"{root / 'matplotlibrc'}: matplotlib cannot read this file" in ended.stderr
    assert "fault" not in ended.stderr


def test_programs_that_use_sierra_keep_their_own_settings(tmp_path: Path) -> None:
    (tmp_path / "matplotlibrc").write_text("font.size: 40\n")
    program = (
        "import os\nfrom sierra.deliverables.figures import style\nimport matplotlib\n"
        "print(matplotlib.rcParams['font.size'], matplotlib.get_backend(), os.environ['MPLBACKEND'])"
    )
    for backend, used in (("svg", "svg"), (INLINE["MPLBACKEND"], "agg")):
        environment = os.environ | {"MPLBACKEND": backend}
        command = [sys.executable, "-c", program]
        said = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=True).stdout
        assert said.split() == ["40.0", used, backend]
