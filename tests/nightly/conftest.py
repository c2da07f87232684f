"""Fixtures for the tests with real simulators."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests.simulators import Edit, Environment, Install

Made = Callable[[str], tuple[Environment, str]]
Require = Callable[..., str]


@pytest.fixture(scope="session")
def made(tmp_path_factory: pytest.TempPathFactory) -> Made:
    """Return a function that makes the environment of a simulator once; it also returns the errors of pip."""

    @functools.cache
    def made(simulator: str) -> tuple[Environment, str]:
        environment = Environment(tmp_path_factory.mktemp(simulator) / "venv")
        return environment, environment.install(simulator)

    return made


@pytest.fixture
def installed(made: Made, require: Require) -> Install:
    """Return a function that returns the environment of a simulator."""

    def installed(simulator: str) -> Environment:
        require("strace")
        environment, errors = made(simulator)
        require(f"an index with packages of {simulator} for this Python", there="No matching distribution" not in errors)
        assert errors == ""
        return environment

    return installed


@pytest.fixture
def edit() -> Iterator[Edit]:
    """Yield a function that writes another content into a file; the file is as before when the test ends."""
    before: dict[Path, bytes] = {}

    def edit(file: Path, content: bytes) -> None:
        assert content != before.setdefault(file, file.read_bytes())
        file.write_bytes(content)

    yield edit
    for file, content in before.items():
        file.write_bytes(content)
