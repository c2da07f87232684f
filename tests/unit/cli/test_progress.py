"""Progress of reports and videos: shown while it lasts on a terminal, and as lines in a log."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from tests.terminals import Terminal

SHOWN = """
from sierra.cli.progress import counting, telling
with telling(quiet=False) as tell:
    tell("figure 2 of 7: heat\\u202e")
    input()
with counting(quiet=False) as count:
    count(3, 10, "frames read")
    count(10, 10, "frames read")
    count(4, 10, "frames drawn")
    input()
print("the end")
"""


@pytest.mark.integration
def test_a_terminal_shows_the_part_that_is_being_made_and_how_many_are_done(tmp_path: Path) -> None:
    with Terminal(tmp_path, sys.executable, "-c", SHOWN) as terminal:
        terminal.expect("figure 2 of 7: heat\\u202e")
        terminal.type("\n")
        terminal.expect("10/10")
        terminal.expect("frames read")
        terminal.expect("4/10")
        terminal.expect("frames drawn")
        terminal.type("\n")
        terminal.expect("the end")
        assert terminal.end() == 0
