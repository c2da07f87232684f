"""`reproduce.py` checks a package as SIERRA does, with the standard library alone, and believes nothing of a hostile one."""

from __future__ import annotations

import hashlib
import io
import json
import os
import signal
import stat
import subprocess
import sys
import time
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path, PurePosixPath, PureWindowsPath
from types import SimpleNamespace

import pytest
from hypothesis import strategies as st

from sierra.errors import SierraError
from sierra.packages import members
from sierra.packages.archive import Archive
from sierra.packages.members import MANIFEST
from sierra.worker import reproduce
from tests.properties import given_in_tiers
from tests.pythons import python_of
from tests.unit.packages.test_archive import MEMBERS, forged, package

PROGRAM = Path(reproduce.__file__)
ABOUT = {
    "title": "Swarm\x1b[2J",
    "date": "2026-11-23",
    "batches": [{"batch": "774d" * 16, "query": "swarm.size=Log8\x07"}, "x", {"batch": "; rm -rf ~"}],
}
WHEEL = "environment/wheels/sierra_experiments-2.0-py3-none-any.whl"


def ran(
    *arguments: object,
    cwd: Path,
    python: str = sys.executable,
    program: Path = PROGRAM,
    environment: Mapping[str, str] | None = None,
) -> tuple[int, str]:
    """Run the program without SIERRA's folder on the PATH; return its exit status and what it printed."""
    done = subprocess.run(
        [python, str(program), *map(str, arguments)],
        cwd=cwd,
        env={"PATH": "/nonexistent", "LC_ALL": "C", **(environment or {})},
        capture_output=True,
        text=True,
        check=False,
        timeout=60,
    )
    assert "Traceback" not in done.stderr
    return done.returncode, done.stdout + done.stderr


def said(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str]:
    """Run the program in this process; return its exit status and what it printed."""
    status = reproduce.main(list(map(str, arguments)))
    return status, "".join(capsys.readouterr())


def extracted(folder: Path, **changed: bytes) -> Path:
    """Write an extracted package with this program at its root."""
    path = package(folder.with_suffix(".zip"), **{"reproduce.py": PROGRAM.read_bytes(), **changed})
    with zipfile.ZipFile(path) as file:
        file.extractall(folder)
    return folder


def files(folder: Path) -> dict[str, bytes]:
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("oldest", [False, True])
def test_a_zip_is_verified_and_unpacked_and_so_is_the_folder(require: Callable[..., str], tmp_path: Path, oldest: bool) -> None:
    python = python_of("3.8") if oldest else sys.executable
    require("Python 3.8", there=python is not None)
    path = package(tmp_path / "x.zip", **{"reproduce.py": PROGRAM.read_bytes()})
    status, printed = ran("--unpack", "out", cwd=tmp_path, python=str(python))
    with Archive(path) as archive:
        assert archive.id in printed
    assert (status, "VERIFIED: " in printed, "Level 1 of 3 reached" in printed) == (0, True, True)
    with zipfile.ZipFile(path) as file:
        assert files(tmp_path / "out") == {name: file.read(name) for name in file.namelist()}
    assert os.access(tmp_path / "out/source/run.sh", os.X_OK)
    assert not os.access(tmp_path / "out/sierra.toml", os.X_OK)
    assert sorted(one.name for one in tmp_path.iterdir()) == ["out", "x.zip"]
    assert ran(cwd=tmp_path / "out", python=str(python), program=Path("reproduce.py"))[0] == 0
    (tmp_path / "out/results/a.parquet").write_bytes(b"PAR1")
    status, printed = ran(cwd=tmp_path, python=str(python), program=tmp_path / "out/reproduce.py")
    assert (status, "fault: 'results/a.parquet' is not what" in printed) == (1, True)


def test_each_fault_of_a_folder_has_a_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = extracted(tmp_path / "x")
    assert said(capsys, folder)[0] == 0
    (folder / "reproduction/venv").mkdir(parents=True)
    (folder / "reproduction/venv/python").symlink_to("/usr/bin/python3")
    (folder / "reproduction/report.html").write_text("made by an evaluator")
    assert said(capsys, folder)[0] == 0
    (folder / "sierra.toml").write_text("runs = 2\n")
    (folder / "results/a.parquet").unlink()
    (folder / "results/b.parquet").write_text("extra")
    (folder / "source/run.sh").unlink()
    (folder / "source/run.sh").symlink_to("/etc/passwd")
    status, printed = said(capsys, folder)
    assert [line for line in printed.splitlines() if line.startswith("fault: ")] == [
        "fault: 'source/run.sh' is a link or a device: only files and folders are accepted",
        f"fault: 'results/a.parquet' is missing, but {MANIFEST} lists it",
        f"fault: 'source/run.sh' is missing, but {MANIFEST} lists it",
        f"fault: 'results/b.parquet' is not listed in {MANIFEST}",
        f"fault: 'sierra.toml' is not what {MANIFEST} says: its SHA-256 is "
        + hashlib.sha256(b"runs = 2\n").hexdigest()[:10]
        + "...",
    ]
    assert (status, "NOT VERIFIED" in printed, "Level 1" in printed) == (1, True, False)


def test_a_link_in_place_of_the_manifest_or_a_folder_is_not_followed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = extracted(tmp_path / "x")
    (folder / "source").rename(tmp_path / "elsewhere")
    (folder / "source").symlink_to(tmp_path / "elsewhere")
    status, printed = said(capsys, folder)
    assert (status, "'source' is a link" in printed, "'source/run.sh' is missing" in printed) == (1, True, True)
    (folder / MANIFEST).rename(tmp_path / "manifest")
    (folder / MANIFEST).symlink_to(tmp_path / "manifest")
    status, printed = said(capsys, folder)
    assert (status, f"it has no {MANIFEST}" in printed) == (1, True)


def info(name: str, mode: int) -> zipfile.ZipInfo:
    made = zipfile.ZipInfo(name)
    made.external_attr = mode << 16
    return made


def grown(path: Path) -> Path:
    """Write a package with a member that is longer than it says."""
    forged(path, [("a", b"0" * 5_000_000)])
    path.write_bytes(path.read_bytes().replace((5_000_000).to_bytes(4, "little"), (10).to_bytes(4, "little")))
    return path


def other_method(path: Path) -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_LZMA) as file:
        file.writestr("a", b"1" * 100)
    return path


def with_password(path: Path) -> Path:
    data = bytearray(package(path).read_bytes())
    data[data.index(b"PK\x01\x02") + 8] |= 1
    path.write_bytes(data)
    return path


def flipped(path: Path) -> Path:
    whole = package(path).read_bytes()
    path.write_bytes(whole.replace(b"PAR1PAR1", b"PAR1QAR1", 1))
    return path


def cut(path: Path) -> Path:
    whole = package(path).read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    return path


HOSTILE: dict[str, Callable[[Path], Path]] = {
    **{
        name: lambda path, name=name: forged(path, [("good", b"1"), (name, b"2")])  # type: ignore[misc]
        for name in ("../evil", "/tmp/evil", "a\\..\\evil", "C:evil", "a\x1b[2J", "aux.txt", "GOOD", "good/b", "a.", "x" * 1100)
    },
    "twice": lambda path: forged(path, [("good", b"1"), ("good", b"2")]),
    "link": lambda path: forged(path, [("good", b"1"), (info("link", stat.S_IFLNK | 0o777), b"/etc")]),
    "device": lambda path: forged(path, [(info("a", stat.S_IFCHR | 0o666), b"")]),
    "folder": lambda path: forged(path, [(info("a/", stat.S_IFDIR | 0o777), b"")]),
    "more than listed": lambda path: forged(path, [("a", b"1"), ("b", b"2")], listed={"a": b"1"}),
    "fewer than listed": lambda path: forged(path, [("a", b"1")], listed={"a": b"1", "b": b"2"}),
    "other content": lambda path: forged(path, [("a", b"1"), ("good", b"1")], listed={"a": b"2", "good": b"1"}),
    "longer": grown,
    "method": other_method,
    "password": with_password,
    "flipped byte": flipped,
    "cut": cut,
}


@pytest.mark.filterwarnings("ignore:Duplicate name")
@pytest.mark.parametrize("case", HOSTILE)
def test_hostile_packages_are_refused_by_both_readers_and_nothing_is_left(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], case: str
) -> None:
    path = HOSTILE[case](tmp_path / "x.zip")
    with pytest.raises(SierraError), Archive(path) as archive:
        archive.verify()
    for arguments in ((), ("--unpack", tmp_path / "out")):
        status, printed = said(capsys, path, *arguments)
        assert (status, printed.count("fault: "), printed.count("NOT VERIFIED")) == (1, 1, 1)
        assert all(line.isprintable() for line in printed.splitlines())
    assert [one.name for one in tmp_path.iterdir()] == ["x.zip"]


PARTS = st.one_of(
    st.sampled_from(
        ["a", "A", "b", "é", "e\u0301", "straße", "STRASSE", "..", ".", "", "nul", ".git", "Com1.txt", "a.", " a", "a b"]
    ),
    st.sampled_from(["a\\b", "C:", "a\nb", "a\u202eb", "x" * 600, "\ud800", "a\u0130", "ﬁ", "fi", "\x85", "a?"]),
    st.text(max_size=4),
)
NAMES = st.lists(st.lists(PARTS, min_size=1, max_size=3).map("/".join), max_size=4)


@pytest.mark.integration
@given_in_tiers(NAMES, quick=50)
def test_accepted_names_mean_one_place_each_on_all_systems(names: list[str]) -> None:
    try:
        reproduce.check_names(names)
    except reproduce.Stop:
        return
    for name in names:
        path = PurePosixPath(name)
        assert (path.as_posix(), path.is_absolute(), ".." in path.parts, name.encode().decode()) == (name, False, False, name)
        assert PureWindowsPath(name).parts == path.parts
    folders = {parent.as_posix().casefold() for name in names for parent in PurePosixPath(name).parents}
    assert len({name.casefold() for name in names} - folders) == len(names)


@given_in_tiers(NAMES, st.sampled_from(["  ", " ", " *", "\r\n"]), quick=50)
def test_an_accepted_manifest_is_what_sierra_writes(names: list[str], between: str) -> None:
    content = "".join(f"{'0' * 64}{between}{name}\n" for name in sorted(names)).encode("utf-8", "surrogatepass")
    try:
        found = reproduce.read_manifest(content)
    except reproduce.Stop:
        return
    assert (found, members.written(found)) == (dict.fromkeys(names, "0" * 64), content)
    assert reproduce.package_id(found) == members.package_id(found)


def test_a_description_is_printed_clean(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    about = {"package.json": json.dumps(ABOUT).encode(), "project/sierra.toml": b""}
    status, printed = said(capsys, extracted(tmp_path / "it's", **about))
    assert (status, "Swarm?[2J" in printed, "2026-11-23" in printed) == (0, True, True)
    assert "  batch:   774d774d77 swarm.size=Log8?\n" in printed
    assert f"Next: python3 '{tmp_path}/it'\"'\"'s/reproduce.py' --execute" in printed
    for content in (b"\xff", b"[1]", b"[" * 100_000, b'{"batches": 1}'):
        again = package(tmp_path / f"{hashlib.sha256(content).hexdigest()}.zip", **{"package.json": content})
        status, printed = said(capsys, again)
        assert (status, "package.json cannot be read" in printed) == (0, True)


def test_wheels_for_this_python_are_named_and_others_are_not(tmp_path: Path) -> None:
    fitting = extracted(tmp_path / "x", **{WHEEL: b"PK", "environment/requirements.lock": b"", "project/sierra.toml": b""})
    status, printed = ran(fitting, cwd=tmp_path, python="/usr/bin/python3")
    assert status == 0
    assert "neither podman nor apptainer found" in printed
    assert "the package has 1 wheels in environment/wheels/, and they fit Python" in printed
    other = extracted(tmp_path / "y", **{WHEEL: b"PK", "environment/wheels/numpy-2.0-cp27-cp27m-win32.whl": b"PK"})
    status, printed = ran(other, cwd=tmp_path, python="/usr/bin/python3")
    assert (status, "no wheel for Python" in printed, "of numpy" in printed) == (0, True, True)


def test_the_wheels_that_fit_are_those_that_pip_accepts() -> None:
    tags = pytest.importorskip("packaging.tags")
    accepted = [tag for tag in tags.sys_tags() if tag.interpreter[:2] in ("cp", "py")]
    assert len(accepted) > 100
    assert all(reproduce.fits_here(tag.interpreter, tag.abi, tag.platform) for tag in accepted)
    major, minor = sys.version_info[:2]
    for wrong in (("cp27", "cp27m", "any"), (f"cp{major}{minor + 1}", "abi3", "any"), ("py3", "none", "win32")):
        assert not reproduce.fits_here(*wrong)
    assert not reproduce.fits_here("py3", "none", f"manylinux_9_99_{os.uname().machine}")
    assert not reproduce.fits_here("py3", "none", "manylinux_2_17_s390x")


def test_level_3_is_that_of_the_sierra_on_the_path(tmp_path: Path) -> None:
    program = tmp_path / "bin/sierra"
    program.parent.mkdir()
    program.write_text('#!/bin/sh\ntest "$2" = --help || { echo "called: $@"; exit 1; }\n')
    program.chmod(0o755)
    folder = extracted(tmp_path / "x")
    environment = {"PATH": f"{program.parent}:/usr/bin:/bin"}
    told = ran(folder, "--execute", "--yes", "--budget=10m", "--engine=host", cwd=tmp_path, environment=environment)
    options = f"--yes --into {folder}/reproduction/level-3 --engine none --budget 10m"
    assert (told[0], f"called: reproduce {folder} {options}\n" in told[1]) == (1, True)
    assert "Level 3 of 3 reached." in told[1]
    told = ran(folder, "--execute", cwd=tmp_path, environment=environment)
    assert (told[0], "called" in told[1], "nothing was executed" in told[1]) == (3, False, True)
    told = ran(folder, "--execute", "--level=2", cwd=tmp_path, environment=environment)
    assert (told[0], "the package has no execution/execute_runs.py" in told[1]) == (3, True)


def wheel(name: str, version: str, module: str, script: str = "") -> bytes:
    """Return a wheel with one module, and with a program if its entry point is given."""
    info = f"{name}-{version}.dist-info"
    contents = {
        f"{name}.py": module,
        f"{info}/METADATA": f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n",
        f"{info}/WHEEL": "Wheel-Version: 1.0\nGenerator: x\nRoot-Is-Purelib: true\nTag: py3-none-any\n",
        f"{info}/entry_points.txt": f"[console_scripts]\n{script}\n",
    }
    contents[f"{info}/RECORD"] = "".join(f"{path},,\n" for path in (*contents, f"{info}/RECORD"))
    made = io.BytesIO()
    with zipfile.ZipFile(made, "w") as file:
        for path, text in contents.items():
            file.writestr(path, text)
    return made.getvalue()


@pytest.mark.nightly
def test_level_3_installs_the_wheels_of_the_package_without_network(require: Callable[..., str], tmp_path: Path) -> None:
    python = python_of("3.8")
    require("Python 3.8", there=python is not None)
    module = "import sys\ndef main():\n    print('called:', *sys.argv[1:3])\n"
    content = wheel("sierra_experiments", "2.0", module, "sierra = sierra_experiments:main")
    lock = f"sierra-experiments==2.0 --hash=sha256:{hashlib.sha256(content).hexdigest()}\n".encode()
    own = WHEEL.replace("/wheels/", "/sierra/")
    other = {"environment/wheels/one-1.0-py3-none-any.whl": b"PK"}
    folder = extracted(tmp_path / "x", **other, **{own: content, "environment/requirements.lock": lock})
    options = ("--execute", "--yes", f"--work={tmp_path / 'work'}")
    for _ in range(2):
        status, printed = ran(folder, *options, cwd=tmp_path, python=str(python))
        assert (status, f"called: reproduce {folder}\n" in printed) == (0, True)
        assert "Level 3 of 3 reached." in printed
    assert not (folder / "reproduction").exists()
    wrong = lock.replace(b"sha256:", b"sha256:0")[:-2] + b"\n"
    other = extracted(tmp_path / "y", **{WHEEL: content, "environment/requirements.lock": wrong})
    status, printed = ran(other, "--execute", "--yes", cwd=tmp_path, python=str(python))
    assert (status, "called" in printed, "-m pip" in printed) == (3, False, True)


def test_nothing_of_the_package_is_imported(tmp_path: Path) -> None:
    evil = f"raise SystemExit(open({str(tmp_path / 'evil')!r}, 'w'))".encode()
    folder = extracted(tmp_path / "x", **{"zipfile.py": evil, "json.py": evil, "sierra/__init__.py": evil})
    assert ran(cwd=folder, program=Path("reproduce.py"))[0] == 0
    assert not (tmp_path / "evil").exists()


@pytest.mark.integration
def test_wrong_arguments_and_missing_files_are_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = package(tmp_path / "x.zip")
    (tmp_path / "kept").write_text("a thesis")
    for arguments, expected in (
        ((tmp_path / "none.zip",), 3),
        ((path, "--unpack", tmp_path / "kept"), 2),
        ((path, "--unpack", tmp_path / "none/below"), 3),
        ((extracted(tmp_path / "y"), "--unpack", tmp_path / "z"), 2),
    ):
        status, printed = said(capsys, *arguments)
        assert (status, printed.count("\n"), printed.startswith("reproduce.py: ")) == (expected, 1, True)
    assert (tmp_path / "kept").read_text() == "a thesis"
    status, printed = ran(cwd=tmp_path)
    assert (status, "there are 2 zips here" in printed) == (2, True)
    wrong = ("--unknown",), ("--yes",), ("--execute", "--budget=9x"), ("--execute", "--runs=0"), (path, "--execute")
    assert [ran(*arguments, cwd=tmp_path)[0] for arguments in wrong] == [2] * 5
    status, printed = ran("--help", cwd=tmp_path)
    assert (status, "Exit status: 0 if all files" in printed) == (0, True)


def test_a_package_that_exceeds_the_disk_is_not_begun(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    path = package(tmp_path / "x.zip")
    monkeypatch.setattr("shutil.disk_usage", lambda path: SimpleNamespace(free=3))
    status, printed = said(capsys, path, "--unpack", tmp_path / "out")
    needed = sum(map(len, MEMBERS.values()))
    assert (status, f"3 bytes of free space, but {needed} are needed" in printed) == (3, True)
    assert [one.name for one in tmp_path.iterdir()] == ["x.zip"]


@pytest.mark.nightly
def test_ctrl_c_ends_with_130_and_leaves_nothing(tmp_path: Path) -> None:
    forged(tmp_path / "x.zip", [(f"{number}.bin", bytes(20_000_000)) for number in range(15)])
    command = [sys.executable, str(PROGRAM), "x.zip", "--unpack", "out"]
    process = subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    while not list(tmp_path.glob(".out.*/*.bin")):
        assert process.poll() is None
        time.sleep(0.01)
    process.send_signal(signal.SIGINT)
    printed = process.communicate(timeout=60)
    assert (process.returncode, printed) == (130, ("", "reproduce.py: interrupted\n"))
    assert [one.name for one in tmp_path.iterdir()] == ["x.zip"]


def test_output_that_nobody_reads_is_no_traceback(tmp_path: Path) -> None:
    package(tmp_path / "x.zip")
    reading, writing = os.pipe()
    os.close(reading)
    with os.fdopen(writing, "wb") as closed:
        done = subprocess.run([sys.executable, str(PROGRAM)], cwd=tmp_path, stdout=closed, stderr=subprocess.PIPE, check=False)
    assert (done.returncode, done.stderr) == (1, b"")


def test_a_trusted_copy_starts_no_program_of_a_package_without_consent(tmp_path: Path) -> None:
    folder = extracted(tmp_path / "x", **{reproduce.EXECUTOR: b"open('executed', 'w')\n"})
    status, printed = ran(folder, "--execute", "--level", "2", cwd=tmp_path)
    assert (status, "nothing was executed" in printed) == (3, True)
    assert not (tmp_path / "executed").exists()
    assert ran(folder, "--execute", "--level", "2", "--yes", cwd=tmp_path)[0] == 0
    assert (tmp_path / "executed").exists()
