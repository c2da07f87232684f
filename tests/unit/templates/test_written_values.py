"""Independent readers of each format read the values that were set, and all others as before."""

from __future__ import annotations

import pytest
from hypothesis import strategies as st

from tests import written_values
from tests.properties import Property

test_readers_of_xml_read_a_value_that_was_set = written_values.XML.tests(40)
test_readers_of_json_read_a_value_that_was_set = written_values.JSON.tests(25)
test_readers_of_yaml_read_a_value_that_was_set = written_values.YAML.tests(25)
test_readers_of_toml_read_a_value_that_was_set = written_values.TOML.tests(25)
test_readers_of_ini_read_a_value_that_was_set = written_values.INI.tests(40)
test_readers_of_properties_read_a_value_that_was_set = written_values.JAVA.tests(40)
test_a_value_stands_in_the_place_of_its_placeholders = written_values.TEXT.tests(20)


def test_a_failed_property_fails_again_with_its_seed() -> None:
    def claim(number: int) -> None:
        seen.append(number)
        assert number % 7 != 3, f"{number} was drawn"

    messages, draws = [], []
    for chosen in (5, 5, 6):
        seen: list[int] = []
        with pytest.raises(AssertionError) as failed:
            Property("a claim that is wrong", (st.integers(),), claim).check(chosen, 100)
        messages.append(str(failed.value))
        draws.append(seen)
    assert messages[0] == messages[1]
    assert draws[0] == draws[1] != draws[2]
