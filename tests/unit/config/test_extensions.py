"""The names that extensions add, and what depends on whether an extension exists."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from sierra.config import extensions
from sierra.config.project_file import parse
from sierra.errors import ConfigError
from tests.tiers import needs_extension, of_extension


@pytest.fixture
def none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Let no extension exist."""
    monkeypatch.setattr(extensions, "FOLDER", tmp_path)
    extensions.added.cache_clear()
    yield
    extensions.added.cache_clear()


def test_what_is_recorded_does_not_depend_on_which_extensions_exist(none: None) -> None:
    assert extensions.every("variables")["ARGOS_PLUGIN_PATH"] == "libraries"
    assert extensions.every("inputs")[".sdf"] == "xml"
    assert extensions.starts() == {}


def test_settings_of_absent_extensions_are_left_out_of_a_package(none: None) -> None:
    figures = {"a": {"kind": "ridge", "xlim": [0, 1]}, "b": {"inherit": "a"}, "c": {"kind": "box", "inherit": "a"}, "d": 3}
    table = {"videos": {}, "platform": "argos", "platforms": {"argos": {}, "ros": {}}, "figures": figures}
    kept, notes = extensions.without_absent(table)
    assert kept["platforms"] == {"argos": {}}
    assert kept["figures"] == {"c": figures["c"], "d": 3}
    assert kept["figure_defaults"] == {"a": figures["a"], "b": figures["b"]}
    assert [note.split()[1] for note in notes] == ["videos", "platforms.ros", "figures.a", "figures.b"]


@pytest.mark.parametrize(
    ("format", "keys", "said"),
    [
        ("hdf5", {"rows": "a", "min_rows": "3"}, 'min_rows should be a whole number, not "3"'),
        *of_extension("ros", ("bag", {"topics": ("/a",), "required": "no"}, 'required should be true or false, not "no"')),
        pytest.param(
            "npy",
            {"topics": ("/a",)},
            "topics needs format = \"bag\", but the format is 'npy'",
            marks=[needs_extension("ros"), needs_extension("formats")],
        ),
        *of_extension("ros", ("csv", {"topics": ("/a",)}, "topics needs format = \"bag\", but the format is 'csv'")),
        *of_extension(
            "ros", ("bag", {"topics": ("/a",), "min_rat": 2}, "unknown key 'outputs.o.min_rat'; did you mean 'min_rate'?")
        ),
    ],
)
def test_outputs_in_formats_of_extensions_are_checked_as_strictly_as_others(
    format: str, keys: dict[str, object], said: str
) -> None:
    with pytest.raises(ConfigError) as raised:
        parse({"command": "sim", "outputs": {"o": {"file": "a", "format": format, **keys}}}, "sierra.toml")
    assert said in str(raised.value)


def test_an_output_of_an_absent_format_keeps_its_keys(none: None) -> None:
    keys = {"file": "a.bag", "format": "bag", "topics": ("/a",), "min_rate": 2.0}
    project = parse({"command": "sim", "outputs": {"a": keys, "b": keys}}, "sierra.toml")
    assert project.outputs["a"].model_dump(exclude_unset=True) == keys


@pytest.mark.parametrize("where", ["", "targets.x."])
def test_a_key_of_an_absent_extension_names_what_to_install(none: None, where: str) -> None:
    table = {"command": "sim", **({"targets": {"x": {"capture": {}}}} if where else {"capture": {}})}
    with pytest.raises(ConfigError, match=rf"'{where}capture' belongs to the extension 'videos', which is not installed"):
        parse(table, "sierra.toml")
