"""The file of a package: the same members give the same file, and nothing of a hostile file is believed."""

from __future__ import annotations

import hashlib
import io
import re
import stat
import subprocess
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest

from sierra.errors import Damaged, Missing, SierraError, UsageError
from sierra.packages.archive import Archive, write
from sierra.packages.members import MANIFEST, package_id
from sierra.packages.subject import Member

MEMBERS = {"sierra.toml": b"runs = 1\n", "results/a.parquet": b"PAR1" * 9, "source/run.sh": b"#!/bin/sh\n"}


@dataclass(frozen=True)
class Bytes:
    data: bytes

    @property
    def size(self) -> int:
        return len(self.data)

    def open(self) -> io.BytesIO:
        return io.BytesIO(self.data)


def package(path: Path, **changed: bytes) -> Path:
    contents = {name: Bytes(data) for name, data in {**MEMBERS, **changed}.items()}
    write(path, contents, executable=["source/run.sh"])
    return path


def forged(path: Path, members: list[tuple[zipfile.ZipInfo | str, bytes]], *, listed: dict[str, bytes] | None = None) -> Path:
    """Write a zip with any members, and a manifest that lists them."""
    named = {getattr(one, "filename", one): data for one, data in members} if listed is None else listed
    lines = (f"{hashlib.sha256(data).hexdigest()}  {name}\n" for name, data in sorted(named.items()))
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file:
        for one, data in members:
            file.writestr(one, data)
        file.writestr(MANIFEST, "".join(lines))
    return path


def refused(path: Path, action: Callable[[Archive], object] = Archive.verify) -> str:
    with pytest.raises(SierraError) as error, Archive(path) as found:
        action(found)
    line = str(error.value)
    assert "\n" not in line
    return line


def test_a_package_is_read_as_it_was_written(tmp_path: Path) -> None:
    with Archive(package(tmp_path / "x.zip")) as found:
        found.verify()
        assert found.names() == sorted(MEMBERS)
        assert found.names("results/") == ["results/a.parquet"]
        assert found.read("sierra.toml") == MEMBERS["sierra.toml"]
        assert found.id == package_id({name: hashlib.sha256(data).hexdigest() for name, data in MEMBERS.items()})
        found.extract(found.names(), tmp_path / "out")
    files = {path.relative_to(tmp_path / "out").as_posix(): path for path in (tmp_path / "out").rglob("*") if path.is_file()}
    assert {name: path.read_bytes() for name, path in files.items()} == MEMBERS
    assert [name for name, path in files.items() if path.stat().st_mode & stat.S_IXUSR] == ["source/run.sh"]


def test_the_same_members_give_the_same_file_at_another_time(tmp_path: Path) -> None:
    one, other = package(tmp_path / "1.zip"), package(tmp_path / "2.zip")
    assert one.read_bytes() == other.read_bytes()
    with Archive(one) as first, Archive(package(tmp_path / "3.zip", **{"sierra.toml": b"runs = 2\n"})) as second:
        assert first.id != second.id


def test_coreutils_check_an_unpacked_package(tmp_path: Path) -> None:
    with zipfile.ZipFile(package(tmp_path / "x.zip")) as file:
        file.extractall(tmp_path / "out")
    command = ("sha256sum", "--check", "--strict", "--quiet", MANIFEST)
    assert subprocess.run(command, cwd=tmp_path / "out", check=False).returncode == 0


def test_an_existing_file_is_not_replaced(tmp_path: Path) -> None:
    path = tmp_path / "x.zip"
    path.write_text("a thesis")
    with pytest.raises(UsageError, match="exists already"):
        package(path)
    assert path.read_text() == "a thesis"
    assert [one.name for one in tmp_path.iterdir()] == ["x.zip"]


@pytest.mark.parametrize(
    "name",
    [
        *(
            "../evil",
            "a/../../evil",
            "/etc/evil",
            "a//b",
            "./a",
            "a/.",
            "a\\b",
            "C:evil",
            "a\nb",
            "a\x1b[2J",
            "aux.txt",
            "project/.GIT/config",
            "a/NUL",
        ),
        *("a ", "a.", " a", "x" * 1100, "a\u202eb", "a/NUL"),
    ],
)
def test_names_that_may_lead_elsewhere_are_refused(tmp_path: Path, name: str) -> None:
    assert "member" in refused(forged(tmp_path / "x.zip", [(name, b"1")])) or "line" in refused(tmp_path / "x.zip")


def test_names_that_are_one_on_some_systems_are_refused(tmp_path: Path) -> None:
    for one, other in (("a", "A"), ("é", "e\u0301"), ("straße", "STRASSE"), ("a", "a/b"), ("B/c", "b")):
        path = forged(tmp_path / f"{hashlib.sha256((one + other).encode()).hexdigest()}.zip", [(one, b"1"), (other, b"2")])
        assert "which is a folder" in refused(path) or "on some systems" in refused(path)


@pytest.mark.filterwarnings("ignore:Duplicate name")
def test_a_member_that_is_there_twice_is_refused(tmp_path: Path) -> None:
    assert "two members" in refused(forged(tmp_path / "x.zip", [("a", b"1"), ("a", b"2")]))


@pytest.mark.parametrize("kind", [stat.S_IFLNK, stat.S_IFDIR, stat.S_IFCHR, stat.S_IFIFO])
def test_links_folders_and_devices_are_refused(tmp_path: Path, kind: int) -> None:
    info = zipfile.ZipInfo("a")
    info.external_attr = (kind | 0o777) << 16
    assert "no regular file" in refused(forged(tmp_path / "x.zip", [(info, b"/etc/passwd")]))


def test_members_and_manifest_must_be_the_same(tmp_path: Path) -> None:
    assert "x.zip: 'b' is not listed" in refused(forged(tmp_path / "x.zip", [("a", b"1"), ("b", b"2")], listed={"a": b"1"}))
    assert "'b' is missing, but manifest-sha256.txt lists it" in refused(
        forged(tmp_path / "2.zip", [("a", b"1")], listed={"a": b"1", "b": b"2"})
    )
    assert "'a' is not what" in refused(forged(tmp_path / "3.zip", [("a", b"1")], listed={"a": b"2"}))
    with zipfile.ZipFile(tmp_path / "4.zip", "w") as file:
        file.writestr("a", "1")
    assert "it has no manifest-sha256.txt" in refused(tmp_path / "4.zip")


def test_each_flipped_byte_of_a_member_and_each_cut_is_noticed(tmp_path: Path) -> None:
    whole = package(tmp_path / "x.zip").read_bytes()
    path = tmp_path / "y.zip"
    place = whole.index(b"PAR1PAR1")
    for damaged in (
        whole[:place] + b"Q" + whole[place + 1 :],
        whole[:-1],
        whole[: len(whole) // 2],
        b"",
        whole[: len(whole) - 30],
    ):
        path.write_bytes(damaged)
        assert str(path) in refused(path)


def test_a_member_that_grows_beyond_its_size_is_not_unpacked(tmp_path: Path) -> None:
    path = forged(tmp_path / "x.zip", [("a", b"0" * 5_000_000)])
    data = path.read_bytes().replace((5_000_000).to_bytes(4, "little"), (10).to_bytes(4, "little"))
    path.write_bytes(data)
    assert "'a'" in refused(path, lambda found: found.extract(["a"], tmp_path / "out"))
    assert not (tmp_path / "out" / "a").exists()


def test_a_member_that_exceeds_the_disk_is_not_begun(tmp_path: Path) -> None:
    path = forged(tmp_path / "x.zip", [("a", b"0" * 5_000_000)])
    path.write_bytes(path.read_bytes().replace((5_000_000).to_bytes(4, "little"), (2**32 - 2).to_bytes(4, "little")))
    with Archive(path) as found:
        found._package.infos["a"].file_size = 2**62
        with pytest.raises(Missing, match="free space"):
            found.extract(["a"], tmp_path / "out")


def test_a_password_and_other_methods_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "x.zip"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_LZMA) as file:
        file.writestr("a", b"1" * 100)
    assert "compressed by a method" in refused(path)
    data = bytearray(package(tmp_path / "y.zip").read_bytes())
    place = data.index(b"PK\x01\x02")
    data[place + 8] |= 1
    (tmp_path / "y.zip").write_bytes(data)
    assert "needs a password" in refused(tmp_path / "y.zip")


def test_a_file_that_is_no_zip_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "x.zip").write_text("no zip")
    assert "is no package" in refused(tmp_path / "x.zip")
    with pytest.raises(Missing):
        Archive(tmp_path / "none.zip")
    with pytest.raises(Missing):
        Archive(tmp_path)


@pytest.mark.nightly
def test_members_above_4_gib_are_written_and_read(tmp_path: Path) -> None:
    class Zeros:
        size = 5 << 30

        def open(self) -> io.BufferedReader:
            path = tmp_path / "zeros"
            with path.open("wb") as file:
                file.truncate(self.size)
            return path.open("rb")

    write(tmp_path / "x.zip", {"large.txt": Zeros()})
    with Archive(tmp_path / "x.zip") as found:
        assert found.size("large.txt") == 5 << 30
        found.verify()


def test_a_manifest_that_is_not_ours_is_damaged(tmp_path: Path) -> None:
    for content in (b"\xff", b"abc  x\n", b"0" * 64 + b"  b\n" + b"0" * 64 + b"  a\n", b"0" * 64 + b"  a"):
        path = tmp_path / f"{hashlib.sha256(content).hexdigest()}.zip"
        with zipfile.ZipFile(path, "w") as file:
            file.writestr("a", "1")
            file.writestr(MANIFEST, content)
        with pytest.raises(Damaged, match=MANIFEST):
            Archive(path)


def test_a_place_outside_the_file_is_damage(tmp_path: Path) -> None:
    whole = package(tmp_path / "x.zip").read_bytes()
    end = whole.rindex(b"PK\x05\x06")
    for place in range(end + 12, end + 20):  # the size and the place of the list of members
        damaged = bytearray(whole)
        damaged[place] ^= 0x80
        (tmp_path / "y.zip").write_bytes(damaged)
        with pytest.raises(Damaged, match=re.escape(str(tmp_path / "y.zip"))), Archive(tmp_path / "y.zip") as found:
            found.verify()


def test_a_zip_inside_a_package_stays_a_plain_file(tmp_path: Path) -> None:
    inner = forged(tmp_path / "inner.zip", [("../evil", b"1")]).read_bytes()
    with Archive(package(tmp_path / "x.zip", **{"source/inner.zip": inner})) as found:
        found.verify()
        found.extract(found.names(), tmp_path / "out")
    assert (tmp_path / "out" / "source" / "inner.zip").read_bytes() == inner
    assert not (tmp_path / "evil").exists()
    assert sorted(path.name for path in (tmp_path / "out" / "source").iterdir()) == ["inner.zip", "run.sh"]


@pytest.mark.nightly
def test_a_member_of_5_gib_is_written_and_checked(tmp_path: Path) -> None:
    size = 5 << 30
    with (tmp_path / "large.bin").open("wb") as file:
        file.truncate(size)  # sparse: it takes no space
    member = Member("source/large.bin", tmp_path / "large.bin", "")
    write(tmp_path / "x.zip", {member.name: member})
    with Archive(tmp_path / "x.zip") as found:
        assert found.size(member.name) == size
        found.verify()
        with pytest.raises(Damaged, match="at most"):
            found.read(member.name)
    assert (tmp_path / "x.zip").stat().st_size < 100 << 20


def test_all_versions_of_python_write_the_same_bytes(tmp_path: Path) -> None:
    """They differ in the form for files of more than 2 GiB, and mark it by a version of zip from 45 on."""
    write(tmp_path / "x.zip", {name: Member(name, b"x" * 5000, "") for name in ("a.txt", "b.png")})
    with zipfile.ZipFile(tmp_path / "x.zip") as file:
        assert {(one.create_version, one.extract_version, one.extra) for one in file.infolist()} == {(20, 20, b"")}
    assert (tmp_path / "x.zip").read_bytes()[:8] == b"PK\x03\x04\x14\x00\x00\x00"
