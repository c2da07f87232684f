"""Tests of the check that programs are for the processors of robots."""

from __future__ import annotations

from pathlib import Path

import pytest

from sierra.containers.engines.base import PROJECT
from sierra.errors import Missing
from sierra.extensions.robots import fitting
from sierra.model import ARCH_ON_ROBOT, ON_ROBOT, Member
from tests.support import elf
from tests.support.local_link import LocalLink

OWN = f"{ON_ROBOT}/bin/{ARCH_ON_ROBOT}/go"


def check(folder: Path, *argv: str, arch: str = "aarch64", variables: dict[str, str] | None = None) -> None:
    link = LocalLink("rb3", folder / "home")
    fitting.check_programs("rb3", arch, Member(1, "robot", argv, variables or {}, ()), folder / "code", link)


def test_each_processor_has_its_own_program(tmp_path: Path):
    elf.write(tmp_path / "code/bin/aarch64/go")
    elf.write(tmp_path / "code/bin/armv7l/go", elf.ARM)
    for arch in ("aarch64", "armv7l"):
        check(tmp_path, OWN, "-v", arch=arch)
    with pytest.raises(Missing) as caught:
        check(tmp_path, OWN.replace(ON_ROBOT, PROJECT), arch="x86_64")  # in a container
    assert str(caught.value) == (
        "rb3 is x86_64, but the code has no bin/x86_64/go; it is there for aarch64, armv7l; "
        'add "x86_64" to arch in [build], or add the file'
    )


def test_files_that_arguments_and_variables_name_are_looked_for_too(tmp_path: Path):
    (tmp_path / "code/lib/x86_64").mkdir(parents=True)
    named = f"{ON_ROBOT}/lib/{ARCH_ON_ROBOT}"
    check(tmp_path, "roslaunch", f"path:={named}", variables={"LIBRARIES": f"{named}:/usr/lib"}, arch="x86_64")
    for argv, variables in ((("roslaunch",), {"LIBRARIES": f"{named}:/usr/lib"}), (("roslaunch", named), {})):
        with pytest.raises(Missing, match="rb3 is aarch64, but the code has no lib/aarch64; it is there for x86_64; "):
            check(tmp_path, *argv, variables=variables)


def test_a_program_for_another_processor_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    elf.write(tmp_path / "code/go", elf.X86_64)
    check(tmp_path, f"{ON_ROBOT}/go", arch="x86_64")
    check(tmp_path, "flash", f"{ON_ROBOT}/go")  # a file that the robot only reads
    with pytest.raises(Missing) as caught:
        check(tmp_path, f"{ON_ROBOT}/go")
    assert str(caught.value) == (
        "rb3 is aarch64, but go is a program for x86_64; build it for aarch64, and use {arch} in its path"
    )
    monkeypatch.setattr(fitting, "EMULATORS", str(tmp_path / "qemu-"))
    (tmp_path / "qemu-x86_64").touch()
    check(tmp_path, f"{ON_ROBOT}/go")


def test_a_script_fits_every_processor(tmp_path: Path):
    (tmp_path / "code").mkdir()
    (tmp_path / "code/go.py").write_text("#!/usr/bin/env python3\n")
    check(tmp_path, f"{ON_ROBOT}/go.py")
