"""The platform `argos` passes the conformance suite, and its options are checked for any chosen platform."""

from __future__ import annotations

from collections.abc import Mapping

import pytest

from sierra.config import project_file
from sierra.config.plugin_registry import PLATFORMS
from sierra.design import platforms
from sierra.design.query import grammar
from sierra.errors import ConfigError
from sierra.extensions.argos.platform import Argos
from sierra.templates.xml import XmlTemplate
from sierra.testing import platforms as conformance

TEMPLATE = XmlTemplate(
    b"""<argos-configuration>
  <framework><experiment length="60" ticks_per_second="10"/></framework>
  <controllers><__CONTROLLER__ id="__CONTROLLER__" library="libx"/></controllers>
  <arena size="10,10,2" center="0,0,1">
    <distribute>
      <position method="uniform" min="-4,-4,0" max="4,4,0"/>
      <entity quantity="1" max_trials="100"><foot-bot id="fb"><controller config="__CONTROLLER__"/></foot-bot></entity>
    </distribute>
  </arena>
  <physics_engines><dynamics2d id="dyn2d"/></physics_engines>
  <visualization/>
</argos-configuration>""",
    "t.argos",
)
EXAMPLES = {
    criterion.name: criterion
    for criterion in map(
        grammar.parse,
        (
            "population_size.Log8",
            "population_constant_density.5p0.I16.C4",
            "population_variable_density.1p0.5p0.C4",
            "arena=10x10,20x10",
        ),
    )
}


OPTIONS = {
    "length": 30,
    "ticks_per_second": 5,
    "threads": 2,
    "arena": "12x10x2",
    "origin": "corner",
    "label": "foraging",
    "physics_iterations": 20,
}


def argos(options: Mapping[str, object] | None = None) -> project_file.Project:
    table = {"template": "t.argos", "platform": "argos", "platforms": {"argos": options or {}}}
    return project_file.parse(table, "sierra.toml")


def test_argos_conforms() -> None:
    conformance.check(Argos, argos(), TEMPLATE, EXAMPLES)


def test_argos_conforms_with_all_its_options() -> None:
    conformance.check(Argos, argos(OPTIONS), TEMPLATE, EXAMPLES)


@pytest.mark.parametrize("driving", ["command", "argos"])
def test_options_of_all_platforms_are_checked_for_any_chosen_platform(driving: str) -> None:
    project = project_file.parse(
        {"template": "t.xml", "platform": driving, "command": "x {input}", "platforms": {"argos": {"lenght": 3}}}, "sierra.toml"
    )
    with pytest.raises(ConfigError, match=r"\[platforms.argos\]: .*lenght.*length"):
        platforms.find(driving, project)


def test_argos_is_a_known_platform() -> None:
    assert PLATFORMS.names()[:2] == ("command", "argos")
