"""The command and its options leave nothing behind, and settings of matplotlib in the environment do not stop it."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from sierra.config.extensions import GIVEN
from tests import projects


def test_an_option_of_an_extension_holds_for_one_call(tmp_path: Path) -> None:
    ended = projects.quick(projects.make(tmp_path), "package", "abcd", "-o", "x.zip", "--no-videos")
    assert "[package] in sierra.toml needs title" in ended.stderr
    assert GIVEN.get() == ()


@pytest.mark.each_case
@pytest.mark.parametrize("module", ["painting.scene", "painting.text_strip"])
def test_what_draws_videos_loads_matplotlib_without_settings_of_the_environment(tmp_path: Path, module: str) -> None:
    (tmp_path / "matplotlibrc").write_bytes(b"font.size: x\n\xff\n")
    variables = os.environ | {"MPLBACKEND": "none", "MATPLOTLIBRC": str(tmp_path / "matplotlibrc")}
    done = subprocess.run(
        [sys.executable, "-c", f"import sierra.extensions.videos.{module}"], env=variables, capture_output=True, check=False
    )
    assert (done.returncode, done.stderr) == (0, b"")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("--capture -q", "--quiet: not with --capture"),
        ("--runs 2", "--runs: only with --capture"),
        ("--capture 9e1c 722b", "--capture takes one id, not 2"),
    ],
)
def test_options_that_do_not_fit_to_a_capture_are_refused_in_one_line(tmp_path: Path, words: str, message: str) -> None:
    ended = projects.quick(projects.make(tmp_path / "p"), "video", *words.split())
    assert (ended.returncode, ended.stderr.count("\n")) == (2, 1)
    assert message in ended.stderr
