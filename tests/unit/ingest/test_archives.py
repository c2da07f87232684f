"""Files in archives are tables; whatever is wrong with an archive fails its run with one line."""

from __future__ import annotations

import bz2
import copy
import gzip
import io
import lzma
import os
import stat
import subprocess
import sys
import tarfile
import tempfile
import warnings
import zipfile
from collections.abc import Callable, Iterable
from pathlib import Path

import pyarrow as pa
import pytest

from sierra.errors import Missing
from sierra.ingest import archives
from tests.projects import CONFIG, SIERRA, make, quick, run, sql

pytestmark = pytest.mark.integration
ROWS = b"t,v\n1,10\n2,20\n"
NAME = "results.csv"
COPY = """\
import pathlib, shutil, sys
arena = open(sys.argv[1]).read()
folder = pathlib.Path(sys.argv[0]).parent / "written" / arena.split('<swarm count="')[1].split('"')[0]
shutil.copytree(folder, ".", dirs_exist_ok=True)
"""
"""A simulator that leaves the files of a folder, which the number of robots names."""


def tar(*members: tuple[str, bytes] | tarfile.TarInfo, ended: bool = True) -> bytes:
    out = io.BytesIO()
    with tarfile.open(fileobj=out, mode="w", format=tarfile.GNU_FORMAT) as file:
        for member in members:
            info, content = (member, b"") if isinstance(member, tarfile.TarInfo) else (tarfile.TarInfo(member[0]), member[1])
            info.size = len(content)
            file.addfile(info, io.BytesIO(content))
        size = out.tell()
    return out.getvalue()[: None if ended else size]


def entry(name: str, kind: bytes, link: str = "") -> tarfile.TarInfo:
    info = tarfile.TarInfo(name)
    info.type, info.linkname = kind, link
    return info


def packed(
    *members: tuple[str, bytes], method: int = zipfile.ZIP_STORED, change: Callable[[zipfile.ZipFile], None] = lambda file: None
) -> bytes:
    """Return a zip; `change` changes its list of members before it is written."""
    out = io.BytesIO()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about names that occur twice
        with zipfile.ZipFile(out, "w", method) as file:
            for name, content in members:
                file.writestr(zipfile.ZipInfo(name), content, method)
            change(file)
    return out.getvalue()


def as_link(file: zipfile.ZipFile, number: int = 0) -> None:
    file.filelist[number].external_attr = (stat.S_IFLNK | 0o777) << 16


def as_huge(file: zipfile.ZipFile) -> None:
    file.filelist[0].file_size = 1 << 60


def as_small(file: zipfile.ZipFile) -> None:
    file.filelist[0].file_size = 8


def as_secret(file: zipfile.ZipFile) -> None:
    file.filelist[0].flag_bits |= 1


def twice_there(file: zipfile.ZipFile) -> None:
    other = copy.copy(file.filelist[0])
    other.filename = other.orig_filename = "other.csv"
    file.filelist.append(other)


def zip64() -> bytes:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as file:
        with file.open(NAME, "w", force_zip64=True) as member:
            member.write(ROWS)
        for number in range(1 << 16):  # the end of a zip with so many members is another one
            file.writestr(zipfile.ZipInfo(f"{number}/"), b"")
    return out.getvalue()


WHOLE, ZIP = tar((NAME, ROWS)), packed((NAME, ROWS))
LARGE = tar((NAME, ROWS * 1000))
NOTED = packed((NAME, ROWS), change=lambda file: setattr(file, "comment", b"a note"))
HIDDEN = packed((NAME, ROWS), ("link", b"elsewhere"), change=lambda file: as_link(file, 1))
HOSTILE: tuple[tuple[str, bytes, str], ...] = (
    ("out.zip", packed((NAME, ROWS), (NAME, b"t,v\n")), "the archive has two members with one name on some systems"),
    ("out.zip", packed((NAME, ROWS), ("RESULTS.csv", b"")), "the archive has two members with one name on some systems"),
    ("out.zip", packed((NAME, ROWS), (f"{NAME}/x", b"")), "the archive has the member 'results.csv', which is a folder of"),
    ("out.zip", packed((NAME, ROWS), ("../x", b"")), "the archive has a member '../x', but names must stay inside it"),
    ("out.zip", packed((NAME, ROWS), ("/etc/x", b"")), "the archive has a member '/etc/x', but names must stay inside it"),
    ("out.zip", packed((NAME, ROWS), ("a\\b", b"")), "but names have only printable characters, without \\"),
    ("out.zip", packed((NAME, ROWS), ("../up/", b"")), "the archive has a folder '../up', but names must stay inside it"),
    ("out.zip", ZIP[:-30], "the archive cannot be read: File is not a zip file"),
    ("out.zip", ZIP.replace(b"1,10", b"1,11", 1), "member 'results.csv' is damaged: Bad CRC-32"),
    ("out.zip", packed((NAME, b"elsewhere"), change=as_link), "member 'results.csv' is no regular file: links, folders"),
    ("out.zip", packed((NAME, ROWS), change=as_secret), "member 'results.csv' needs a password"),
    ("out.zip", packed((NAME, ROWS), method=zipfile.ZIP_BZIP2), "is compressed by a method other than deflate"),
    ("out.zip", packed((NAME, ROWS), change=twice_there), "member 'other.csv' overlaps another one"),
    ("out.zip", packed((NAME, ROWS), change=as_huge), "member 'results.csv' is shorter than it says"),
    ("out.zip", packed((NAME, ROWS), change=as_small), "member 'results.csv' is damaged: Bad CRC-32"),
    ("out.zip", ZIP + packed((NAME, b"t,v\n")), "the archive has data before its first member; is it two archives"),
    ("out.zip", ZIP + b"garbage", "the archive has data after its end, or its comment is cut short"),
    ("out.zip", ZIP + WHOLE, "the archive has data after its end, or its comment is cut short"),
    ("out.zip", ZIP + ZIP[:40], "the archive has data after its end, or its comment is cut short"),
    ("out.zip", NOTED[:-1], "the archive has data after its end, or its comment is cut short"),
    ("out.zip", WHOLE + packed(), "the archive has data before its first member"),
    ("out.zip", packed((NAME, ROWS), ("other", b"x1x")).replace(b"x1x", b"x2x", 1), "member 'other' is damaged: Bad CRC-32"),
    ("out.zip", b"", "the archive cannot be read: File is not a zip file"),
    ("out.tar", tar((NAME, ROWS), (f"./{NAME}", ROWS)), "the archive has two members with one name on some systems"),
    ("out.tar", tar((NAME, ROWS), ("../x", b"")), "the archive has a member '../x', but names must stay inside it"),
    ("out.tar", tar((NAME, ROWS), ("/x", b"")), "the archive has a member '/x', but names must stay inside it"),
    ("out.tar", tar(entry(NAME, tarfile.SYMTYPE, "/etc/passwd")), "member 'results.csv' is a link, a device or a sparse file"),
    ("out.tar", tar(("a", ROWS), entry(NAME, tarfile.LNKTYPE, "a")), "member 'results.csv' is a link, a device or a sparse"),
    ("out.tar", tar(entry(NAME, tarfile.FIFOTYPE)), "member 'results.csv' is a link, a device or a sparse file"),
    ("out.tar", tar(("x", b""), entry("x", tarfile.SYMTYPE, "/"), ("x/y", b"")), "two members with one name on some systems"),
    ("out.tar", tar((NAME, ROWS), ended=False), "the archive is cut short: the mark of its end is missing"),
    ("out.tar", LARGE[:5000], "unexpected end of data"),
    ("out.tar", WHOLE[:1024] + b"x" * 512 + WHOLE[1024:], "the archive has a broken header"),
    ("out.tar", WHOLE + tar(("b.csv", ROWS)), "the archive has data after its end; is it two archives, one after the other?"),
    ("out.tar", b"t,v\n" * 999, "the archive"),
    ("out.tar", b"", "the archive"),
    ("out.tar.gz", gzip.compress(LARGE)[:-12], "the archive"),
    ("out.tar.gz", gzip.compress(WHOLE)[:-8] + bytes(8), "the archive is truncated or damaged: CRC check failed"),
    ("out.tar.gz", gzip.compress(WHOLE) + b"rest", "the archive is truncated or damaged: Not a gzipped file"),
    ("out.tar.gz", WHOLE, "the archive is truncated or damaged: Not a gzipped file"),
    ("out.tar.xz", lzma.compress(WHOLE)[:-30], "the archive is truncated or damaged: the compressed data ends too early"),
    ("out.tar.xz", lzma.compress(WHOLE) + b"rest of something", "the archive cannot be read: Input format not supported"),
    ("out.tar.xz", lzma.compress(WHOLE) + bytes(1 << 21) + lzma.compress(WHOLE), "the archive has data after its end"),
    ("out.tar.bz2", bz2.compress(WHOLE)[:-10], "the archive is truncated or damaged: the compressed data ends too early"),
    ("out.tar.bz2", bz2.compress(WHOLE) + b"rest", "the archive"),
    ("out.tar.zst", pa.compress(LARGE, "zstd", asbytes=True)[:-10], "the archive"),
)
FOLDER = entry("./", tarfile.DIRTYPE)
PLAIN = tar(FOLDER, (f"./{NAME}", ROWS), entry("./latest", tarfile.SYMTYPE, NAME), ("./2024-01-01T10:00:00", b""))
SOUND: tuple[tuple[str, bytes], ...] = (
    ("out.zip", packed(("logs/", b""), (NAME, ROWS), method=zipfile.ZIP_DEFLATED)),
    ("out.tar", PLAIN),
    ("out.tgz", gzip.compress(PLAIN)),
    ("out.tar.gz", gzip.compress(PLAIN[:700]) + gzip.compress(PLAIN[700:])),
    ("out.tar.xz", lzma.compress(PLAIN)),
    ("out.txz", lzma.compress(PLAIN[:512]) + bytes(4) + lzma.compress(PLAIN[512:])),
    ("out.tar.bz2", bz2.compress(PLAIN[:512]) + bz2.compress(PLAIN[512:])),
    ("out.tar.zst", pa.compress(PLAIN, "zstd", asbytes=True)),
    ("OUT.ZIP", ZIP),
    ("out.zip", NOTED),
    ("out.zip", HIDDEN),
    ("out.zip", zip64()),
)


def project(folder: Path, written: Iterable[Iterable[tuple[str, bytes]]], config: str) -> Path:
    """Write a project whose run with n robots leaves the files of the n-th element."""
    root = make(folder, CONFIG.replace("runs = 2", "runs = 1") + config, simulator=COPY)
    for number, files in enumerate(written, 1):
        for name, content in files:
            path = root / "written" / str(number) / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content)
    return root


def test_faults_of_archives_are_faults_of_their_runs_and_sound_ones_are_tables(tmp_path: Path) -> None:
    names = dict.fromkeys(name for name, *_ in (*HOSTILE, *SOUND))
    config = "".join(
        f'[outputs.o{number}]\nfile = "{name}/{NAME}"\nrequired = false\nmismatch = "ragged"\n'
        for number, name in enumerate(names)
    )
    cases = [[(name, content)] for name, content, *_ in (*SOUND, *HOSTILE)]
    root = project(tmp_path / "p", cases, config)
    done = quick(root, "run", f"population_size=1:{len(cases)}:{len(cases)}", "--no-figures")
    assert done.returncode == 1, done.stderr
    assert "Traceback" not in done.stdout + done.stderr
    rows = sql(root, "SELECT population_size AS n, e.status, e.reason FROM executions e JOIN runs USING (run) ORDER BY n")
    assert [row["status"] for row in rows[: len(SOUND)]] == ["ok"] * len(SOUND), rows[: len(SOUND)]
    for (name, _, expected), row in zip(HOSTILE, rows[len(SOUND) :], strict=True):
        assert row["status"] == "mismatch", (name, expected, row)
        assert row["reason"].startswith(f"{name}: "), (expected, row)
        assert expected in row["reason"], row
        assert "\n" not in row["reason"]
    tables = " UNION ALL ".join(f"SELECT run, t, v FROM o{number}" for number in range(len(names)))
    assert sql(root, f"SELECT count(DISTINCT run) AS runs, sum(v)::INT AS v FROM ({tables})") == [
        {"runs": len(SOUND), "v": 30 * len(SOUND)}
    ]
    artifacts = "SELECT DISTINCT rows, counted_rows, member FROM artifacts WHERE kind = 'table'"
    assert sql(root, artifacts) == [{"rows": 2, "counted_rows": 2, "member": NAME}]
    assert quick(root, "fsck").returncode == 0


def parquet() -> bytes:
    import pyarrow.parquet as pq

    out = io.BytesIO()
    pq.write_table(pa.table({"t": [1, 2], "v": [10, 20]}), out)
    return out.getvalue()


def test_all_formats_patterns_and_numbers_work_in_archives(tmp_path: Path) -> None:
    members = [
        *((f"run_{part}/results.csv", ROWS.replace(b"10", b"1%d" % part)) for part in (3, 10)),
        ("a/x-1.csv", ROWS),
        ("a/x-2.csv", ROWS),
        ("table.parquet", parquet()),
        ("rows.csv.gz", gzip.compress(b"# c\n" + ROWS)),
        ("list.json", b'[{"v": 1}, {"v": 2}]'),
        ("lines.jsonl", b'{"v": 1}\n'),
        ("log.txt", b"step=1\nnoise\nstep=2\n"),
        ("list.xml", b"<all><e v='1'/><e v='2'/></all>"),
    ]
    tables = {
        "parts": 'file = "out.zip/run_{part}/results.csv"',
        "globs": 'file = "*.zip/a/x-*.csv"',
        "parquets": 'file = "out.zip/table.parquet"',
        "gz": 'file = "out.zip/rows.csv.gz"\nformat = "csv"\ncomment = "#"',
        "json": 'file = "out.zip/list.json"\nformat = "json"',
        "jsonl": 'file = "./out.zip/lines.jsonl"',
        "lines": "file = \"out.zip/log.txt\"\nlines = 'step=(?P<step>\\d+)'",
        "more": "file = \"out.zip/log.txt\"\nlines = '(?P<word>noise)'",
        "xml": 'file = "out.zip/list.xml"\nformat = "xml"\nrows = "//e"',
        "numbered": 'file = "floor-{tick}.tar/results.csv"',
    }
    tars = [(f"floor-{tick}.tar", tar((NAME, ROWS.replace(b"t,v", b"s,v")))) for tick in (7, 8)]
    config = "".join(f"[outputs.{name}]\n{keys}\n" for name, keys in tables.items())
    root = project(tmp_path / "p", [[("out.zip", packed(*members)), *tars]], config)
    done = quick(root, "run", "population_size=1", "--no-figures")
    assert (done.returncode, "not a table" in done.stdout) == (0, False), done.stdout
    counts = ", ".join(f"(SELECT count(*) FROM {name}) AS {name}" for name in tables)
    expected = {"parts": 4, "globs": 4, "parquets": 2, "gz": 2, "json": 2, "jsonl": 1, "lines": 2, "more": 1, "xml": 2}
    assert sql(root, f"SELECT {counts}") == [expected | {"numbered": 4}]
    assert sql(root, "SELECT part, v FROM parts WHERE t = 1 ORDER BY part") == [{"part": 3, "v": 13}, {"part": 10, "v": 110}]
    assert {row["file"] for row in sql(root, "SELECT file FROM globs")} == {"out.zip/a/x-1.csv", "out.zip/a/x-2.csv"}
    assert {row["tick"] for row in sql(root, "SELECT tick FROM numbered")} == {7, 8}
    assert quick(root, "fsck").returncode == 0
    assert "not a table" not in quick(root, "outputs").stdout
    assert quick(root, "replay").returncode == 0


@pytest.mark.parametrize(
    ("keys", "said"),
    [
        ('file = "out.zip/other.csv"', "'out.zip/other.csv' (output 'o') is not in the archive, which has 'results.csv'"),
        ('file = "out.zip/re*.csv"\n[outputs.p]\nfile = "out.zip/*s.csv"', "'results.csv' belongs to the outputs 'o' and 'p'"),
        ('file = "out.tar/results.csv"', "did not write 'out.tar/results.csv' (output 'o')"),
        ('file = "out.zip/results.csv"\nmin_rows = 3', "out.zip/results.csv: 2 rows; [outputs.o] min_rows asks for 3"),
        ('file = "out.zip/results.csv"\ncolumns = ["a"]\nheader = false', "out.zip/results.csv: "),
    ],
)
def test_a_run_without_what_is_declared_in_an_archive_fails(tmp_path: Path, keys: str, said: str) -> None:
    root = project(tmp_path / "p", [[("out.zip", ZIP)]], f"[outputs.o]\n{keys}\n")
    assert quick(root, "run", "population_size=1", "--no-figures").returncode == 1
    [row] = sql(root, "SELECT reason FROM executions")
    assert said in row["reason"]


@pytest.mark.parametrize(
    ("keys", "said"),
    [
        ('file = "out.zip/log.txt"', "file: 'out.zip/log.txt' in an archive needs the format of a table"),
        ('file = "out.zip/a.csv"\nformat = "file"', 'to keep a file as it is, declare its archive: file = "out.zip"'),
        ('file = "out.zip/a.csv{rotation}"', "file: {rotation} is not supported in an archive"),
    ],
)
def test_what_cannot_be_read_in_an_archive_is_refused_at_once(tmp_path: Path, keys: str, said: str) -> None:
    root = project(tmp_path / "p", [], f"[outputs.o]\n{keys}\n")
    done = quick(root, "run", "population_size=1", "--no-figures")
    assert (done.returncode, said in done.stderr) == (2, True), done.stderr


STAMPED = """\
import sys, time, zipfile
with zipfile.ZipFile("out.zip", "w") as file:
    info = zipfile.ZipInfo("data/results.csv", (1980 + time.time_ns() // 1000 % 100, 1, 1, 0, 0, 0))
    file.writestr(info, "t,v\\n1,10\\n2,20\\n")
    file.writestr("data/notes.md", f"# made at {time.time_ns()}")
"""


def test_outputs_writes_what_is_in_archives_and_replay_compares_values(tmp_path: Path) -> None:
    root = make(tmp_path / "p", simulator=STAMPED)
    run(root, "population_size=1")
    shown = quick(root, "outputs").stdout
    assert "not a table: out.zip/data/results.csv" in shown
    assert 'in an archive; declare [outputs.results] file = "out.zip/data/results.csv"' in shown
    assert quick(root, "outputs", "--write").returncode == 0
    summary, _ = run(root, "population_size=1")
    assert (summary["executed"], summary["failed"]) == (0, 0)
    assert sql(root, "SELECT count(*) AS n FROM results") == [{"n": 4}]
    assert "not a table" not in quick(root, "outputs").stdout
    config = root / "sierra.toml"
    config.write_text(config.read_text().replace("out.zip/data/results.csv", "out.zip/data/*.csv"))
    summary, _ = run(root, "population_size=1")
    assert (summary["executed"], summary["failed"]) == (0, 0)
    assert sql(root, "SELECT DISTINCT file FROM results") == [{"file": "out.zip/data/results.csv"}]
    replayed = quick(root, "replay")
    assert replayed.returncode == 0, replayed.stdout
    values = "out.zip/data/results.csv: the same values, but different bytes; files of the archive that are no tables are not"
    assert values in replayed.stdout
    assert quick(root, "fsck").returncode == 0


def test_nothing_is_read_of_a_damaged_archive_of_an_accepted_end(tmp_path: Path) -> None:
    names = ("a.csv", "b.csv")
    cut = tar(*((name, ROWS) for name in names), ended=False)
    config = "".join(f'[outputs.{name[0]}]\nfile = "out.tar/{name}"\n' for name in names)
    root = project(tmp_path / "p", [[("out.tar", cut)]], f'{config}[success]\naccept = ["exit 3"]\n')
    (root / "sim.py").write_text(f"{COPY}sys.exit(3)\n")
    run(root, "population_size=1")
    assert sql(root, "SELECT status, reason FROM executions") == [{"status": "accepted", "reason": "exit 3"}]
    assert sql(root, "SELECT count(*) AS n FROM artifacts WHERE kind = 'table'") == [{"n": 0}]


def test_another_file_in_the_same_archive_is_read_again(tmp_path: Path) -> None:
    members = packed(("a.csv", ROWS), ("b.csv", b"t,v\n1,7\n"))
    root = project(tmp_path / "p", [[("out.zip", members)]], '[outputs.o]\nfile = "out.zip/a.csv"\n')
    run(root, "population_size=1")
    config = root / "sierra.toml"
    config.write_text(config.read_text().replace("a.csv", "b.csv"))
    run(root, "population_size=1")
    assert sql(root, "SELECT v FROM o") == [{"v": 7}]


def test_init_declares_what_is_in_an_archive(tmp_path: Path) -> None:
    make(tmp_path / "p", simulator=STAMPED)
    (tmp_path / "p/sierra.toml").unlink()
    done = quick(tmp_path / "p", "init", "--yes", "--command", "python3 sim.py {input}")
    assert done.returncode == 0, done.stdout + done.stderr
    assert 'file = "out.zip/data/results.csv"' in (tmp_path / "p/sierra.toml").read_text()


def test_only_whole_patterns_choose_members_and_no_glob_those_of_macos(tmp_path: Path) -> None:
    members = packed(("inner.zip", ZIP), ("data.csv", ROWS), ("a/._data.csv", b"\0"), ("__MACOSX/data.csv", b"\0"))
    root = project(tmp_path / "p", [[("out.zip", members)]], '[outputs.o]\nfile = "*.zip/*data.csv"\n')
    run(root, "population_size=1")
    assert sql(root, "SELECT DISTINCT file FROM o") == [{"file": "out.zip/data.csv"}]


def test_executions_whose_archives_need_space_are_read_one_after_the_other(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(archives, "AT_A_TIME", 1)
    root = project(tmp_path / "p", [[("out.zip", ZIP)]] * 3, '[outputs.o]\nfile = "out.zip/results.csv"\n')
    assert quick(root, "run", "population_size=1:3:3", "--no-figures").returncode == 0
    assert sql(root, "SELECT count(DISTINCT run) AS runs, count(*) AS n FROM o") == [{"runs": 3, "n": 6}]
    config = root / "sierra.toml"
    config.write_text(config.read_text().replace("results.csv", "*.csv"))
    assert quick(root, "run", "population_size=1:3:3", "--no-figures").returncode == 0
    assert sql(root, "SELECT count(DISTINCT run) AS runs, count(*) AS n FROM o WHERE file IS NOT NULL") == [{"runs": 3, "n": 6}]
    assert quick(root, "fsck").returncode == 0


def test_lack_of_space_ends_the_command_and_fails_no_run(tmp_path: Path) -> None:
    large = packed((NAME, b"t,v\n" + b"1,10\n" * (1 << 22)), method=zipfile.ZIP_DEFLATED)
    root = project(tmp_path / "p", [[("out.zip", large)]], '[outputs.o]\nfile = "out.zip/results.csv"\n')
    small = ("prlimit", f"--fsize={1 << 24}", SIERRA, "run", "population_size=1", "--no-figures")
    done = subprocess.run(small, cwd=root, capture_output=True, text=True, env=os.environ | {"TMPDIR": str(tmp_path)})
    assert done.returncode == 3, done.stderr
    assert f"cannot write to {tmp_path}/{archives.FOLDER}" in done.stderr
    assert done.stderr.strip().endswith(": File too large")
    assert quick(root, "run", "population_size=1", "--no-figures").returncode == 0
    assert sql(root, "SELECT status FROM executions") == [{"status": "ok"}]


def test_errors_of_the_disk_are_no_damage() -> None:
    with archives.open_archive(Path("/proc/self/mem")) as file, pytest.raises(Missing, match="cannot read /proc/self/mem: "):
        list(archives.members(file, "out.tar.gz", 1))


def test_what_a_killed_process_has_unpacked_is_removed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    kill = "import os, sierra.ingest.archives as a; u = a.Unpacking({}); u.__enter__(); os._exit(9)"
    subprocess.run((sys.executable, "-c", kill), env=os.environ | {"TMPDIR": str(tmp_path)})
    assert list(tmp_path.glob(f"{archives.FOLDER}*"))
    with archives.Unpacking({}):
        assert len(list(tmp_path.glob(f"{archives.FOLDER}*"))) == 1
    assert not list(tmp_path.iterdir())


def test_names_that_no_pattern_fits_are_not_proposed_and_folders_are_no_archives(tmp_path: Path) -> None:
    files = [("w.zip", packed(("br{x}.csv", ROWS), ("._r.csv", b"\0"))), ("d/br{x}.csv", ROWS), ("dir.zip/a.csv", ROWS)]
    root = project(tmp_path / "p", [files], "")
    run(root, "population_size=1")
    shown = quick(root, "outputs").stdout
    assert "not a table: d/br{x}.csv" in shown
    assert "cannot name it, because of the braces" in shown
    assert "in an archive" not in shown
    assert quick(root, "outputs", "--write").returncode == 0
    assert "br{x}" not in (root / "sierra.toml").read_text()
    assert 'file = "dir.zip/a.csv"' in (root / "sierra.toml").read_text()
    run(root, "population_size=1")
