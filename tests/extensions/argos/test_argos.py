"""The platform `argos`: the inputs that it generates from a template; ARGoS itself is not needed."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable, Mapping
from contextlib import suppress
from fractions import Fraction
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from lxml import etree

from sierra.config import project_file
from sierra.design.query import grammar
from sierra.errors import ConfigError, QueryError, TemplateError
from sierra.extensions.argos import physics
from sierra.extensions.argos.platform import Argos, Size
from sierra.model import Change, Criterion, MonteCarlo, Set
from sierra.templates.xml import XmlTemplate
from sierra.testing import platforms
from tests import projects

TEMPLATE = """<?xml version="1.0"?>
<argos-configuration>
  <framework>
    <system threads="4"/>
    <experiment length="60" ticks_per_second="10"/>
  </framework>
  <controllers>
    <__CONTROLLER__ id="__CONTROLLER__" library="libforaging">
      <actuators><differential_steering implementation="default"/></actuators>
      <params><wheel_turning max_speed="10"/></params>
    </__CONTROLLER__>
  </controllers>
  <loop_functions library="libforaging_loop" label="foraging">
    <foraging items="15" output="foraging.txt"/>
  </loop_functions>
  <arena size="5, 5, 2" center="0,0,1">
    <floor id="floor" source="loop_functions" pixels_per_meter="50"/>
    <box id="wall_north" size="4,0.1,0.5" movable="false"><body position="0,2,0" orientation="0,0,0"/></box>
    <box id="wall_south" size="4,0.1,0.5" movable="false"><body position="0,-2,0" orientation="0,0,0"/></box>
    <box id="wall_east" size="0.1,4,0.5" movable="false"><body position="2,0,0" orientation="0,0,0"/></box>
    <box id="wall_west" size="0.1,4,0.5" movable="false"><body position="-2,0,0" orientation="0,0,0"/></box>
    <box id="crate" size="0.3,0.3,0.5" movable="true"><body position="1,1,0"/></box>
    <light id="light" position="-1,0,1" orientation="0,0,0" color="yellow" intensity="3" medium="leds"/>
    <distribute>
      <position method="uniform" min="-2,-2,0" max="-1,2,0"/>
      <orientation method="uniform" min="0,0,0" max="360,0,0"/>
      <entity quantity="20" max_trials="100">
        <foot-bot id="fb"><controller config="__CONTROLLER__"/></foot-bot>
      </entity>
    </distribute>
    <distribute>
      <position method="constant" values="0,0,0"/>
      <orientation method="constant" values="0,0,0"/>
      <entity quantity="1" max_trials="100"><cylinder id="c" height="0.5" radius="0.15" movable="false"/></entity>
    </distribute>
  </arena>
  <physics_engines><dynamics2d id="dyn2d"/></physics_engines>
  <media><led id="leds"/></media>
  <visualization><qt-opengl/></visualization>
</argos-configuration>
"""
EXPERIMENT = "framework/experiment"
QUANTITY = "arena/distribute/entity[foot-bot]/@quantity"
UNIFORM = "arena/distribute/position[@method='uniform']"

Made = Any
"""A root element of lxml."""


def platform(**options: object) -> Argos:
    return platforms.made(Argos, project(argos=options))


def project(argos: Mapping[str, object] | None = None, **table: object) -> project_file.Project:
    made = {"template": "t.argos", "platform": "argos", "controller": "foraging", "platforms": {"argos": argos or {}}}
    return project_file.parse({**made, **table}, "sierra.toml")


def reader(text: str = TEMPLATE) -> XmlTemplate:
    return XmlTemplate(text.encode(), "t.argos")


def without(text: str) -> str:
    assert text in TEMPLATE
    return TEMPLATE.replace(text, "")


def instead(old: str, new: str) -> str:
    assert old in TEMPLATE
    return TEMPLATE.replace(old, new)


def make(changes: tuple[Change, ...], template: str = TEMPLATE, controller: str = "foraging") -> Made:
    """Return the changed template, as a design changes it: the controller's name is among the values."""
    values: dict[str, int | float | str] = {"controller": controller, "scenario": "", "seed": 7, "run": 0}
    return etree.fromstring(reader(template).changed(changes, values).render())


def prepared(template: str = TEMPLATE, **options: object) -> Made:
    """Return the template that the platform changed and accepted."""
    driven = platform(**options)
    changes = driven.changes(reader(template))
    driven.check(changed(template, changes), reader(template))
    return make(changes, template)


def changed(template: str, changes: tuple[Change, ...]) -> XmlTemplate:
    """Return a template for queries after the changes, as a design does."""
    values: dict[str, int | float | str] = {"controller": "foraging"}
    return XmlTemplate(reader(template).changed(changes, values).render(), "t.argos")


def experiments(criterion: str, template: str = TEMPLATE, **options: object) -> dict[Any, Made]:
    """Return the templates that a criterion generates, by the values of the axis."""
    driven, read = platform(**options), reader(template)
    common = driven.changes(read)
    answer = driven.criterion(grammar.parse(criterion), changed(template, common))
    assert answer is not None
    axis, points = answer
    assert axis.values == tuple(point.value for point in points)
    return {point.value: make((*common, *point.changes), template) for point in points}


def one(made: Made, path: str) -> str:
    (found,) = made.xpath(path)
    return str(found)


def numbers(text: str) -> list[float]:
    return [float(part) for part in text.split(",")]


# The framework


def test_the_seed_is_added_if_the_template_has_no_seed() -> None:
    made = make(platform().seed_changes())
    assert one(made, f"{EXPERIMENT}/@random_seed") == "7"


def test_the_seed_replaces_the_seed_of_the_template() -> None:
    template = instead('ticks_per_second="10"', 'ticks_per_second="10" random_seed="123"')
    assert one(make(platform().seed_changes(), template), f"{EXPERIMENT}/@random_seed") == "7"


def test_length_and_ticks_of_the_template_are_kept_by_default() -> None:
    made = prepared()
    assert (one(made, f"{EXPERIMENT}/@length"), one(made, f"{EXPERIMENT}/@ticks_per_second")) == ("60", "10")


def test_options_set_length_and_ticks() -> None:
    made = prepared(length=12.5, ticks_per_second=4)
    assert (one(made, f"{EXPERIMENT}/@length"), one(made, f"{EXPERIMENT}/@ticks_per_second")) == ("12.5", "4")


def test_a_whole_length_is_written_without_a_decimal_point() -> None:
    assert one(prepared(length=300), f"{EXPERIMENT}/@length") == "300"


@pytest.mark.parametrize("length", ['length="0"', 'length="0.05"', 'length="-1"', ""])
def test_a_template_with_an_endless_experiment_is_refused(length: str) -> None:
    with pytest.raises(TemplateError, match=r"would never end; set length = 300 in \[platforms.argos\]"):
        prepared(instead('length="60"', length))


def test_the_length_option_makes_an_endless_template_valid() -> None:
    assert one(prepared(instead('length="60"', 'length="0"'), length=30), f"{EXPERIMENT}/@length") == "30"


def test_a_length_below_one_tick_is_refused() -> None:
    with pytest.raises(TemplateError, match="less than one tick"):
        prepared(length=0.05)


def test_a_length_with_more_ticks_than_argos_can_count_is_refused() -> None:
    with pytest.raises(TemplateError, match=r"more than the [0-9]+ ticks"):
        prepared(length=1e9)


@pytest.mark.parametrize("length", ["ten", "0x10", "1_000", "1e999999999", "9" * 100])
def test_a_length_that_is_not_a_number_is_refused(length: str) -> None:
    with pytest.raises(TemplateError, match="is not a number"):
        prepared(instead('length="60"', f'length="{length}"'))


def test_a_template_without_an_experiment_is_refused() -> None:
    with pytest.raises(TemplateError, match="framework/experiment; ARGoS needs it"):
        prepared(without('<experiment length="60" ticks_per_second="10"/>'))


def test_a_template_without_ticks_is_refused() -> None:
    with pytest.raises(TemplateError, match="has no ticks_per_second"):
        prepared(without(' ticks_per_second="10"'))


def test_runs_have_no_threads_unless_the_option_sets_them() -> None:
    assert one(prepared(), "framework/system/@threads") == "0"
    assert one(prepared(threads=3), "framework/system/@threads") == "3"


def test_threads_are_added_to_a_template_without_a_system_element() -> None:
    template = without('<system threads="4"/>')
    assert one(prepared(template, threads=2), "framework/system/@threads") == "2"
    assert prepared(template).xpath("framework/system") == []


def test_a_threading_method_that_hangs_is_refused_only_with_threads() -> None:
    template = instead('threads="4"', 'threads="4" method="balance_length"')
    with pytest.raises(TemplateError, match="hangs with 2 threads; use balance_quantity"):
        prepared(template, threads=2)
    assert one(prepared(template), "framework/system/@threads") == "0"


# The controller


def test_the_controller_name_replaces_every_placeholder() -> None:
    made = prepared()
    assert one(made, "controllers/foraging/@id") == one(made, "arena//controller/@config") == "foraging"
    assert b"__CONTROLLER__" not in etree.tostring(made)


def test_the_controllers_tag_may_differ_from_its_name() -> None:
    made = prepared(label="footbot_foraging_controller")
    assert one(made, "controllers/footbot_foraging_controller/@id") == "foraging"


def test_a_template_without_placeholder_keeps_its_controller() -> None:
    made = prepared(TEMPLATE.replace("__CONTROLLER__", "mine"))
    assert one(made, "controllers/mine/@id") == "mine"


def test_a_placeholder_within_other_text_is_refused() -> None:
    with pytest.raises(TemplateError, match="'lib__CONTROLLER__' contains __CONTROLLER__ among other text"):
        prepared(instead('"libforaging"', '"lib__CONTROLLER__"'))


# Visualization, command and files


def test_visualization_is_removed_by_default() -> None:
    assert prepared().xpath("visualization") == []


def test_a_template_without_visualization_is_accepted() -> None:
    assert prepared(without("<visualization><qt-opengl/></visualization>")).xpath("visualization") == []


def test_an_option_keeps_the_visualization() -> None:
    assert len(prepared(visualization=True).xpath("visualization/qt-opengl")) == 1


def test_argos_is_started_without_colours() -> None:
    assert platform().command() == ("argos3", "-n", "-c", "{input}")


def test_the_projects_command_overrides_the_platforms_command() -> None:
    assert platforms.made(Argos, project(command="xvfb-run argos3 -c {input}")).command() == (
        "xvfb-run",
        "argos3",
        "-c",
        "{input}",
    )


def test_a_command_without_an_input_placeholder_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"needs \{input\}"):
        platforms.made(Argos, project(command="argos3 -c my.argos"))


def test_one_document_is_written_as_one_file() -> None:
    assert platform().files(b"<a/>") == (("input.argos", b"<a/>"),)


@pytest.mark.parametrize(
    "options",
    [
        {"lenght": 3},
        {"length": 0},
        {"length": float("inf")},
        {"threads": -1},
        {"arena": "10"},
        {"arena": "0x10"},
        {"arena": "10x10x0"},
        {"arena": "١x٢"},  # noqa: RUF001
        {"arena": "10x10\n"},
        {"label": "a b"},
    ],
)
def test_invalid_options_are_refused(options: dict[str, object]) -> None:
    with pytest.raises(ConfigError, match=r"\[platforms.argos\]"):
        platform(**options)


def test_the_error_for_a_misspelt_option_suggests_the_correct_one() -> None:
    with pytest.raises(ConfigError, match="did you mean 'length'"):
        platform(lenght=3)


# The arena


def test_the_arena_option_sets_the_size_and_keeps_centre_and_height() -> None:
    made = prepared(arena="10x8")
    assert (one(made, "arena/@size"), one(made, "arena/@center")) == ("10,8,2", "0,0,1")


def test_a_higher_arena_keeps_its_floor_level() -> None:
    made = prepared(arena="10x8x3")
    assert (one(made, "arena/@size"), one(made, "arena/@center")) == ("10,8,3", "0,0,1.5")


def test_walls_are_moved_to_the_inner_edges_of_the_arena() -> None:
    made = prepared(arena="10x8")
    walls = {one(box, "@id"): (one(box, "@size"), one(box, "body/@position")) for box in made.xpath("arena/box[@id!='crate']")}
    assert walls == {
        "wall_north": ("10,0.1,0.5", "0,3.95,0"),
        "wall_south": ("10,0.1,0.5", "0,-3.95,0"),
        "wall_east": ("0.1,8,0.5", "4.95,0,0"),
        "wall_west": ("0.1,8,0.5", "-4.95,0,0"),
    }


def test_objects_that_are_not_walls_stay_in_place() -> None:
    made = prepared(arena="10x8")
    assert one(made, "arena/box[@id='crate']/body/@position") == "1,1,0"
    assert one(made, "arena/light/@position") == "-1,0,1"
    assert one(made, "arena/distribute/position[@method='constant']/@values") == "0,0,0"


def test_a_nest_along_one_wall_stays_along_that_wall() -> None:
    made = prepared(arena="10x8")
    low, high = numbers(one(made, f"{UNIFORM}/@min")), numbers(one(made, f"{UNIFORM}/@max"))
    assert low == [-4.9, -3.9, 0]
    assert high[0] == pytest.approx(-4.9 + 9.8 * 0.95 / 3.9)
    assert high[1:] == [3.9, 0]


def test_walls_are_recognized_by_position_and_not_by_name() -> None:
    template = TEMPLATE.replace("wall_north", "wall_x").replace("wall_east", "wall_north").replace("wall_x", "wall_east")
    made = prepared(template, arena="10x8")
    assert one(made, "arena/box[@id='wall_north']/body/@position") == "4.95,0,0"


def test_walls_that_do_not_fit_the_template_arena_are_moved_into_it() -> None:
    """In such a template, the walls are around 0, and the arena reaches from 0 to 5."""
    made = prepared(instead('center="0,0,1"', 'center="2.5,2.5,1"'), arena="5x5")
    assert one(made, "arena/box[@id='wall_west']/body/@position") == "0.05,2.5,0"
    assert numbers(one(made, f"{UNIFORM}/@min"))[:2] == [0.1, 0.1]


@pytest.mark.parametrize("id", ["wall's", 'wall"', "wall'\"both"])
def test_walls_may_have_ids_with_quotation_marks(id: str) -> None:
    quoted = id.replace('"', "&quot;")
    made = prepared(instead('"wall_north"', f'"{quoted}"'), arena="10x8")
    assert [box.get("size") for box in made.xpath("arena/box") if box.get("id") == id] == ["10,0.1,0.5"]


def test_robots_are_distributed_to_the_edges_of_an_arena_without_walls() -> None:
    template = TEMPLATE.replace('id="wall_', 'id="block_').replace('min="-2,-2,0"', 'min="-2.5,-2.5,0"')
    made = prepared(template, arena="10x10")
    assert one(made, f"{UNIFORM}/@min") == "-5,-5,0"
    assert one(made, "arena/box[@id='block_north']/@size") == "4,0.1,0.5"


def test_an_option_selects_walls_with_other_names() -> None:
    template = TEMPLATE.replace('id="wall_', 'id="fence_')
    made = prepared(template, arena="10x8", walls="//box[starts-with(@id, 'fence')]")
    assert one(made, "arena/box[@id='fence_north']/@size") == "10,0.1,0.5"


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ('id="wall_north"', 'id="gate"'),  # three
        ('id="crate"', 'id="wall_inner"'),  # five
        ('position="0,2,0"', 'position="0,-2,0"'),  # two on one side
        ('position="0,2,0" orientation="0,0,0"', 'position="0,2,0" orientation="45,0,0"'),
        ('size="4,0.1,0.5" movable="false"><body position="0,2,0"', 'size="4,0.1,0.5" movable="false"><body '),
        ('"4,0.1,0.5"', '"4,0.1"'),
        ('"4,0.1,0.5"', '"four,0.1,1"'),
    ],
)
def test_walls_other_than_one_on_each_side_are_refused(old: str, new: str) -> None:
    with pytest.raises(TemplateError):
        prepared(instead(old, new), arena="10x8")


def test_walls_are_checked_only_if_the_arena_changes() -> None:
    assert one(prepared(instead('id="wall_north"', 'id="gate"')), "arena/@size") == "5, 5, 2"


def test_an_arena_smaller_than_its_walls_is_refused() -> None:
    with pytest.raises(TemplateError, match="no space between"):
        prepared(arena="0.2x0.2")


def test_physics_engines_with_their_own_boundaries_are_refused() -> None:
    template = instead('<dynamics2d id="dyn2d"/>', '<dynamics2d id="dyn2d"><boundaries/></dynamics2d>')
    with pytest.raises(TemplateError, match="boundaries would not follow"):
        prepared(template, arena="10x8")


def test_robots_distributed_outside_the_walls_are_refused() -> None:
    with pytest.raises(TemplateError, match="outside the walls"):
        prepared(instead('min="-2,-2,0" max="-1,2,0"', 'min="3,3,0" max="4,4,0"'), arena="10x8")


def test_arena_sizes_are_a_criterion() -> None:
    made = experiments("arena=10x10,20x10")
    assert {name: one(root, "arena/@size") for name, root in made.items()} == {"10x10": "10,10,2", "20x10": "20,10,2"}


@pytest.mark.parametrize("wrong", ["arena=10,20", "arena.Log8", "arena=big", "arena=10x10,10.0x10", "arena=0x1"])
def test_invalid_arena_sizes_are_refused(wrong: str) -> None:
    with pytest.raises(QueryError, match="arena"):
        experiments(wrong)


@pytest.mark.integration
@given(st.decimals(1, 1000, places=3), st.decimals(1, 1000, places=3))
def test_robots_start_between_the_walls_and_walls_are_inside_an_arena_of_any_size(x: object, y: object) -> None:
    made = prepared(arena=f"{x}x{y}")
    sides = numbers(one(made, "arena/@size"))[:2]
    low, high = numbers(one(made, f"{UNIFORM}/@min")), numbers(one(made, f"{UNIFORM}/@max"))
    for axis in (0, 1):
        assert -sides[axis] / 2 + 0.1 <= low[axis] + 1e-9
        assert low[axis] < high[axis] <= sides[axis] / 2 - 0.1 + 1e-9
    for box in made.xpath("arena/box[@id!='crate']"):
        extents = zip(numbers(box.get("size")), numbers(one(box, "body/@position")), sides, strict=False)
        assert all(abs(place) + size / 2 <= side / 2 + 1e-9 for size, place, side in extents)


# Populations


def test_population_size_sets_the_quantity_of_the_robots() -> None:
    made = experiments("population_size.Log8")
    assert [one(root, QUANTITY) for root in made.values()] == ["1", "2", "4", "8"]
    assert {one(root, "arena/distribute/entity[cylinder]/@quantity") for root in made.values()} == {"1"}


def test_the_population_axis_has_a_name_and_a_label() -> None:
    answer = platform().criterion(grammar.parse("population_size.Log8"), reader())
    assert answer is not None
    assert (answer[0].name, answer[0].label) == ("population_size", "Population size")


@pytest.mark.parametrize("wrong", ["=0.5,1", "=0,1", "=-1,1", "=few,many", "=1:8:5", "=1,4294967296", ".5p0.I16.C4"])
def test_populations_that_are_not_whole_numbers_are_refused(wrong: str) -> None:
    with pytest.raises(QueryError):
        experiments(f"population_size{wrong}")


def test_a_count_without_values_is_not_a_population() -> None:
    with pytest.raises(QueryError, match=r"population_size\.Log8"):
        platform().criterion(Criterion("population_size", MonteCarlo(3)), reader())


def test_a_template_with_two_kinds_of_robots_needs_the_population_option() -> None:
    template = instead("<cylinder ", '<cylinder2><controller config="x"/></cylinder2><cylinder ')
    with pytest.raises(TemplateError, match="set population in"):
        experiments("population_size.Log8", template)
    made = experiments("population_size.Log8", template, population="//entity[cylinder]/@quantity")
    assert one(made[8], "arena/distribute/entity[cylinder]/@quantity") == "8"


def test_a_population_is_refused_if_a_robot_is_placed_by_hand() -> None:
    template = instead("<light ", '<foot-bot id="leader"><controller config="x"/></foot-bot><light ')
    with pytest.raises(TemplateError, match="must have exactly one kind of robots"):
        experiments("population_size.Log8", template)


def test_a_template_without_robots_has_no_population() -> None:
    with pytest.raises(TemplateError, match="must have exactly one kind of robots"):
        experiments("population_size.Log8", without('<controller config="__CONTROLLER__"/>'))


def test_the_population_option_must_select_an_attribute() -> None:
    with pytest.raises(ConfigError, match="selects an element"):
        experiments("population_size.Log8", population="//entity[foot-bot]")


# Densities


def test_the_arena_grows_from_the_templates_size_at_constant_density() -> None:
    made = experiments("population_constant_density.5p0.I16.C4")
    assert [one(root, "arena/@size") for root in made.values()] == ["5,5,2", "21,21,2", "37,37,2", "53,53,2"]
    assert list(made) == [1, 22, 68, 140]
    assert [one(root, QUANTITY) for root in made.values()] == ["1", "22", "68", "140"]


def test_walls_and_robots_grow_with_the_arena() -> None:
    made = experiments("population_constant_density.5p0.I16.C4")[22]
    assert one(made, "arena/box[@id='wall_north']/@size") == "21,0.1,0.5"
    assert one(made, "arena/box[@id='wall_north']/body/@position") == "0,10.45,0"
    assert one(made, f"{UNIFORM}/@min") == "-10.4,-10.4,0"


def test_the_arena_grows_from_the_size_of_the_arena_option() -> None:
    made = experiments("population_constant_density.5p0.I5.C2", arena="20x10")
    assert {n: one(root, "arena/@size") for n, root in made.items()} == {10: "20,10,2", 18: "25,15,2"}


def test_populations_are_computed_from_exact_percentages() -> None:
    """In floats 0.29 · 100 is 28.999…"""
    assert list(experiments("population_constant_density.29p0.I1.C1", arena="10x10")) == [29]


def test_the_arena_keeps_its_size_at_variable_density() -> None:
    made = experiments("population_variable_density.1p0.5p0.C5", arena="20x20")
    assert list(made) == [4, 8, 12, 16, 20]
    assert {one(root, "arena/@size") for root in made.values()} == {"20,20,2"}


def test_densities_may_decrease() -> None:
    assert list(experiments("population_variable_density.5p0.1p0.C3", arena="20x20")) == [20, 12, 4]


def test_the_error_for_less_than_one_robot_suggests_a_valid_density() -> None:
    with pytest.raises(QueryError, match=r"gives 0\.25 robots, less than one; use a density of 4 or more"):
        experiments("population_constant_density.1p0.I16.C4")
    assert next(iter(experiments("population_constant_density.4p0.I16.C4"))) == 1
    with pytest.raises(QueryError, match="less than one"):
        experiments("population_variable_density.1p0.50p0.C4", arena="5x5")


def test_the_error_for_equal_populations_suggests_a_valid_increment() -> None:
    with pytest.raises(QueryError, match=r"two arenas have 1 robots; use an increment of I1p71 or more"):
        experiments("population_constant_density.5p0.I0p5.C4")
    assert len(experiments("population_constant_density.5p0.I1p71.C4")) == 4


def test_the_error_for_two_densities_of_one_population_suggests_a_valid_count() -> None:
    with pytest.raises(QueryError, match="use C5"):
        experiments("population_variable_density.1p0.5p0.C9", arena="10x10")
    assert len(experiments("population_variable_density.1p0.5p0.C5", arena="10x10")) == 5


def test_a_density_needs_walls_that_bound_the_arena() -> None:
    with pytest.raises(TemplateError, match=r'away from the edge of the 5x5 arena.*set arena = "5x5"'):
        experiments("population_variable_density.10p0.50p0.C3")
    assert list(experiments("population_variable_density.10p0.50p0.C3", arena="5x5")) == [2, 7, 12]


def test_walls_across_the_edges_bound_the_arena() -> None:
    assert list(experiments("population_variable_density.10p0.50p0.C3", instead('"5, 5, 2"', '"4,4,2"'))) == [1, 4, 8]


@pytest.mark.parametrize("name", ["population_constant_density", "population_variable_density"])
def test_densities_refuse_the_ranges_of_other_criteria(name: str) -> None:
    with pytest.raises(QueryError, match=name):
        experiments(f"{name}.Log8")


@pytest.mark.parametrize("size", ["5,5", "a,b,c", "0,5,1", "1/2,1,1", "1e999,1,1"])
def test_a_density_is_refused_for_an_arena_without_a_valid_size(size: str) -> None:
    with pytest.raises(TemplateError, match="arena/@size"):
        experiments("population_constant_density.5p0.I16.C4", instead('"5, 5, 2"', f'"{size}"'))


DENSITIES = st.decimals("0.01", 1000, places=2)


@pytest.mark.integration
@given(DENSITIES, st.decimals("0.1", 50, places=1), st.integers(1, 8))
def test_a_constant_density_is_either_refused_or_exact(density: object, increment: object, count: int) -> None:
    steps = (str(density).replace(".", "p"), "I" + str(increment).replace(".", "p"), f"C{count}")
    criterion = grammar.parse(".".join(("population_constant_density", *steps)))
    answer = None
    with suppress(QueryError):
        answer = platform().criterion(criterion, reader())
    if answer is None:
        return
    populations = [value for value in answer[0].values if isinstance(value, int)]
    for index, population in enumerate(populations):
        area = (5 + index * Fraction(str(increment))) ** 2
        assert population <= area * Fraction(str(density)) / 100 < population + 1
    assert len(populations) == count
    assert all(1 <= less < more for less, more in pairwise(populations))


@pytest.mark.parametrize(
    "criterion",
    ["population_variable_density.1p0.5p0.C5", "population_constant_density.5p0.I5.C2", "arena=10x10,20x10"],
)
def test_criteria_that_depend_on_the_arena_set_its_size(criterion: str) -> None:
    """A design then detects that two of them conflict: they change the same attribute."""
    driven = platform(arena="20x20")
    answer = driven.criterion(grammar.parse(criterion), changed(TEMPLATE, driven.changes(reader())))
    assert answer is not None
    assert all("/argos-configuration/arena/@size" in {c.path for c in point.changes} for point in answer[1])


def test_a_size_is_displayed_in_the_notation_of_queries() -> None:
    assert str(Size(Fraction(10), Fraction(5, 2), Fraction(1))) == "10x2.5x1"


@pytest.mark.parametrize("hostile", ["{", "}", "{seed}", "{{}}", "' or '1'='1", "a&#10;b"])
@pytest.mark.parametrize("old", ['"5, 5, 2"', '"60"', '"-2,-2,0"', '"0,2,0"', '"4,0.1,0.5"'])
def test_errors_about_hostile_texts_in_the_template_have_one_line(old: str, hostile: str) -> None:
    with pytest.raises(TemplateError) as told:
        prepared(instead(old, f'"{hostile}"'), arena="10x8")
    assert len(str(told.value).splitlines()) == 1


@pytest.mark.parametrize("hostile", ["{", "}", "{seed}", "{{}}", "wall' or '1'='1", "wall&#10;b"])
def test_hostile_ids_of_walls_are_accepted_or_reported_in_one_line(hostile: str) -> None:
    template = instead('"crate"', f'"wall{hostile}"')
    with pytest.raises(TemplateError, match="set walls in") as told:
        prepared(template, arena="10x8")
    assert len(str(told.value).splitlines()) == 1
    made = prepared(instead('"wall_north"', f'"wall{hostile}"'), arena="10x8")
    assert len(made.xpath("arena/box[@size='10,0.1,0.5']")) == 2


# Batches, with a program in place of ARGoS that reports its inputs

SEEN = """\
import sys
import xml.etree.ElementTree as ET

root = ET.parse(sys.argv[1]).getroot()
arena = root.find("arena")
x, y, _ = arena.get("size").split(",")
robots = next(entity for entity in arena.iter("entity") if entity.find("foot-bot") is not None)
walls = [box.get("size") for box in arena.iter("box") if box.get("id").startswith("wall")]
with open("seen.csv", "w") as file:
    print("x,y,robots,length,walls", file=file)
    length = root.find("framework/experiment").get("length")
    fitting = sum(wall in (f"{float(x):g},0.1,0.5", f"0.1,{float(y):g},0.5") for wall in walls)
    print(float(x), float(y), robots.get("quantity"), length, fitting, sep=",", file=file)
"""
CONFIG = """\
template = "arena.argos"
platform = "argos"
command = "{python} {project}/sim.py {input}"
controller = "foraging"
runs = 1
[platforms.argos]
arena = "10x10"
[controllers.foraging]
[variables]
seconds = "/argos-configuration/framework/experiment[1]/@length"
length = "//experiment/@length"
"""
BIG = """
[scenarios.big]
changes = [
    { set = "//arena/@size", value = "20,20,2" },
    { set = "//box[@id='wall_north']/body/@position", value = "0,10,0" },
    { set = "//box[@id='wall_south']/body/@position", value = "0,-10,0" },
    { set = "//box[@id='wall_east']/body/@position", value = "10,0,0" },
    { set = "//box[@id='wall_west']/body/@position", value = "-10,0,0" },
    { set = "//box[@id='wall_north' or @id='wall_south']/@size", value = "20,0.1,0.5" },
    { set = "//box[@id='wall_east' or @id='wall_west']/@size", value = "0.1,20,0.5" },
]
[scenarios.plain]
"""


def argos_project(folder: Path, config: str = CONFIG, template: str = TEMPLATE) -> Path:
    projects.make(folder, config, simulator=SEEN)
    (folder / "arena.argos").write_text(template)
    return folder


def seen(folder: Path, *words: str) -> list[dict[str, Any]]:
    """Return what is in the inputs of a query's runs; the inputs are written, and no run is executed."""
    target = folder.with_name("inputs")
    wrote = projects.quick(folder, "inputs", *words, "--to", str(target))
    assert wrote.returncode == 0, wrote.stderr + wrote.stdout
    rows = []
    for file in target.glob("runs/*/*/input.argos"):
        subprocess.run([sys.executable, "-S", folder / "sim.py", file], cwd=target, check=True)
        names, values = (line.split(",") for line in (target / "seen.csv").read_text().splitlines())
        rows.append(dict(zip(names, map(float, values), strict=True)))
    return sorted(rows, key=lambda row: (row["robots"], row["x"], row["length"]))


def executed(folder: Path, *words: str) -> list[dict[str, Any]]:
    """Return what was in the inputs of all runs so far, after a query was executed."""
    ran = projects.quick(folder, "run", *words, "--no-figures")
    assert ran.returncode == 0, ran.stderr + ran.stdout
    asked = projects.quick(folder, "sql", "--json", "SELECT x, y, robots, length, walls FROM seen ORDER BY robots, x, length")
    assert asked.returncode == 0, asked.stderr
    rows: list[dict[str, Any]] = json.loads(asked.stdout)
    return rows


def refused(folder: Path, *words: str) -> str:
    """Return the error line with which a query is refused."""
    ran = projects.quick(folder, "run", *words, "-n")
    assert ran.returncode == 2, ran.stderr + ran.stdout
    assert len(ran.stderr.splitlines()) == 1
    return ran.stderr


LONG = (
    CONFIG
    + """
[scenarios.long]
platform = { length = 120 }
[scenarios.wide]
platform = { length = 120, arena = "20x20" }
[scenarios.also_long.platform]
length = 120
[scenarios.same]
platform = { arena = "10x10" }
[scenarios.plain]
"""
)


@pytest.mark.nightly
def test_a_scenario_sets_options_of_the_platform_for_its_runs(tmp_path: Path) -> None:
    folder = argos_project(tmp_path / "p", LONG)
    plain = executed(folder, "population_size=20")
    assert [(row["x"], row["length"]) for row in plain] == [(10, 60)]
    rows = executed(folder, "population_size=20", "--scenario", "wide")
    assert [(row["x"], row["length"], row["walls"]) for row in rows] == [(10, 60, 4), (20, 120, 4)]
    listed = json.loads(projects.quick(folder, "ls", "--json").stdout)
    assert len({one["batch"] for one in listed}) == 2
    executed(folder, "population_size=20", "--scenario", "same")
    assert len(json.loads(projects.quick(folder, "ls", "--json").stdout)) == 2, "the options change nothing, so no id"
    assert [row["length"] for row in executed(folder, "scenario=long,also_long")] == [60, 120, 120, 120]


@pytest.mark.parametrize(
    ("config", "words", "message"),
    [
        (LONG, ("scenario=long,plain",), "scenarios 'long' and 'plain' have different options of the platform 'argos'"),
        (LONG + "[scenarios.bad]\nplatform = { lenght = 3 }\n", ("population_size=1",), "scenario 'bad': [platforms.argos]"),
    ],
)
def test_options_of_scenarios_that_differ_in_a_batch_or_are_unknown_are_refused(
    tmp_path: Path, config: str, words: tuple[str, ...], message: str
) -> None:
    assert message in refused(argos_project(tmp_path / "p", config), *words)


@pytest.mark.parametrize(
    ("criterion", "expected"),
    [
        ("population_variable_density.1p0.3p0.C3", [(20, 4), (20, 8), (20, 12)]),
        ("population_constant_density.1p0.I10.C2", [(20, 4), (30, 9)]),
    ],
)
def test_a_density_is_computed_for_the_arena_of_the_scenario(
    tmp_path: Path, criterion: str, expected: list[tuple[int, int]]
) -> None:
    rows = seen(argos_project(tmp_path / "p", CONFIG + BIG), criterion, "--scenario", "big")
    assert [(row["x"], row["robots"]) for row in rows] == expected


def test_a_density_is_computed_for_the_arena_that_the_command_line_sets(tmp_path: Path) -> None:
    template = TEMPLATE.replace('id="wall_', 'id="block_')
    folder = argos_project(tmp_path / "p", CONFIG.replace('arena = "10x10"', ""), template)
    rows = seen(folder, "population_variable_density.1p0.2p0.C2", "--set", "//arena/@size=20,10,2")
    assert [(row["x"], row["y"], row["robots"]) for row in rows] == [(20, 10, 2), (20, 10, 4)]


def test_walls_follow_a_growing_arena(tmp_path: Path) -> None:
    rows = seen(argos_project(tmp_path / "p"), "population_constant_density.1p0.I10.C3")
    assert [(row["x"], row["robots"], row["walls"]) for row in rows] == [(10, 1, 4), (20, 4, 4), (30, 9, 4)]


def test_a_fixed_arena_conflicts_with_a_growing_one(tmp_path: Path) -> None:
    told = refused(argos_project(tmp_path / "p"), "population_constant_density.1p0.I10.C3", "--set", "//arena/@size=20,20,2")
    assert "is overwritten: --set //arena/@size changes the same value later" in told


BLOCKS = """
[controllers.walking]
[scenarios.few]
changes = [{ set = "//arena/@size", value = "10,10,2" }, { set = "//foraging/@items", value = "3" }]
[scenarios.many]
changes = [{ set = "/argos-configuration/arena/@size", value = "10,10,2" }, { set = "//foraging/@items", value = "30" }]
[scenarios."Sized.{x}x{y}x{z}"]
changes = [{ set = "//arena/@size", value = "{x},{y},{z}" }]
"""


def inputs(folder: Path, *words: str) -> list[Made]:
    """Return the inputs of a query's runs, in the order of their experiments."""
    wrote = projects.quick(folder, "inputs", *words, "--to", str(folder.with_name("inputs")))
    assert wrote.returncode == 0, wrote.stderr + wrote.stdout
    return [etree.parse(file).getroot() for file in sorted(folder.with_name("inputs").glob("runs/*/*/input.argos"))]


def test_controllers_are_compared_by_an_axis(tmp_path: Path) -> None:
    made = inputs(argos_project(tmp_path / "p", CONFIG + BLOCKS), "controller=foraging,walking", "arena=10x10,20x20")
    assert [(one(m, "//foot-bot/controller/@config"), m.find("controllers")[0].tag, one(m, "arena/@size")) for m in made] == [
        (name, name, size) for name in ("foraging", "walking") for size in ("10,10,2", "20,20,2")
    ]


def test_a_scenario_with_an_arena_sets_the_rest_if_a_density_sets_the_arena(tmp_path: Path) -> None:
    words = ("scenario=few,many", "population_constant_density.5p0.I10.C2")
    made = inputs(argos_project(tmp_path / "p", CONFIG + BLOCKS), *words)
    assert [(one(m, "//foraging/@items"), one(m, "arena/@size"), one(m, QUANTITY)) for m in made] == [
        (items, size, robots) for items in ("3", "30") for size, robots in (("10,10,2", "5"), ("20,20,2", "20"))
    ]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("scenario=Sized.10x10x2,few", "population_constant_density.5p0.I10.C2"), "leave scenario=Sized.10x10x2 out"),
        (("scenario=few", "arena=20x20,30x30"), "arena=20x20 changes the same value later; use one of them\n"),
    ],
)
def test_a_scenario_that_a_criterion_overwrites_is_refused_with_advice_that_helps(
    tmp_path: Path, words: tuple[str, ...], message: str
) -> None:
    assert message in refused(argos_project(tmp_path / "p", CONFIG + BLOCKS), *words)


def test_a_density_with_different_populations_per_scenario_is_refused(tmp_path: Path) -> None:
    folder = argos_project(tmp_path / "p", CONFIG + BIG)
    told = refused(folder, "scenario=plain,big", "population_variable_density.1p0.3p0.C3")
    assert (
        "population_variable_density is 1, 2, 3 with scenario=plain, but 4, 8, 12 with scenario=big; use one of these" in told
    )


@pytest.mark.parametrize("query", [("population_variable_density.1p0.3p0.C3",), ("population_size.Log4",)])
def test_a_population_that_another_change_overwrites_is_refused_as_an_axis(tmp_path: Path, query: tuple[str, ...]) -> None:
    told = refused(argos_project(tmp_path / "p"), *query, "--set", "//entity/@quantity=7")
    assert "=1 is overwritten: --set //entity/@quantity changes the same value later" in told


def test_two_axes_that_set_one_attribute_by_different_paths_are_refused(tmp_path: Path) -> None:
    told = refused(argos_project(tmp_path / "p"), "length=30,60", "seconds=10,20")
    assert "length=30 is overwritten: seconds=10 changes the same value later; use one of them" in told


def test_an_axis_before_a_scenario_that_adds_robots_is_refused(tmp_path: Path) -> None:
    """Robots that a scenario adds would not get the value that the preceding axis sets in all robots."""
    more = """
speed = "//wheel_turning/@max_speed"
[scenarios.more]
changes = [{ add = "//controllers", xml = '<other id="other"><params><wheel_turning max_speed="3"/></params></other>' }]
"""
    folder = argos_project(tmp_path / "p", CONFIG + more)
    told = refused(folder, "speed=1,2", "scenario=more")
    assert "speed=1 is overwritten: scenario=more changes the same value later; use one of them, or in another order" in told
    assert projects.quick(folder, "run", "scenario=more", "speed=1,2", "-n").returncode == 0


@pytest.mark.nightly
def test_other_axes_combine_with_the_platforms_own(tmp_path: Path) -> None:
    rows = seen(argos_project(tmp_path / "p"), "population_size.Log2", "length=30,60", "arena=10x10,20x20")
    assert {(row["robots"], row["length"], row["x"]) for row in rows} == {
        (robots, length, side) for robots in (1, 2) for length in (30, 60) for side in (10, 20)
    }
    assert all(row["walls"] == 4 for row in rows)


def test_the_projects_changes_may_set_the_length(tmp_path: Path) -> None:
    config = 'changes = [{ set = "//experiment/@length", value = 30 }]\n' + CONFIG
    rows = seen(argos_project(tmp_path / "p", config, instead('length="60"', 'length="0"')), "population_size=1")
    assert rows[0]["length"] == 30


@pytest.mark.parametrize("words", [("population_size=1", "--set", "//experiment/@length=0"), ("length=60,0",)])
def test_queries_that_make_runs_endless_are_refused(tmp_path: Path, words: tuple[str, ...]) -> None:
    assert "the run would never end" in refused(argos_project(tmp_path / "p"), *words)


def test_threads_that_would_hang_are_refused_on_the_command_line(tmp_path: Path) -> None:
    template = instead('threads="4"', 'threads="4" method="balance_length"')
    told = refused(argos_project(tmp_path / "p", template=template), "population_size=1", "--set", "//system/@threads=2")
    assert "hangs with 2 threads" in told


SIZED = """
side = { changes = [{ set = "//arena/@size", value = "{side},{side},2" }] }
north = { changes = [{ set = "//arena/@center", value = "0,{north},1" }] }
[scenarios.large]
changes = [{ set = "//arena/@size", value = "20,20,2" }]
[scenarios."Blocks.{x}x{y}x{z}"]
changes = [{ set = "//arena/@size", value = "{x},{y},{z}" }]
"""
COPY = """import json, sys
with open("copy.jsonl", "w") as file:
    print(json.dumps({"input": open(sys.argv[1]).read()}), file=file)
"""


@pytest.mark.parametrize(
    ("words", "x"),
    [
        (("population_size=1", "--set", "//arena/@size=20,20,2"), [20]),
        (("population_size=1", "--set", "/argos-configuration/arena/@size=20, 8, 2"), [20]),
        (("side=10,20",), [10, 20]),
        (("population_size=1", "--scenario", "large"), [20]),
        (("scenario=large", "population_size=1"), [20]),
        (("population_size=1", "--scenario", "Blocks.30x20x2"), [30]),
        (("scenario=Blocks.30x20x2,Blocks.20x20x2", "population_size=1"), [20, 30]),
        (("north=3,6",), [10, 10]),
        (("population_variable_density.1p0.2p0.C2", "--scenario", "large"), [20, 20]),
        (("population_constant_density.1p0.I10.C2", "--scenario", "large"), [20, 30]),
    ],
)
def test_walls_follow_the_arena_whoever_changes_it(tmp_path: Path, words: tuple[str, ...], x: list[int]) -> None:
    rows = seen(argos_project(tmp_path / "p", CONFIG + SIZED), *words)
    assert [row["x"] for row in rows] == x
    assert all(row["walls"] == 4 for row in rows)


@pytest.mark.nightly
def test_what_follows_is_the_same_as_with_the_option(tmp_path: Path) -> None:
    by_option = prepared(arena="20x8")
    resized = projects.make(tmp_path / "p", CONFIG.replace('arena = "10x10"', "") + SIZED, simulator=COPY)
    (resized / "arena.argos").write_text(TEMPLATE)
    assert projects.quick(resized, "run", "population_size=20", "--set", "//arena/@size=20,8,2", "--no-figures").returncode == 0
    (made,) = projects.sql(resized, "SELECT input FROM copy")
    followed = etree.fromstring(made["input"].encode())
    for path in ("//arena/@*", "//box/@*", "//box/body/@*", "//position/@*"):
        assert sorted(followed.xpath(path)) == sorted(by_option.xpath(path))


def test_robots_follow_an_arena_without_walls(tmp_path: Path) -> None:
    driven = platform()
    template = TEMPLATE.replace('id="wall_', 'id="block_')
    larger = template.replace('size="5, 5, 2"', 'size="10, 10, 2"')
    changes = driven.follow(reader(larger), reader(template))
    made = make(changes, larger)
    assert (one(made, f"{UNIFORM}/@min"), one(made, f"{UNIFORM}/@max")) == ("-4,-4,0", "-2,4,0")


@pytest.mark.parametrize("moved", ["wall", "position"])
def test_nothing_follows_if_another_change_has_moved_a_part(moved: str) -> None:
    larger = instead('size="5, 5, 2"', 'size="10, 10, 2"')
    other = (
        larger.replace('position="0,2,0"', 'position="0,4.95,0"')
        if moved == "wall"
        else larger.replace('"-2,-2,0"', '"-1,-1,0"')
    )
    assert other != larger
    assert platform().follow(reader(other), reader()) == ()


def test_nothing_follows_an_arena_that_only_becomes_higher() -> None:
    assert platform().follow(reader(instead('size="5, 5, 2"', 'size="5,5,4"')), reader()) == ()


@pytest.mark.parametrize(
    ("origin", "center", "low"),
    [("corner", "5,4,1", ["0.05", "4"]), ("centre", "0,0,1", ["-4.95", "0"])],
)
def test_the_origin_is_a_corner_or_the_centre(origin: str, center: str, low: list[str]) -> None:
    made = prepared(origin=origin, arena="10x8")
    assert one(made, "arena/@center") == center
    assert one(made, "arena/box[@id='wall_west']/body/@position").split(",")[:2] == low


def test_the_origin_moves_the_templates_arena_too() -> None:
    made = prepared(origin="corner")
    assert one(made, "arena/@center") == "2.5,2.5,1"
    assert one(made, "arena/@size") == "5,5,2"
    assert one(made, "arena/box[@id='wall_north']/body/@position") == "2.5,4.95,0"
    low, high = numbers(one(made, f"{UNIFORM}/@min")), numbers(one(made, f"{UNIFORM}/@max"))
    assert 0 <= low[0] < high[0] <= 5
    assert 0 <= low[1] < high[1] <= 5


@pytest.mark.integration
def test_walls_follow_the_corner_of_a_scenarios_arena(tmp_path: Path) -> None:
    config = CONFIG.replace('arena = "10x10"', 'arena = "10x10"\norigin = "corner"')
    folder = projects.make(tmp_path / "p", config + SIZED, simulator=COPY)
    (folder / "arena.argos").write_text(TEMPLATE)
    ran = projects.quick(folder, "run", "population_size=1", "--scenario", "Blocks.30x20x2", "--no-figures")
    assert ran.returncode == 0, ran.stderr
    (made,) = projects.sql(folder, "SELECT input FROM copy")
    followed = etree.fromstring(made["input"].encode())
    assert one(followed, "arena/@center") == "15,10,1"
    assert one(followed, "arena/box[@id='wall_east']/body/@position") == "29.95,10,0"


def test_an_arena_size_that_each_run_sets_is_refused_if_walls_stay_behind(tmp_path: Path) -> None:
    run_changes = 'run_changes = [{ set = "//arena/@size", value = "{side},{side},2" }]\nper_run = { side = [10, 20] }\n'
    folder = argos_project(tmp_path / "p", run_changes + CONFIG)
    assert projects.quick(folder, "run", "population_size=1", "--runs", "1", "-n").returncode == 0
    assert "20x20 arena" in refused(folder, "population_size=1", "--runs", "2")


def test_walls_may_be_moved_by_the_projects_changes(tmp_path: Path) -> None:
    [row] = seen(argos_project(tmp_path / "p", CONFIG + BIG), "population_size=1", "--scenario", "big")
    assert (row["x"], row["walls"]) == (20, 4)


def test_walls_with_gaps_between_them_do_not_bound_the_arena(tmp_path: Path) -> None:
    short = BIG.replace('value = "0.1,20,0.5"', 'value = "0.1,19,0.5"')
    told = refused(argos_project(tmp_path / "p", CONFIG + short), "population_size=1", "--scenario", "big")
    assert "'wall_east' ends 0.5 m before the edge of the 20x20 arena" in told


def test_an_arena_that_becomes_higher_keeps_its_walls(tmp_path: Path) -> None:
    folder = argos_project(tmp_path / "p", CONFIG.replace('arena = "10x10"', ""))
    assert projects.quick(folder, "run", "population_size=1", "--set", "//arena/@size=5,5,3", "-n").returncode == 0


def test_the_size_of_an_arena_without_walls_may_vary(tmp_path: Path) -> None:
    folder = argos_project(tmp_path / "p", CONFIG + SIZED, TEMPLATE.replace('id="wall_', 'id="block_'))
    assert [row["x"] for row in seen(folder, "side=10,20")] == [10, 20]


def test_changing_the_arena_is_refused_if_boundaries_of_an_engine_stay_behind(tmp_path: Path) -> None:
    bounded = '<dynamics2d id="dyn2d"><boundaries><top height="2"/></boundaries></dynamics2d>'
    template = instead('<dynamics2d id="dyn2d"/>', bounded).replace('id="wall_', 'id="block_')
    folder = argos_project(tmp_path / "p", CONFIG.replace('arena = "10x10"', ""), template)
    assert "would not follow" in refused(folder, "population_size=1", "--set", "//arena/@size=20,20,2")


def test_pinning_threads_of_parallel_runs_to_the_same_cores_is_refused(tmp_path: Path) -> None:
    template = instead('threads="4"', 'threads="4" pin_threads_to_cores="true"')
    folder = argos_project(tmp_path / "p", template=template)
    assert projects.quick(folder, "run", "population_size=1", "-n").returncode == 0
    told = refused(folder, "population_size=1", "--set", "//system/@threads=2")
    assert "runs at the same time would share" in told
    assert 'pin_threads_to_cores="false"' in told


def test_the_error_for_a_missing_controller_says_how_to_name_it(tmp_path: Path) -> None:
    told = refused(argos_project(tmp_path / "p", CONFIG.replace('controller = "foraging"\n', "")), "population_size=1")
    assert "__CONTROLLER__ in the template needs a controller" in told
    assert '--controller NAME, or controller = "NAME" in sierra.toml' in told


def test_a_typical_argos_example_is_changed_as_expected() -> None:
    """The example is typical: paths relative to the project's folder, blanks in sizes, no length, a camera."""
    template = """<argos-configuration>
  <framework>
    <system threads="0" />
    <experiment length="0"
                ticks_per_second="10"
                random_seed="124" />
  </framework>
  <arena size="5, 5, 1" center="0,0,0.5">
    <box id="wall_north" size="4,0.1,0.5" movable="false"><body position="0,2,0" orientation="0,0,0" /></box>
    <box id="wall_south" size="4,0.1,0.5" movable="false"><body position="0,-2,0" orientation="0,0,0" /></box>
    <box id="wall_east" size="0.1,4,0.5" movable="false"><body position="2,0,0" orientation="0,0,0" /></box>
    <box id="wall_west" size="0.1,4,0.5" movable="false"><body position="-2,0,0" orientation="0,0,0" /></box>
    <distribute>
      <position method="uniform" min="-2,-2,0" max="2,2,0" />
      <entity quantity="10" max_trials="100"><foot-bot id="fb"><controller config="fdc" /></foot-bot></entity>
    </distribute>
    <distribute>
      <position method="uniform" min="-2,-2,0" max="2,2,0" />
      <entity quantity="5" max_trials="100"><box id="b" size="0.3,0.3,0.5" movable="false" /></entity>
    </distribute>
  </arena>
  <visualization><qt-opengl><camera /></qt-opengl></visualization>
</argos-configuration>
"""
    driven = platform(length=20, arena="6x6")
    common = driven.changes(reader(template))
    answer = driven.criterion(grammar.parse("population_constant_density.20p0.I2.C2"), changed(template, common))
    assert answer is not None
    made = make((*common, *answer[1][1].changes, *driven.seed_changes()), template)
    assert (
        etree.tostring(made, encoding="unicode")
        == """<argos-configuration>
  <framework>
    <system threads="0"/>
    <experiment length="20" ticks_per_second="10" random_seed="7"/>
  </framework>
  <arena size="8,8,1" center="0,0,0.5">
    <box id="wall_north" size="8,0.1,0.5" movable="false"><body position="0,3.95,0" orientation="0,0,0"/></box>
    <box id="wall_south" size="8,0.1,0.5" movable="false"><body position="0,-3.95,0" orientation="0,0,0"/></box>
    <box id="wall_east" size="0.1,8,0.5" movable="false"><body position="3.95,0,0" orientation="0,0,0"/></box>
    <box id="wall_west" size="0.1,8,0.5" movable="false"><body position="-3.95,0,0" orientation="0,0,0"/></box>
    <distribute>
      <position method="uniform" min="-3.9,-3.9,0" max="3.9,3.9,0"/>
      <entity quantity="12" max_trials="100"><foot-bot id="fb"><controller config="fdc"/></foot-bot></entity>
    </distribute>
    <distribute>
      <position method="uniform" min="-3.9,-3.9,0" max="3.9,3.9,0"/>
      <entity quantity="5" max_trials="100"><box id="b" size="0.3,0.3,0.5" movable="false"/></entity>
    </distribute>
  </arena>
</argos-configuration>"""
    )


# Libraries


def test_libraries_are_searched_in_the_project_and_its_build_folder_by_default() -> None:
    assert platform().environment() == {"ARGOS_PLUGIN_PATH": "{project}:{project}/build"}
    assert platform(libraries=["lib", "a/b"]).environment() == {"ARGOS_PLUGIN_PATH": "{project}:{project}/lib:{project}/a/b"}


@pytest.mark.parametrize("folder", ["", ".", "..", "/lib", "a/../..", "a:b", "{seed}", "a,b"])
def test_library_folders_outside_the_project_are_refused(folder: str) -> None:
    with pytest.raises(ConfigError, match=r'libraries: .* is not a folder in the project; use one such as \["build"\]'):
        platform(libraries=[folder])


@pytest.mark.integration
def test_runs_execute_again_if_a_library_that_git_ignores_is_rebuilt(tmp_path: Path) -> None:
    """The runs are not observed: this program does not load the library."""
    folder = argos_project(tmp_path / "p")
    config = folder / "sierra.toml"
    config.write_text(f'observe = "none"\n{config.read_text()}')
    subprocess.run(["git", "init", "-q"], cwd=folder, check=True)
    (folder / ".gitignore").write_text("build/\n")
    library = folder / "build" / "controllers" / "libforaging.so"
    library.parent.mkdir(parents=True)

    def executed(content: str) -> int:
        library.write_text(content)
        ran = projects.quick(folder, "run", "population_size=1", "--no-figures", "--json")
        assert ran.returncode == 0, ran.stderr
        count: int = json.loads(ran.stdout)["executed"]
        return count

    assert [executed("one"), executed("one"), executed("two")] == [1, 0, 1]


@pytest.mark.integration
@pytest.mark.parametrize(
    ("name", "counts"), [("libforaging.so.1.2", True), ("CMakeFiles/output.log", False), ("x.so.o", False)]
)
def test_of_a_folder_of_libraries_only_libraries_count(tmp_path: Path, name: str, counts: bool) -> None:
    """The runs are not observed. A build leaves logs and object files beside the libraries."""
    folder = argos_project(tmp_path / "p")
    config = folder / "sierra.toml"
    config.write_text(f'observe = "none"\n{config.read_text()}')
    (folder / ".gitignore").write_text(".sierra\nbuild/\n")
    projects.commit(folder)
    file = folder / "build" / name
    file.parent.mkdir(parents=True)
    file.write_text("one")
    query = ("population_size=1", "--runs", "1")
    assert projects.run(folder, *query)[0]["executed"] == 1
    file.write_text("two")
    assert projects.run(folder, *query)[0]["executed"] == int(counts)


@pytest.mark.integration
def test_a_library_that_no_observed_run_loaded_does_not_count(tmp_path: Path, require: Callable[..., str]) -> None:
    """Only the first of two runs is observed; the second one counts because the first one does."""
    require("strace")
    folder = argos_project(tmp_path / "p")
    config = folder / "sierra.toml"
    config.write_text(f"observe_budget = 0\n{config.read_text()}")
    (folder / ".gitignore").write_text(".sierra\nbuild/\n")
    (folder / "sim.py").write_text(SEEN + "open(sys.argv[0].replace('sim.py', 'build/libloaded.so')).read()\n")
    projects.commit(folder)
    (folder / "build").mkdir()
    for name in ("libloaded.so", "libother.so"):
        (folder / "build" / name).write_text("one")
    query = ("population_size=1", "--runs", "2")
    assert projects.run(folder, *query)[0]["executed"] == 2
    (folder / "build" / "libother.so").write_text("two")
    assert projects.run(folder, *query)[0]["executed"] == 0
    (folder / "build" / "libloaded.so").write_text("two")
    assert projects.run(folder, *query)[0]["executed"] == 2


# Physics engines and devices

DEVICES = (
    instead(
        '<actuators><differential_steering implementation="default"/></actuators>',
        '<actuators><differential_steering implementation="default"/><leds implementation="default" medium="leds"/>'
        '<range_and_bearing implementation="default"/></actuators>'
        '<sensors><range_and_bearing implementation="medium" medium="rab"/><battery implementation="default"/></sensors>',
    )
    .replace('<media><led id="leds"/></media>', '<media><led id="leds"/><range_and_bearing id="rab"/></media>')
    .replace(
        '<controller config="__CONTROLLER__"/></foot-bot>',
        '<controller config="__CONTROLLER__"/><battery model="time_motion"/></foot-bot>',
    )
)


def followed(template: str = TEMPLATE, resize: str | None = None, **options: object) -> Made:
    """Return the accepted input of an experiment in which another change may have resized the arena."""
    driven, read = platform(**options), reader(template)
    own = driven.changes(read)
    before = changed(template, own)
    every = (*own, *((Set("//arena/@size", resize),) if resize else ()))
    after = changed(template, every)
    every = (*every, *driven.follow(after, before))
    driven.check(changed(template, every), read)
    return make(every, template)


def test_engines_share_the_arena() -> None:
    made = followed(physics_engines=2, arena="10x4x2", physics_iterations=20)
    engines = made.xpath("physics_engines/dynamics2d")
    assert [engine.get("id") for engine in engines] == ["dynamics2d_0", "dynamics2d_1"]
    assert [engine.get("iterations") for engine in engines] == ["20", "20"]
    assert [engine.xpath("boundaries/sides/vertex/@point") for engine in engines] == [
        ["-5,-2", "0,-2", "0,2", "-5,2"],
        ["0,-2", "5,-2", "5,2", "0,2"],
    ]
    assert (
        made.xpath("physics_engines/*/boundaries/top/@height | physics_engines/*/boundaries/bottom/@height") == ["2", "0"] * 2
    )


@pytest.mark.parametrize("origin", ["corner", "centre"])
def test_engines_follow_the_arena_and_its_origin(origin: str) -> None:
    made = followed(physics_engines=4, origin=origin, resize="20,8,2")
    points = [numbers(point) for point in made.xpath("//vertex/@point")]
    low, high = ((0, 0), (20, 8)) if origin == "corner" else ((-10, -4), (10, 4))
    assert (min(x for x, _ in points), min(y for _, y in points)) == low
    assert (max(x for x, _ in points), max(y for _, y in points)) == high
    assert len(made.xpath("physics_engines/*")) == 4


@given(count=st.integers(2, 24), x=st.fractions(1, 1000, max_denominator=1000), y=st.fractions(1, 1000, max_denominator=1000))
def test_areas_of_engines_cover_the_arena_without_overlap(count: int, x: Fraction, y: Fraction) -> None:
    zero = Fraction()
    areas = physics.corners(count, physics.Box((zero, zero, zero), (x, y, Fraction(1))))
    assert len(areas) == count
    total = Fraction()
    for area in areas:
        points = [tuple(Fraction(part) for part in corner.split(",")) for corner in area]
        twice = sum(a[0] * b[1] - b[0] * a[1] for a, b in zip(points, [*points[1:], points[0]], strict=True))
        assert twice > 0  # counter-clockwise
        total += twice / 2
    assert abs(total - x * y) <= (x + y + 1) / 10**6


def test_the_type_and_the_spatial_hash_of_engines_are_set() -> None:
    made = prepared(physics_type="dynamics3d", spatial_hash={"cell_size": 0.5, "cell_num": 200})
    assert len(made.xpath("physics_engines/dynamics3d[@id='dyn2d']/spatial_hash[@cell_size='0.5'][@cell_num='200']")) == 1
    both = followed(physics_engines=2, spatial_hash={"cell_size": 1.0, "cell_num": 200})
    assert both.xpath("physics_engines/dynamics2d/spatial_hash/@cell_size") == ["1", "1"]


@pytest.mark.parametrize(
    "engine",
    [
        '<dynamics2d id="a"/><dynamics2d id="b"/>',
        '<dynamics2d id="a" elevation="2"/>',
        '<dynamics2d id="a"><friction box_linear_friction="1"/></dynamics2d>',
        '<dynamics2d id="a"><boundaries><top height="1"/></boundaries></dynamics2d>',
        "",
    ],
)
def test_engines_with_other_properties_are_not_copied(engine: str) -> None:
    with pytest.raises(TemplateError, match="must have one engine"):
        followed(instead('<dynamics2d id="dyn2d"/>', engine), physics_engines=2)


@pytest.mark.nightly
def test_engines_follow_growing_arenas_and_not_those_of_single_runs(tmp_path: Path) -> None:
    config = CONFIG.replace('arena = "10x10"', 'arena = "10x10"\nphysics_engines = 2')
    rows = seen(argos_project(tmp_path / "p", config), "population_constant_density.1p0.I10.C2")
    assert [row["x"] for row in rows] == [10, 20]
    higher = 'run_changes = [{ set = "//arena/@size", value = "10.05,10,2" }]\n'
    told = refused(argos_project(tmp_path / "q", higher + config), "population_size=1")
    assert "the engines do not share the arena, because a later change resized it" in told


@pytest.mark.integration
def test_unused_devices_and_their_media_are_removed() -> None:
    without_light = DEVICES.replace(' intensity="3" medium="leds"', ' intensity="3"')
    assert without_light != DEVICES
    made = prepared(without_light, remove_devices=("range_and_bearing", "leds", "battery"))
    for gone in ("//range_and_bearing", "//actuators/leds", "//battery", "media/led"):
        assert made.xpath(gone) == []
    assert len(made.xpath("//actuators/differential_steering")) == 1


def test_a_medium_that_a_light_uses_too_stays() -> None:
    made = prepared(DEVICES, remove_devices=("leds",))
    assert len(made.xpath("media/led")) == 1
    assert made.xpath("//actuators/leds") == []


def test_an_unknown_device_is_refused() -> None:
    with pytest.raises(TemplateError, match="no sensor, actuator or part of a robot 'gripper'"):
        prepared(DEVICES, remove_devices=("gripper",))
