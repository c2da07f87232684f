"""Wheels in a package are locked by hash, for each requested Python, and are enough to install SIERRA without a network."""

from __future__ import annotations

import subprocess
import sys
import zipfile
from importlib import metadata
from pathlib import Path

import pytest

import sierra
from sierra.errors import UsageError
from sierra.packages.parts import own_wheel, wheels
from sierra.packages.parts.python_packages import extras, needed, target
from sierra.packages.parts.wheels import HERE, Wheel, lock
from tests import projects

PACKAGE = '\n[package]\ntitle = "T"\nauthors = [{ name = "Jane Doe" }]\nlicense = "MIT"\n'


def wheel(folder: Path, name: str, version: str, *requires: str) -> Path:
    """Write a wheel without files."""
    path, info = folder / f"{name}-{version}-py3-none-any.whl", f"{name}-{version}.dist-info"
    lines = [f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n", *(f"Requires-Dist: {one}\n" for one in requires)]
    with zipfile.ZipFile(path, "w") as file:
        file.writestr(f"{info}/METADATA", "".join(lines))
        file.writestr(f"{info}/WHEEL", "Wheel-Version: 1.0\nGenerator: test\nRoot-Is-Purelib: true\nTag: py3-none-any\n")
        file.writestr(f"{info}/RECORD", "")
    return path


@pytest.mark.integration
def test_recorded_versions_are_needed_as_markers_say() -> None:
    requires = ("numpy>=1", "nowhere>=2; python_version < '3.12'")
    older, newer = (needed(requires, target(python, "x86_64"), {"pyarrow": "23.0.9"}) for python in ("3.11", "3.12"))
    assert older["nowhere"] == "nowhere>=2"
    assert "nowhere" not in newer
    assert newer["pyarrow"] == "pyarrow==23.0.9"
    assert newer["numpy"] == f"numpy=={metadata.version('numpy')}"
    assert newer["sierra-experiments"] == f"sierra-experiments=={metadata.version('sierra-experiments')}"
    assert {"pydantic-core", "typer"} <= newer.keys()
    assert not {"pytest", "sphinx"} & newer.keys()


def test_only_the_extras_that_were_used_are_needed() -> None:
    assert extras(["matplotlib", "sierra-experiments"], ["csv", "file"]) == set()
    assert extras(["seaborn"], ["netcdf", "bag"]) == {"figures", "netcdf", "bags"}
    lean = needed((), target("3.11", "x86_64"), {})
    more = needed((), target("3.11", "x86_64"), {}, extras(["scikit-learn"], ["hdf5"]))
    assert not {"pandas", "scikit-learn", "h5py", "rosbags", "av"} & lean.keys()
    assert more.keys() - lean.keys() >= {"scikit-learn", "h5py"}


def test_a_lock_has_all_hashes_of_a_version_and_markers_where_targets_differ() -> None:
    one, two = target("3.11", "x86_64"), target("3.12", "aarch64")
    pure = Wheel("pure", "1.0", "0" * 64, Path("pure.whl"))
    compiled = [Wheel("compiled", "2.0", digit * 64, Path("compiled.whl")) for digit in "12"]
    lines = lock({one: [pure, compiled[0], Wheel("pip", "25", "4" * 64, Path())], two: [pure, compiled[1]]}).split("\n")
    assert lines[:3] == ["compiled==2.0 \\", f"    --hash=sha256:{'1' * 64} \\", f"    --hash=sha256:{'2' * 64}"]
    assert lines[3:] == ["pure==1.0 \\", f"    --hash=sha256:{'0' * 64}", ""]
    only = lock({one: [pure], two: []})
    assert only.startswith('pure==1.0 ; (python_version == "3.11" and platform_machine == "x86_64") \\\n')


@pytest.mark.parametrize(("python", "machine"), [("3", "x86_64"), ("3.12.1", "x86_64"), ("--3.12", "x86_64"), ("3.12", "a b")])
def test_wrong_targets_are_refused(python: str, machine: str) -> None:
    with pytest.raises(UsageError, match="is not a"):
        target(python, machine)


@pytest.mark.integration
def test_wheels_come_from_the_users_index_and_are_checked_together(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    index = tmp_path / "index"
    index.mkdir()
    wheel(index, "pip", metadata.version("pip"))
    wheel(index, "one", "1.0", "two>=2")
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    monkeypatch.setenv("PIP_FIND_LINKS", str(index))
    (tmp_path / "own").mkdir()
    own = wheel(tmp_path / "own", "sierra_experiments", metadata.version("sierra-experiments"))
    monkeypatch.setattr(own_wheel, "wheel", lambda own_distribution, folder: own)
    root = projects.make(tmp_path / "project", projects.CONFIG + PACKAGE)
    batch = sierra.open(root).run("population_size=1", runs=1, figures=False).batch

    monkeypatch.setattr(wheels, "needed", lambda requires, target, recorded, extras: {"one": "one==1.0", "two": "two>=2"})
    ended = projects.quick(root, "package", batch, "--no-report", "-o", "../x.zip", "--wheels")
    assert (ended.returncode, ended.stderr.count("\n"), "no wheels for Python 3" in ended.stderr) == (3, 1, True)
    assert "No matching distribution found for two" in ended.stderr
    monkeypatch.setattr(wheels, "needed", lambda requires, target, recorded, extras: {"one": "one==1.0"})
    ended = projects.quick(root, "package", batch, "--no-report", "-o", "../x.zip", "--wheels")
    assert (ended.returncode, "two" in ended.stderr) == (3, True)
    assert not (tmp_path / "x.zip").exists()
    wheel(index, "two", "2.1")
    monkeypatch.setattr(wheels, "needed", lambda requires, target, recorded, extras: {"one": "one==1.0", "two": "two==2.1"})
    chosen = ("--wheels", "--python", f"3.13,{HERE.python},3.13", "--arch", HERE.machine)
    for name in ("x", "y"):
        ended = projects.quick(root, "package", batch, "--no-report", "-o", f"../{name}.zip", *chosen)
        assert ended.returncode == 0, ended.stderr
    assert (tmp_path / "x.zip").read_bytes() == (tmp_path / "y.zip").read_bytes()
    with zipfile.ZipFile(tmp_path / "x.zip") as file:
        names = [name for name in file.namelist() if name.startswith("environment/wheels/")]
        assert [name.split("/")[-1].split("-")[0] for name in names] == ["one", "pip", "two"]
        assert [name.split("/")[1] for name in file.namelist() if "sierra_experiments" in name] == ["sierra"]
        assert not [name for name in file.namelist() if str(index).encode() in file.read(name)]
    assert projects.quick(root, "package", batch, "--no-report", "-o", "../z.zip", "--python", "3.12").returncode == 2


@pytest.mark.nightly
def test_sierra_is_installed_from_a_package_without_an_index(tmp_path: Path) -> None:
    root = projects.make(tmp_path / "project", projects.CONFIG + PACKAGE)
    batch = sierra.open(root).run("population_size=1", runs=1, figures=False).batch
    done = projects.sierra(root, "package", batch, "--no-report", "-o", "../x.zip", "--wheels", "--yes")
    assert done.returncode == 0, done.stderr
    with zipfile.ZipFile(tmp_path / "x.zip") as file:
        file.extractall(tmp_path / "x")
    environment = tmp_path / "x" / "environment"
    [pip] = (environment / "wheels").glob("pip-*.whl")
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", tmp_path / "v"], check=True)
    words = [
        "--isolated",
        "install",
        "--no-index",
        "--find-links",
        "wheels",
        "--find-links",
        "sierra",
        "--require-hashes",
        "-r",
        "requirements.lock",
    ]
    installed = [tmp_path / "v/bin/python", f"{pip}/pip", *words]
    subprocess.run(installed, cwd=environment, check=True, capture_output=True)
    replayed = [tmp_path / "v/bin/sierra", "replay", batch]
    told = subprocess.run(replayed, cwd=tmp_path / "x/project", check=True, capture_output=True, text=True).stdout
    assert "identical" in told
