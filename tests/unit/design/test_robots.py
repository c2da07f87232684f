"""The input file that lists the robots of a run; its bytes are part of identities, and so they are pinned."""

from __future__ import annotations

import pytest

from sierra.config.robots_table import RobotsTable
from sierra.design import robots
from sierra.errors import ConfigError, Damaged
from sierra.model import RunSpec
from sierra.util.hashing import digest

TABLE = RobotsTable.model_validate(
    {"count": "n", "base": {"command": "track"}, "groups": {"leader": {"places": [2], "command": "lead"}}}
)
INPUTS = {0: b"base", 1: b"one", 2: b"\xff\x00", 3: b"one"}
LISTED = (
    b'{"robots":[{"files":{"input.xml":"base"},"group":"base","place":0},{"group":"robot","place":1},'
    b'{"files":{"input.xml":{"base64":"/wA="}},"group":"leader","place":2},{"group":"robot","place":3}]}'
)


def test_the_file_lists_places_and_differing_inputs_and_is_read_again() -> None:
    places = robots.places(TABLE, {"n": 3})
    files = robots.inputs(places, lambda place: (("input.xml", INPUTS[place.number]), ("map.txt", b"same")))
    assert files == (("input.xml", b"one"), ("map.txt", b"same"), (robots.FILE, LISTED))
    read = robots.read(files)
    assert [place for place, _ in read] == list(places)
    assert [dict(theirs) for _, theirs in read] == [{"input.xml": INPUTS[n], "map.txt": b"same"} for n in range(4)]


def test_robots_with_files_of_other_names_are_refused() -> None:
    with pytest.raises(ConfigError, match=r"1\.xml is not there for all"):
        robots.inputs(robots.places(TABLE, {"n": 2}), lambda place: ((f"{max(place.number, 1)}.xml", b""),))


def test_commands_of_groups_are_in_the_specification_and_the_format_is_pinned() -> None:
    plain = RunSpec("command", ("go", "{robot}"), {}, None)
    on_robots = RunSpec("command", ("go", "{robot}"), {}, None, robots=TABLE.commands)
    assert digest("recipe", plain.preimage()) == "b383fc8db9ba40ccd7a5f4e42e66f7328dbbbaf26676ebe48daf92f7c698c6f0"
    assert digest("recipe", on_robots.preimage()) == "5893714c034836c6dabed262927a28dface1532577121bd71dd8ddde6c6341c1"
    assert "robots" not in plain.preimage()


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"[]",
        b'{"robots": 1}',
        b'{"robots": [{"place": "1", "group": "a"}]}',
        b'{"robots": [{"place": 1, "group": "a", "files": []}]}',
    ],
)
def test_a_damaged_file_is_noticed(content: bytes) -> None:
    with pytest.raises(Damaged, match="these are not the robots of a run"):
        robots.read((("input.xml", b""), (robots.FILE, content)))
    with pytest.raises(Damaged, match="its robots are unknown"):
        robots.read((("input.xml", b""),))
