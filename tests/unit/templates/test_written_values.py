"""Independent readers of each format read the values that were set, and all others as before."""

from __future__ import annotations

from pathlib import Path
from random import Random

import pytest
from hypothesis import strategies as st

import sierra
from tests import projects, written_values
from tests.properties import Property
from tests.soak import steps
from tests.soak.project import Differs

test_readers_of_xml_read_a_value_that_was_set = written_values.XML.tests(30)
test_readers_of_json_read_a_value_that_was_set = written_values.JSON.tests(20)
test_readers_of_yaml_read_a_value_that_was_set = written_values.YAML.tests(20)
test_readers_of_toml_read_a_value_that_was_set = written_values.TOML.tests(20)
test_readers_of_ini_read_a_value_that_was_set = written_values.INI.tests(30)
test_readers_of_properties_read_a_value_that_was_set = written_values.JAVA.tests(30)
test_a_value_stands_in_the_place_of_its_placeholders = written_values.TEXT.tests(20)


PROJECT = """template = "arena.xml"
command = "python3 {project}/sim.py {input}"
seed = "//@seed"
runs = 1

[variables]
population_size = "//count"

[outputs.out]
file = "out.csv"
"""
SIMULATOR = """import sys, xml.dom.minidom
count = xml.dom.minidom.parse(sys.argv[1]).getElementsByTagName("count")[0]
robots = int("".join(node.data for node in count.childNodes if node.nodeType in (node.TEXT_NODE, node.CDATA_SECTION_NODE)))
open("out.csv", "w").write(f"t,robots\\n0,{robots}\\n")
"""


@pytest.mark.integration
@pytest.mark.each_case
@pytest.mark.parametrize(
    "content", ["<!-- robots -->5", "5<!-- robots --><?p?>", "<![CDATA[5]]><!-- robots -->6", " <!-- robots -->\n 5 "]
)
def test_a_simulator_reads_the_value_in_the_tables(tmp_path: Path, content: str) -> None:
    template = f'<a seed="1">\n  <count>{content}</count>\n</a>\n'
    root = projects.make(tmp_path / "p", PROJECT, simulator=SIMULATOR, template=template)
    assert projects.quick(root, "run", "population_size=2,3", "--no-figures").returncode == 0
    found = sierra.open(root).sql("SELECT population_size, robots FROM out ORDER BY 1").arrow.to_pylist()
    assert found == [{"population_size": 2, "robots": 2}, {"population_size": 3, "robots": 3}]


@pytest.mark.parametrize("value", ["1e400", "1e-400", "-1e-400"])
def test_a_number_that_floats_cannot_represent_is_refused_in_one_line(tmp_path: Path, value: str) -> None:
    root = projects.make(tmp_path / "p")
    for words in (["population_size=1", "--set", f"//noise={value}"], [f"noise={value}"]):
        refused = projects.quick(root, "run", *words, "-n")
        assert (refused.returncode, len(refused.stderr.splitlines()), value in refused.stderr) == (2, 1, True)


def test_a_failed_soak_of_a_property_is_repeated_by_its_seed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def claim(number: int) -> None:
        assert number % 7 != 3, f"{number} was drawn"

    monkeypatch.setattr(steps, "PROPERTIES", (Property("a wrong claim", (st.integers(),), claim),))
    messages = []
    for seed in (5, 5):
        with pytest.raises(Differs) as failed:
            steps.random_properties(steps.Place(tmp_path, Random(seed)), {})
        messages.append(str(failed.value))
    assert messages[0] == messages[1]
    assert "a wrong claim: AssertionError(" in messages[0]
    assert "number=" in messages[0]
