"""The names that extensions add, and what depends on whether an extension exists."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from sierra.config import extensions
from sierra.config.project_file import LoadedProject, parse
from sierra.errors import ConfigError, Missing
from sierra.execution.plan import session_step
from sierra.packages.reproduction import reproduce
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


@pytest.mark.parametrize("table", [{"trials": {}}, {"targets": {"robots": {"trials": {}}, "sim": 3}}])
def test_a_package_whose_runs_an_absent_extension_executes_can_only_be_read(none: None, table: dict[str, object]) -> None:
    assert extensions.lacking({"videos": {}}) is None
    why = extensions.lacking(table)
    assert why == "'trials' belongs to the extension 'trials', which is not installed; install sierra-trials"
    found = replace(LoadedProject(Path("/p"), Path("/p/sierra.toml"), parse({"command": "sim"}, "sierra.toml")), lacking=why)
    with pytest.raises(Missing, match="install sierra-trials"):
        session_step(found)


def test_a_package_is_read_without_the_extension_that_executes_its_runs(none: None, tmp_path: Path) -> None:
    (tmp_path / "sierra.toml").write_text('command = "sim"\n[trials]\nsupervised = true\n')
    project, notes = reproduce.load_confined(tmp_path)
    assert project.lacking
    assert project.lacking.endswith("install sierra-trials")
    assert [note.split()[1] for note in notes] == ["trials"]


def test_an_extension_is_named_with_the_one_that_it_needs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(extensions, "is_there", lambda name: name != "hosts")
    monkeypatch.setattr(extensions, "_has_folder", lambda name: name != "hosts")
    said = "'robots' belongs to the extension 'robots', which needs 'hosts', which is not installed; install sierra-hosts"
    assert extensions.belongs("robots", "robots") == said


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
