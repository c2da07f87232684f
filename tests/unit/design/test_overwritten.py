"""Runs get the values that an axis or `--set` sets: a later change that overwrites one is refused by name, others pass."""

from __future__ import annotations

from pathlib import Path

import pytest

from sierra.templates.xml import XmlTemplate
from tests import projects

TEMPLATE = """\
<?xml version="1.0"?>
<arena length="5">
  <random seed="0"/>
  <swarm count="4" speed="0.5"/>
  <noise level="0.1"/>
</arena>
"""
CONFIG = """
template = "arena.xml"
command = "python3 sim.py {input}"
seed = "//random/@seed"
runs = 2
[variables]
size = "//swarm/@count"
few = { set = "//swarm/@count", changes = [{ set = "//swarm[@count='3']/@count", value = "3" }] }
capped = { changes = [{ set = "//swarm/@speed", value = "{min(capped, 3)}" }] }
level = "//noise/@level"
any_level = "//noise/@*[name()='level']"
seeded = "//random/@seed"
chosen = "//swarm[@count='4']/@speed"
itself = "//swarm[@speed='0.5']/@speed"
mixed = { changes = [{ set = "//swarm[@count='4']/@count", value = "{mixed}" }, { set = "//noise/@level", value = "{mixed}" }] }
[variables.more]
changes = [
    { set = "//swarm/@count", value = "{more}" },
    { add = "/arena", xml = '<swarm count="9" speed="1"/>' },
]
[scenarios.open]
[scenarios.plain]
[scenarios.quiet]
changes = [{ remove = "//noise" }]
[scenarios.two]
changes = [{ add = "/arena", xml = '<noise level="2"/>' }]
[scenarios.levels]
changes = [{ set = "/arena/noise/@level", value = "7" }]
[scenarios.thrice]
changes = [{ set = "//*[@level='3' or @length]/@*", value = "7" }]
[scenarios.third]
changes = [{ set = "//noise[@level='3']/@level | /arena/@length", value = "7" }]
"""
IN_EACH = 'run_changes = [{ set = "/arena/swarm/@count", value = "7" }]\n'
LISTED = 'run_changes = [{ set = "/arena/swarm/@count", value = "{k}" }]\n[per_run]\nk = [7, 8]\n'


def project(folder: Path, more: str = "") -> Path:
    """Make a project with the settings `more` before its variables."""
    return projects.make(folder, CONFIG.replace("[variables]", f"{more}[variables]", 1), template=TEMPLATE)


def refused(folder: Path, *words: str) -> str:
    """Return the one line that says why a query is refused."""
    ran = projects.quick(folder, "run", *words, "-n")
    assert ran.returncode == 2, ran.stderr + ran.stdout
    assert len(ran.stderr.splitlines()) == 1
    return ran.stderr.strip().removeprefix("sierra: ")


def planned(folder: Path, *words: str) -> bool:
    ran = projects.quick(folder, "run", *words, "-n")
    assert ran.returncode == 0, ran.stderr
    return True


@pytest.mark.parametrize(("more", "sizes"), [(IN_EACH, "1,2"), (IN_EACH, "7,8"), (LISTED, "1,2"), (LISTED, "7")])
def test_axis_that_run_changes_overwrite_is_refused(tmp_path: Path, more: str, sizes: str) -> None:
    told = refused(project(tmp_path / "p", more), f"size={sizes}")
    assert told.endswith("is overwritten: run_changes changes the same value later; only one of them can set it")


def test_axis_is_accepted_if_run_changes_set_the_same_value(tmp_path: Path) -> None:
    assert planned(project(tmp_path / "p", IN_EACH), "size=7")


def test_axis_that_the_seed_overwrites_is_refused(tmp_path: Path) -> None:
    assert "seeded=1 is overwritten: the seed changes the same value later" in refused(project(tmp_path / "p"), "seeded=1,2")


def test_set_that_the_seed_overwrites_is_refused(tmp_path: Path) -> None:
    told = refused(project(tmp_path / "p"), "size=1,2", "--set", "/arena/random/@seed=5")
    assert "--set /arena/random/@seed is overwritten: the seed changes the same value later" in told


def test_axis_that_a_later_scenario_removes_is_refused(tmp_path: Path) -> None:
    told = refused(project(tmp_path / "p"), "level=1,2", "scenario=open,quiet")
    assert "level=1 is overwritten: scenario=quiet changes the same value later" in told


def test_axis_of_two_changes_is_refused_if_one_of_them_is_overwritten(tmp_path: Path) -> None:
    told = refused(project(tmp_path / "p"), "mixed=1,2", "scenario=levels")
    assert "mixed=1 is overwritten: scenario=levels changes the same value later" in told


def test_set_that_overwrites_another_set_is_refused(tmp_path: Path) -> None:
    told = refused(project(tmp_path / "p"), "size=1", "--set", "//noise/@level=3", "--set", "/arena/noise/@level=4")
    assert told.endswith(
        "--set //noise/@level is overwritten: --set /arena/noise/@level changes the same value later; use one of them"
    )


def test_set_that_overwrites_an_axis_is_refused(tmp_path: Path) -> None:
    told = refused(project(tmp_path / "p"), "level=1,2", "--set", "/arena/noise/@level=3")
    assert told.endswith("changes the same value later; use one of them")


def test_axis_is_refused_if_a_later_xpath_selects_one_of_its_values(tmp_path: Path) -> None:
    told = refused(project(tmp_path / "p"), "level=1,2,3", "scenario=thrice")
    assert "level=3 is overwritten: scenario=thrice changes the same value later" in told


@pytest.mark.parametrize("level", ["level", "any_level"])
def test_axis_is_refused_if_a_later_xpath_union_selects_one_of_its_values(tmp_path: Path, level: str) -> None:
    told = refused(project(tmp_path / "p"), f"{level}=1,2,3", "scenario=third")
    assert f"{level}=3 is overwritten: scenario=third changes the same value later" in told


def test_overwriting_is_found_even_if_the_first_value_stays_equal(tmp_path: Path) -> None:
    assert "level=1 is overwritten" in refused(
        project(tmp_path / "p", 'changes = [{ set = "//swarm/@count", value = "1" }]\n'), "level=7,1", "scenario=levels"
    )


@pytest.mark.parametrize(
    "words",
    [
        ("more=1,2",),
        ("more=1,2", "level=1,2"),
        ("level=1,2", "more=1,2"),
        ("more=1,2", "--set", "//noise/@level=3"),
        ("capped=2,3,4", "level=1,2"),
        ("montecarlo.C2", "level=1,2"),
        ("scenario=open,plain", "level=1,2"),
        ("level=1,2", "scenario=open,plain"),
        ("scenario=two", "level=1,2"),
        ("chosen=1,2", "size=4,8"),
        ("itself=1,2", "level=1,2"),
        ("few=3", "level=1,2"),
        ("size=1,2", "--set", "//noise/@level=3"),
    ],
)
@pytest.mark.parametrize("more", ["", 'run_changes = [{ set = "/arena/@length", value = "{l}" }]\n[per_run]\nl = [3, 3]\n'])
def test_queries_without_overwritten_values_are_accepted(tmp_path: Path, words: tuple[str, ...], more: str) -> None:
    assert planned(project(tmp_path / "p", more), *words)


def test_axis_that_sets_and_adds_is_refused_if_overwritten(tmp_path: Path) -> None:
    told = refused(project(tmp_path / "p", IN_EACH), "more=1,2")
    assert "more=1 is overwritten: run_changes changes the same value later" in told


def test_overwriting_is_checked_once_for_all_values(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The check costs the same for many experiments of a large template as for a few."""
    folder, read = project(tmp_path / "p"), []
    init = XmlTemplate.__init__

    def counted(self: XmlTemplate, data: bytes, name: str, options: object = None) -> None:
        read.append(name)
        init(self, data, name, options)

    monkeypatch.setattr(XmlTemplate, "__init__", counted)
    numbers = []
    for count in (2, 20):
        read.clear()
        assert planned(folder, f"size=1:{count}:{count}", "level=1,2")
        numbers.append(len(read))
    assert numbers[0] == numbers[1]
