"""Rendering in ARGoS: the visualization and the camera paths that captures write into recorded inputs.

The XML was checked with ARGoS (commit 421bd763) and Qt 5.15 under Xvfb; these tests need neither.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from typing import Any

import pytest
from lxml import etree

from sierra.config import project_file
from sierra.design.platforms.base import Rendering
from sierra.errors import ConfigError
from sierra.extensions.argos.platform import Argos
from sierra.templates.xml import XmlTemplate
from sierra.testing import platforms

INPUT = """<argos-configuration>
  <framework><experiment length="60" ticks_per_second="10"/></framework>
  <arena size="8,3,1" center="1,2,0.5"/>
</argos-configuration>
"""
COMMAND = ("argos3", "-n", "-z", "-c", "{input}")
FLIGHT = {
    "path": [
        {"position": [0.0, 0.0, 9.0], "look_at": [0.0, 0.0, 0.0], "up": [0.0, 1.0, 0.0]},
        {"tick": 300, "position": [4.0, 1e-7, 2.5], "look_at": [0.0, 0.0, 0.0]},
    ],
    "focal_length": 35.0,
}


def rendering(capture: Mapping[str, object], cameras: Mapping[str, object] | None = None) -> Rendering:
    table = {"template": "t.argos", "platform": "argos", "platforms": {"argos": {"cameras": cameras or {}}}, "capture": capture}
    project = project_file.parse(table, "sierra.toml")
    return platforms.made(Argos, project).rendering(project.capture, COMMAND)


def rendered(capture: Mapping[str, object], cameras: Mapping[str, object] | None = None, recorded: str = INPUT) -> Any:
    """Return the element <qt-opengl> of a recorded input that renders."""
    document = XmlTemplate(recorded.encode(), "t.argos")
    made = document.changed(tuple(rendering(capture, cameras).changes(document)), {}).render()
    [found] = etree.fromstring(made).findall("visualization/qt-opengl")
    return found


def placements(qt: Any) -> list[dict[str, str]]:
    return [dict(one.attrib) for one in qt.iterfind("camera/placements/placement")]


def vector(text: str) -> tuple[float, ...]:
    return tuple(map(float, text.split(",")))


def test_frames_are_grabbed_on_a_display_that_holds_the_window() -> None:
    made = rendering({"size": [640, 480]})
    assert made.command == ("argos3", "-n", "-c", "{input}")
    assert (made.files, made.display) == ("frame_{tick}.png", (1004, 752))
    assert made.ticks_per_second(XmlTemplate(INPUT.encode(), "t.argos")) == 10
    qt = rendered({"size": [640, 480], "interval": 0.5})
    assert qt.get("autoplay") == "true"
    assert dict(qt.find("frame_grabbing").attrib) == {
        "directory": ".",
        "base_name": "frame_",
        "format": "png",
        "quality": "100",
        "headless_grabbing": "true",
        "headless_frame_size": "1004x752",
        "headless_frame_rate": "5",
    }


def test_the_camera_overhead_sees_the_whole_arena() -> None:
    """A lens of 20 mm sees 27 mm of the image's height, and 36 mm of its width."""
    qt = rendered({})
    [placement] = placements(qt)
    x, y, height = vector(placement["position"])
    assert ((x, y), vector(placement["look_at"])) == ((1, 2), (1, 2, 0))
    assert height * 27 / 20 > 3
    assert height * 36 / 20 == pytest.approx(1.1 * 8)
    assert qt.find("camera/timeline") is None


def test_the_camera_around_returns_to_its_place_at_the_end() -> None:
    qt = rendered({"camera": "around"})
    places = [vector(one["position"]) for one in placements(qt)]
    assert len(places) == 9
    assert places[0] == pytest.approx(places[-1])
    assert {round(math.dist(place[:2], (1, 2)), 4) for place in places} == {round(0.75 * math.hypot(8, 3), 4)}
    timeline = qt.find("camera/timeline")
    assert [int(one.get("step")) for one in timeline.iterfind("keyframe")] == [75 * k for k in range(9)]
    assert [one.tag for one in timeline] == ["keyframe", "interpolate"] * 8 + ["keyframe"]


def test_a_declared_path_takes_the_place_of_a_visualization() -> None:
    recorded = INPUT.replace("</argos", "<visualization><qt-opengl/></visualization></argos")
    qt = rendered({"camera": "flight"}, {"flight": {**FLIGHT, "interpolate": False}}, recorded)
    assert placements(qt) == [
        {"index": "0", "position": "0,0,9", "look_at": "0,0,0", "up": "0,1,0", "lens_focal_length": "35"},
        {"index": "1", "position": "4,0,2.5", "look_at": "0,0,0", "lens_focal_length": "35"},
    ]
    assert [dict(one.attrib) for one in qt.find("camera/timeline")] == [
        {"placement": "0", "step": "0"},
        {"placement": "1", "step": "300"},
    ]


def test_an_unknown_camera_is_refused_with_the_names_that_there_are() -> None:
    with pytest.raises(ConfigError, match=re.escape("[capture] camera: there is no camera 'top'; there are")):
        rendered({"camera": "top"}, {"flight": FLIGHT})


@pytest.mark.parametrize("ticks", [(5, 10), (0, 0), (0, 20, 10)])
def test_the_ticks_of_a_path_ascend_from_zero(ticks: tuple[int, ...]) -> None:
    path = [{"tick": tick, "position": [0.0, 0.0, 1.0], "look_at": [0.0, 0.0, 0.0]} for tick in ticks]
    with pytest.raises(ConfigError, match="the ticks of a path begin with 0 and ascend"):
        rendering({}, {"flight": {"path": path}})
