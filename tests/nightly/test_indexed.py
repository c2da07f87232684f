"""Tests of the docs and others pass if there is always an index: no answer depends on it."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
UNIT = "tests/unit"
CHANGED = ("origin_is_lost", "hostile")
"""Words in the names of tests that change or lose a file of records, which the index still has."""


@pytest.mark.parametrize(
    "tests",
    [
        ("test_docs.py", "deliverables/test_default_figures.py", "deliverables/test_kinds.py"),
        ("explain", "replay", "deliverables/studies", "ingest/test_rejudge.py", "../extensions/trials/test_marks.py"),
        ("maintenance/test_gc.py", "packages/test_imports.py", "store/test_former_format.py", "store/test_views.py"),
    ],
    ids=lambda tests: tests[0],
)
def test_tests_pass_if_there_is_always_an_index(tests: tuple[str, ...]) -> None:
    paths = [f"{UNIT}/{test}" for test in tests]
    chosen = (
        "-m",
        "not nightly or each_case",
        "-p",
        "tests.support.indexed",
        "-p",
        "no:cacheprovider",
        "-q",
        "-n",
        "2",
        "-k",
        " and ".join(f"not {word}" for word in CHANGED),
    )
    done = subprocess.run(
        [sys.executable, "-m", "pytest", *chosen, *paths],
        cwd=ROOT,
        env={name: value for name, value in os.environ.items() if not name.startswith("PYTEST_")},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout[-4000:]
