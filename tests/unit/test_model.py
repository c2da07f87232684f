"""Tests of the nouns."""

from __future__ import annotations

from sierra.model import ARCH_ON_ROBOT, ON_ROBOT, Member


def test_a_member_gets_the_paths_and_the_processor_of_its_robot():
    variables = {"HOME": "\0/home", "LIBRARY": f"{ON_ROBOT}/lib"}
    member = Member(
        2, "robot", (f"{ON_ROBOT}/bin/{ARCH_ON_ROBOT}/go", "\0/input.xml", "-v"), variables, (), {"mark": f"{ON_ROBOT}/map.png"}
    )
    placed = member.at("/runs/7", "/code/1a2b", "aarch64")
    assert placed.argv == ("/code/1a2b/bin/aarch64/go", "/runs/7/input.xml", "-v")
    assert placed.environment == {"HOME": "/runs/7/home", "LIBRARY": "/code/1a2b/lib"}
    assert placed.folders == {"mark": "/code/1a2b/map.png"}
