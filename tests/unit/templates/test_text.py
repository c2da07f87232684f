"""Text templates."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sierra import templates
from sierra.errors import ConfigError, TemplateError
from sierra.model import Add, Change, Set
from sierra.testing import templates as conformance
from tests import projects
from tests.trees import make, rendered

TEXT = "WorldInfo {\n  seed {{seed}}\n  DEF r1 Robot { speed {{ speed }} count {{n}} again {{n}} }\n}\n"


def test_the_format_passes_the_conformance_suite() -> None:
    conformance.check(lambda data, name: make("text", data, name), b"a = {{a}}\nb = {{b}}, {{a}}\n", ["/a", "//b"])


def test_placeholders_get_values_and_all_else_stays() -> None:
    template = make("text", TEXT)
    made = rendered(template, Set("/seed", "1"), Set("//speed", "{v / 2}"), Set("n", "8"), v=3)
    assert made == "WorldInfo {\n  seed 1\n  DEF r1 Robot { speed 1.5 count 8 again 8 }\n}\n"
    assert rendered(template) == TEXT.replace("{{ speed }}", "{{speed}}")
    assert template.attributes() == (("/seed", "{{seed}}"), ("/speed", "{{speed}}"), ("/n", "{{n}}"))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (Set("/sped", "1", why="w"), "w: /sped in template matches nothing; nearest is /speed"),
        (Set("/zzz", "1"), "/zzz in template matches nothing; there are seed, speed, n"),
        (Set("//a/b", "1"), "//a/b in template is not a path such as /name"),
        (Set("/n", "1", expect=2), "/n in template matches 1, not 2 as expected"),
        (Add("/n", "1"), "/n in template is a placeholder; a text can only be set"),
    ],
)
def test_a_change_that_does_not_fit_is_refused(change: Change, message: str) -> None:
    with pytest.raises(TemplateError) as refused:
        make("text", TEXT).changed((change,), {})
    assert str(refused.value) == message


def test_a_placeholder_without_a_value_is_refused() -> None:
    with pytest.raises(TemplateError, match=r"template: \{\{speed\}\}, \{\{n\}\} have no values"):
        make("text", TEXT).changed((), {}).per_run([Set("/seed", "{seed}")])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a\n b {{ro bot}}", "t:2:4: {{ro bot}} is not a placeholder; use a name of letters, digits and _, or another"),
        ("int a[] = {{1, 2}};", "t:1:11: {{1, 2}} is not a placeholder"),
        ("nothing", "t:1:1: a text without placeholders; write {{name}} where values belong"),
        ("a\0", "t:1: contains a NUL byte"),
    ],
)
def test_a_doubtful_text_is_refused_with_its_place(text: str, message: str) -> None:
    with pytest.raises(TemplateError) as refused:
        make("text", text, "t")
    assert message in str(refused.value)


def test_placeholders_can_have_other_signs(tmp_path: Path) -> None:
    (tmp_path / "t.txt").write_text("int a[] = {{1, <<n>>}};")
    template = templates.read(tmp_path / "t.txt", {"text": {"placeholder": "<<name>>"}})
    assert rendered(template, Set("/n", "2")) == "int a[] = {{1, 2}};"
    with pytest.raises(ConfigError, match="should be the word name between two different signs"):
        templates.read(tmp_path / "t.txt", {"text": {"placeholder": "name"}})


@given(st.lists(st.text(st.characters(exclude_characters="{}\0", codec="utf-8")), min_size=2, max_size=5), st.text(max_size=8))
def test_a_value_stands_in_the_text_as_it_is(pieces: list[str], value: str) -> None:
    template = make("text", "{{a}}".join(pieces).encode("utf-8", "surrogatepass"))
    wanted = value.encode("utf-8", "replace").decode()
    made = template.changed((Set("/a", wanted.replace("{", "{{").replace("}", "}}")),), {})
    assert made.render() == wanted.join(pieces).encode()
    assert template.reread(made.render(), "again").find("/a") == (wanted,)


CONFIG = """\
template = "world.wbt"
template_format = "text"
command = "python3 sim.py {input}"
seed = "/seed"
runs = 2
changes = [{ set = "/speed", value = 1 }]
[variables]
population_size = "/count"
speed = "/speed"
"""
SIMULATOR = """\
import sys
words = open(sys.argv[1]).read().split()
with open("swarm.csv", "w") as file:
    print("tick,coverage", file=file)
    print(0, int(words[1]) * float(words[3]) + int(words[5]), sep=",", file=file)
"""


@pytest.mark.integration
def test_a_project_with_a_text_template_runs(tmp_path: Path) -> None:
    folder = projects.make(tmp_path / "p", CONFIG, simulator=SIMULATOR)
    (folder / "world.wbt").write_text("count {{count}} speed {{speed}} seed {{seed}}\n")
    assert projects.run(folder, "population_size.Log4")[0]["executed"] == 6
    assert projects.run(folder, "population_size.Log4", "speed=1,2")[0]["executed"] == 6
    missing = projects.quick(folder, "run", "speed=1,2", "--dry-run")
    assert missing.returncode == 2
    assert "world.wbt: {{count}} has no value; set it" in missing.stderr
