"""What every test may use."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable

import pytest
from hypothesis import settings

settings.register_profile("here", deadline=None)
settings.register_profile("ci", deadline=None, derandomize=True, print_blob=True)
settings.load_profile("ci" if os.environ.get("CI") else "here")


@pytest.fixture
def require() -> Callable[..., str]:
    """Say what a test needs: `require("podman")`, or `require("a slurm cluster", there=cluster.answers())`.

    Returns the path of a program that is found by name. What is missing skips the test, or fails it where
    SIERRA_REQUIRE_ALL=1 says that everything has to be there.
    """

    def require(what: str, *, there: bool | None = None) -> str:
        program = shutil.which(what)
        if program is not None if there is None else there:
            return program or what
        if os.environ.get("SIERRA_REQUIRE_ALL") == "1":
            pytest.fail(f"needs {what}, and SIERRA_REQUIRE_ALL=1 forbids to skip", pytrace=False)
        pytest.skip(f"needs {what}")

    return require
