"""SIERRA's own wheel in packages: made from the installed files, the same bytes every time, and pip installs it."""

from __future__ import annotations

import base64
import csv
import hashlib
import shutil
import subprocess
import sys
import zipfile
from importlib import metadata
from pathlib import Path

import pytest

import sierra
from sierra import __version__
from sierra.errors import ConfigError, Missing
from sierra.packages import archive, pack
from sierra.packages.members import MANIFEST
from sierra.packages.parts import own_wheel, wheels
from sierra.packages.subject import Member
from tests import projects

PACKAGE = '\n[package]\ntitle = "T"\nauthors = [{ name = "Jane Doe" }]\nlicense = "MIT"\n'
OWN = metadata.distribution("sierra-experiments")


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return own_wheel.wheel(OWN, tmp_path_factory.mktemp("wheel") / "made")


@pytest.fixture(scope="module")
def packed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a package of one run, and its project beside it."""
    folder = tmp_path_factory.mktemp("packed")
    root = projects.make(folder / "project", projects.CONFIG + PACKAGE)
    batch = sierra.open(root).run("population_size=1", runs=1, figures=False).batch
    assert sierra.open(root).packages.pack(batch, report=False, path=folder / "x.zip")
    return folder / "x.zip"


def test_the_wheel_lists_all_of_its_files_and_is_the_same_again(wheel: Path, tmp_path: Path) -> None:
    with zipfile.ZipFile(wheel) as file:
        names = file.namelist()
        [record] = [name for name in names if name.endswith("/RECORD")]
        rows = {name: (digest, size) for name, digest, size in csv.reader(file.read(record).decode().splitlines())}
        for name in names:
            content = file.read(name)
            digest = base64.urlsafe_b64encode(hashlib.sha256(content).digest()).decode().rstrip("=")
            assert rows[name] == (("", "") if name == record else (f"sha256={digest}", str(len(content))))
    assert set(rows) == set(names)
    assert {"sierra/util/version.py", "sierra/py.typed", "sierra/worker/__main__.py"} <= set(names)
    assert not [name for name in names if "__pycache__" in name or name.endswith(("direct_url.json", ".pth", "RECORD.jws"))]
    assert own_wheel.wheel(OWN, tmp_path / "again").read_bytes() == wheel.read_bytes()


def test_nothing_of_the_wheel_depends_on_zlib_or_on_the_time(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as file:
        assert {(one.compress_type, one.date_time) for one in file.infolist()} == {(zipfile.ZIP_STORED, archive.MADE)}
    assert not own_wheel.LEFT_OUT.fullmatch("py.typed")


@pytest.mark.integration
def test_pip_installs_the_wheel_which_has_the_command_and_can_make_itself_again(wheel: Path, tmp_path: Path) -> None:
    place = tmp_path / "site"
    words = ("-m", "pip", "--isolated", "install", "--quiet", "--no-index", "--no-deps", "--target", place, wheel)
    subprocess.run([sys.executable, *words], check=True, capture_output=True)
    assert (place / "bin" / "sierra").is_file()
    shutil.rmtree(place / "bin")
    again = (
        "from importlib import metadata; from pathlib import Path; from sierra.packages.parts import own_wheel; import sierra\n"
        "own = metadata.distribution('sierra-experiments')\n"
        f"assert sierra.__file__.startswith({str(place)!r}) and not own_wheel.is_editable(own)\n"
        f"own_wheel.wheel(own, Path({str(tmp_path / 'made')!r}))"
    )
    begin = f"import sys; sys.path.insert(0, {str(place)!r})\n"
    subprocess.run([sys.executable, "-P", "-c", begin + again], cwd=tmp_path, check=True)
    assert next((tmp_path / "made").glob("*.whl")).read_bytes() == wheel.read_bytes()


def test_requirements_are_those_of_the_lock_and_of_nothing_for_development() -> None:
    names = {one.name for one in own_wheel.needed(OWN)}
    assert {"duckdb", "pydantic-core", "seaborn", "h5py", "pillow"} <= names
    assert not {"pytest", "sphinx", "mujoco", "fabric", "av", "ruff"} & names
    [pyarrow] = [one.requirement for one in own_wheel.needed(OWN) if one.name == "pyarrow"]
    assert pyarrow.startswith("pyarrow==")
    assert "--hash=sha256:" in pyarrow
    assert "#" not in pyarrow


@pytest.mark.integration
@pytest.mark.parametrize("name", ["README.md", "REPRODUCING.md"])
def test_a_package_begins_with_what_needs_only_python_and_installs_sierra(packed: Path, name: str) -> None:
    with zipfile.ZipFile(packed) as file:
        text = file.read(name).decode()
        listed = file.read("environment/sierra/requirements.txt").decode()
        [own] = [one for one in file.namelist() if one.endswith(".whl")]
        digest = hashlib.sha256(file.read(own)).hexdigest()
    assert text.startswith("# T\n\n```sh\npython3 reproduce.py\npython3 reproduce.py --execute --yes\n```\n")
    assert f"\nSIERRA {__version__} wrote this package." in text
    assert "bin/pip install --require-hashes -r environment/sierra/requirements.txt\n" in text
    needs = (
        "- network: only to install SIERRA, for which pip fetches packages; none to check the package and to execute its runs\n"
    )
    assert (needs in text) == (name == "REPRODUCING.md")
    assert "--no-index" not in text
    assert listed.startswith(f"./{own} \\\n    --hash=sha256:{digest}\n")


@pytest.mark.integration
def test_packed_wheels_are_installed_without_an_index(tmp_path: Path, packed: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    other = tmp_path / "one-1.0-py3-none-any.whl"
    other.touch()
    monkeypatch.setattr(wheels, "_download", lambda folder, one, wanted, own: list(wheels._wheels([other, own])))
    monkeypatch.setattr(wheels, "_resolve", lambda folder, ones: None)
    project = sierra.open(packed.with_name("project"))
    assert project.packages.pack(project.batches[0].batch, report=False, path=tmp_path / "y.zip", wheels=True)
    with zipfile.ZipFile(tmp_path / "y.zip") as file:
        text, names = file.read("README.md").decode(), set(file.namelist())
        needs = file.read("REPRODUCING.md").decode()
        [own] = [name for name in names if "sierra_experiments" in name]
        lock = file.read("environment/requirements.lock").decode()
        assert hashlib.sha256(file.read(own)).hexdigest() in lock
    assert own.startswith("environment/sierra/")
    places = "--find-links environment/wheels --find-links environment/sierra"
    assert f"pip install --no-index {places} --require-hashes -r environment/requirements.lock\n" in text
    assert (
        "- network: none; only to install SIERRA for another Python or processor than those of `environment/wheels/`" in needs
    )


@pytest.mark.integration
def test_wheels_in_a_package_are_neither_installed_nor_imported_by_sierra(tmp_path: Path, packed: Path) -> None:
    evil = tmp_path / "sierra_experiments-9.9-py3-none-any.whl"
    with zipfile.ZipFile(evil, "w") as file:
        for name in ("sierra/util/version.py", "evil.pth", "sitecustomize.py"):
            file.writestr(name, f"import pathlib; pathlib.Path({str(tmp_path / 'HACKED')!r}).touch()\n")
    with zipfile.ZipFile(packed) as file:
        contents = {name: Member(name, file.read(name), "") for name in file.namelist() if name != MANIFEST}
    for folder in ("environment/sierra/", "environment/wheels/"):
        contents[folder + evil.name] = Member(folder + evil.name, evil, "")
    archive.write(tmp_path / "evil.zip", contents)
    project = projects.make(tmp_path / "project")
    for words in (("open", "../evil.zip"), ("import", "../evil.zip"), ("reproduce", "../evil.zip", "--yes")):
        ended = projects.quick(project, *words)
        assert ended.returncode == 0, ended.stderr
    assert not (tmp_path / "HACKED").exists()


def no_work(*arguments: object) -> None:
    raise AssertionError("work was done before the needs were checked")


def test_a_package_without_what_it_needs_is_refused_before_any_work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pack, "_batches", no_work)
    project = sierra.open(projects.make(tmp_path / "project"))
    with pytest.raises(ConfigError, match="title, authors, license"):
        project.packages.pack("0" * 64, path=tmp_path / "x.zip", claims=True)
    project = sierra.open(projects.make(tmp_path / "other", projects.CONFIG + PACKAGE))
    monkeypatch.setattr(wheels, "pip_version", lambda: (_ for _ in ()).throw(Missing("wheels need pip")))
    with pytest.raises(Missing, match="wheels need pip"):
        project.packages.pack("0" * 64, path=tmp_path / "x.zip", wheels=True)
    inline = (
        PACKAGE.replace("[package]\n", "package.")
        .replace("\nauthors", "\npackage.authors")
        .replace("\nlicense", "\npackage.license")
    )
    project = sierra.open(projects.make(tmp_path / "inline", inline + projects.CONFIG))
    with pytest.raises(ConfigError, match="must be a table of its own"):
        project.packages.pack("0" * 64, path=tmp_path / "x.zip", anonymous=True)
