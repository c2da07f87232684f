"""Tests of the names of processors."""

from __future__ import annotations

import platform

import pytest

from sierra.util import processors


@pytest.mark.parametrize(
    ("said", "name"),
    [("arm64", "aarch64"), ("amd64", "x86_64"), ("arm/v7", "armv7l"), ("i586", "i686"), ("x86_64", "x86_64"), ("vax", "vax")],
)
def test_one_processor_has_one_name(said: str, name: str, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(platform, "machine", lambda: said)
    assert processors.here() == processors.name_of(said) == name


@pytest.mark.parametrize(
    ("host", "program", "can"),
    [
        ("x86_64", "aarch64", False),
        ("x86_64", "i686", True),
        ("i686", "x86_64", False),
        ("aarch64", "arm", True),
        ("armv7l", "arm", True),
        ("armv6l", "aarch64", False),
        ("vax", "x86_64", True),
    ],
)
def test_a_program_for_another_processor_is_known(host: str, program: str, can: bool):
    assert processors.can_execute(host, program) is can
