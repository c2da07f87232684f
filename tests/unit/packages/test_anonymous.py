"""An anonymous package shows nobody and no machine, and is otherwise an ordinary package."""

from __future__ import annotations

import base64
import gzip
import json
import socket
import subprocess
import sys
import tomllib
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path

import duckdb
import pytest

import sierra
from sierra.config.package_table import Package
from sierra.errors import ConfigError, Identifying, UsageError
from sierra.packages.anonymity.anonymous import anonymous, without_authors
from tests import projects
from tests.unit.packages.test_content_search import item, jpeg, pdf, png, segment, video, zipped

PACKAGE = """
[package]
title = "Coverage of a swarm"
description = \"\"\"
Text
[with a line like a header]
\"\"\"
authors = [
  { name = "Jane Doe", orcid = "0000-0002-1825-0097", affiliation = "Example University", ror = "https://ror.org/017zqws13" },
]
license = "MIT"
keywords = ["swarm", "quote \\" and \\\\"]
repository = "https://github.com/janelab/swarm"
[[package.related]]
identifier = "10.5555/12345678"
[[package.data]]
name = "map.bin"
url = "https://data.example/map.bin"
sha256 = "aaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaa"
"""
WORDS = ("Jane", "janelab", "Example University", "0000-0002-1825-0097", "017zqws13", "5555/12345678", "jane@example.org")
SIMULATOR = (
    projects.SIMULATOR
    + """
import datetime, os, time
with open("more.csv", "w") as file:
    print("who,n", file=file)
    print(f"robot {seed},1", file=file)
print("ready")
time.sleep(0.1)
"""
)


@pytest.mark.parametrize("prefix", ["", "tool.sierra."])
def test_authors_are_removed_from_the_file_and_all_else_stays(prefix: str) -> None:
    tables = PACKAGE.replace("[package", f"[{prefix}package")
    text = f'# a comment\n[{prefix}limits]\nwall = "1 h"\n{tables}\n[{prefix}sql]\nwall = "1 s"  # stays\n'
    package = Package.model_validate(tomllib.loads(PACKAGE)["package"])
    made = without_authors(text, anonymous(package), in_tool=bool(prefix))
    assert "# a comment" in made
    assert "# stays" in made
    assert not [word for word in WORDS if word in made]
    settings = tomllib.loads(made)["tool"]["sierra"] if prefix else tomllib.loads(made)
    assert settings["limits"] == {"wall": "1 h"}
    assert Package.model_validate(settings["package"]) == anonymous(package)


@pytest.mark.parametrize(
    "text",
    [
        'package = { title = "x", authors = [{ name = "Jane Doe" }] }\n',
        'package.title = "x"\npackage.authors = [{ name = "Jane Doe" }]\n',
    ],
)
def test_a_description_that_is_no_table_of_its_own_is_refused(text: str) -> None:
    with pytest.raises(ConfigError, match="must be a table of its own"):
        without_authors(text, anonymous(Package(title="x", license="MIT")), in_tool=False)


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A project in a folder that names its author, in git with a remote, with an own citation, a dirty batch, and a replay."""
    folder = tmp_path_factory.mktemp("home") / "janelab" / "study"
    config = projects.CONFIG + '[environment]\nrecord = ["WHERE"]\n' + PACKAGE
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("WHERE", str(folder))
        patch.setenv("TZ", "America/New_York")
        patch.setenv("GIT_AUTHOR_NAME", "Jane Doe")
        patch.setenv("GIT_AUTHOR_EMAIL", "jane@example.org")
        projects.make(folder, config, simulator=SIMULATOR)
        (folder / "CITATION.cff").write_text("authors: [{family-names: Doe, given-names: Jane}]\n")
        (folder / "LICENSE").write_text("Copyright Jane Doe\n")
        projects.commit(folder, "Jane's first commit")
        subprocess.run(["git", "remote", "add", "origin", "git@github.com:janelab/swarm.git"], cwd=folder, check=True)
        project = sierra.open(folder)
        batch = project.run("population_size=1,2", runs=2, figures=False).batch
        (folder / "sim.py").write_text(f"{SIMULATOR}# dirty\n")
        project.run("population_size=3", runs=1, figures=False)
        project.replay(batch, runs=1)
        yield folder


def contents(package: Path) -> Iterator[tuple[str, bytes]]:
    """Yield all that can be read in a package: the file, names, members, and values in Parquet files as DuckDB reads them.

    SIERRA's own wheel is left out: the examples in its code have names too.
    """
    yield "the file", package.read_bytes()
    with zipfile.ZipFile(package) as file:
        for name in file.namelist():
            content = file.read(name)
            yield f"name {name}", name.encode()
            yield from [(name, content)] if not name.startswith("environment/sierra/") else []
            if name.endswith(".parquet"):
                yield from values(name, content, package.with_suffix(".parquet"))


def values(name: str, content: bytes, path: Path) -> Iterator[tuple[str, bytes]]:
    path.write_bytes(content)
    columns = duckdb.execute(f"DESCRIBE SELECT * FROM '{path}'").fetchall()
    texts = ", ".join(f'"{column}"' + "" * (kind == "BLOB") + "::VARCHAR" * (kind != "BLOB") for column, kind, *_ in columns)
    for row in duckdb.execute(f"SELECT {texts} FROM '{path}'").fetchall():
        for value in row:
            yield name, value if isinstance(value, bytes) else str(value).encode()


@pytest.mark.integration
def test_an_anonymous_package_shows_nobody_and_works_as_others_do(root: Path, tmp_path: Path) -> None:
    project = sierra.open(root)
    ids = [one.batch for one in project.batches]
    packed = project.packages.pack(*ids, report=False, path=tmp_path / "one.zip", anonymous=True)
    assert packed is not None
    assert any("Jane Doe" in word for word in packed.preview.searched)
    commit = subprocess.run(["git", "rev-parse", "HEAD"], cwd=root, check=True, capture_output=True, text=True).stdout.strip()
    [month] = project.sql("SELECT strftime(min(started), '%Y-%m-') AS month FROM executions").to_pylist()
    words = (*WORDS, "New_York", str(root.parent), commit[:12], str(Path(sys.executable).parent), month["month"])
    host = socket.gethostname()
    words += (host,) if len(host) > 4 else ()
    seen = [
        (name, word)
        for name, content in contents(tmp_path / "one.zip")
        for word in words
        if word.lower().encode() in content.lower()
    ]
    assert seen == []
    sierra.open(root).packages.pack(*ids, report=False, path=tmp_path / "two.zip", anonymous=True)
    assert (tmp_path / "one.zip").read_bytes() == (tmp_path / "two.zip").read_bytes()
    with zipfile.ZipFile(tmp_path / "one.zip") as file:
        file.extractall(tmp_path / "one")
        described = json.loads(file.read("package.json"))
    assert (described["redacted"], described["date"]) == (True, "2000-01-01")
    assert [source["commit"] for source in described["sources"]] == [None, None]
    assert not (tmp_path / "one/project/CITATION.cff").exists()
    said = subprocess.run(
        [sys.executable, "-I", tmp_path / "one/reproduce.py"], capture_output=True, text=True, check=True
    ).stdout
    assert "redacted: for double-blind review" in said
    other = sierra.open(tmp_path / "one/project")
    assert other.maintenance.fsck().sound
    assert [one.batch for one in other.batches] == ids
    same = (
        "SELECT run, result, wall_s, seed, epoch_us(ended) - epoch_us(started) AS took "
        "FROM executions JOIN runs USING (run) ORDER BY ALL"
    )
    assert other.sql(same).to_pylist() == project.sql(same).to_pylist()
    assert (
        other.sql("SELECT * FROM swarm ORDER BY ALL").to_pylist() == project.sql("SELECT * FROM swarm ORDER BY ALL").to_pylist()
    )
    unmarked = "SELECT session FROM executions ANTI JOIN redactions USING (session, batch)"
    assert other.sql(unmarked).to_pylist() == []
    assert len(project.sql(unmarked).to_pylist()) == 7
    assert {row["host"] for row in other.sql("SELECT host FROM executions").to_pylist()} == {"host-1"}
    assert other.replay(ids[0], runs=1).verdict == "identical"
    assert other.packages.pack(*ids, report=False, path=tmp_path / "again.zip", anonymous=True) is not None
    assert other.maintenance.fsck().sound
    assert projects.quick(other.root, "rm", ids[0], "--yes").returncode == 0
    assert sierra.open(other.root).maintenance.fsck().sound
    assert {row["batch"] for row in other.sql("SELECT batch FROM redactions").to_pylist()} == {ids[1]}
    answer = projects.quick(tmp_path, "open", "one.zip")
    assert "anonymous: hosts, folders" in answer.stdout


@pytest.mark.integration
def test_a_name_anywhere_stops_the_command_with_its_place_unless_it_is_accepted(tmp_path: Path) -> None:
    root = projects.make(tmp_path / "project", projects.CONFIG + PACKAGE)
    code = """
import gzip, os
print("called by Jane Doe")
gzip.open("raw.gz", "wt").write("at Example University")
open("more.csv", "w").write("n,who\\n1,nobody\\n2,JANELAB\\n")
"""
    (root / "sim.py").write_text(f"# by jane_doe\n{projects.SIMULATOR}{code}")
    batch = sierra.open(root).run("population_size=1", runs=1, figures=False).batch
    ended = projects.quick(root, "package", batch, "--no-report", "-o", "../x.zip", "--anonymous")
    places = ended.stderr.splitlines()
    assert ended.returncode == 2
    assert not (tmp_path / "x.zip").exists()
    run = sierra.open(root).sql("SELECT run FROM runs").to_pylist()[0]["run"][:10]
    for place in (
        "project/sim.py, line 1 and 1 more: 'jane_doe' (author)",
        f"(stdout of run {run}), line 1: 'Jane Doe' (author)",
        f"(output raw.gz of run {run}) (decompressed), line 1: 'Example University' (affiliation)",
        "output.1.parquet (table more), column who, row 2: 'JANELAB' (owner of a repository)",
    ):
        assert [line for line in places if line.endswith(place)], (place, places)
    assert "places in the package would show who made it, as project/sim.py, line 1" in places[-1]
    with pytest.raises(Identifying, match="Example University") as caught:
        sierra.open(root).packages.pack(
            batch, report=False, path=tmp_path / "x.zip", anonymous=True, allow=["jane_doe", "by Jane Doe", "JaneLab"]
        )
    assert all("Example University" in place for place in caught.value.places)
    accepted = [word for text in ("doe", "jane doe", "jane_doe", "janelab", "Example University") for word in ("--allow", text)]
    assert projects.quick(root, "package", batch, "--no-report", "-o", "../x.zip", "--anonymous", *accepted).returncode == 0
    with pytest.raises(UsageError, match="add --anonymous"):
        sierra.open(root).packages.pack(batch, report=False, path=tmp_path / "y.zip", allow=["x"])


@pytest.mark.integration
def test_names_in_pictures_videos_and_archives_are_shown_with_their_places(tmp_path: Path) -> None:
    config = projects.CONFIG + PACKAGE.replace("authors = [", 'authors = [\n  { name = "Ann Vu" },')
    root = projects.make(tmp_path / "project", config)
    files = {
        "a.png": png(b"tEXt", b"Author\0Jane Doe"),
        "b.png": png(b"IDAT", zlib.compress(b" by Jane Vu \n" * 9, 0)),
        "c.mp4": video(item(b"Ann Vu")),
        "d.mp4": video(frames=b" by Ann Vu \1\2\3" * 9),
        "e.pdf": pdf(b"/Filter /FlateDecode", zlib.compress(b"BT [(Jane D)9(oe)]TJ ET")),
        "f.zip": zipped(b"1\n2\nby Ann Vu\n", "docs/readme.txt"),
        "g.svg": b"<svg>\n<image href='data:image/png;base64,"
        + base64.b64encode(png(b"iTXt", b"A\0\0\0\0\0Jane Doe"))
        + b"'/>",
        "h.txt": b"vue, Vu2, d\xc3\xa9ja vus",
        "i.jpg": jpeg(segment(0xFE, b"Vu"))[:-9],
        "j.gz": gzip.compress(b"Jane Doe" * 99)[:-9],
    }
    for name, content in files.items():
        (root / name).write_bytes(content)
    batch = sierra.open(root).run("population_size=1", runs=1, figures=False).batch
    ended = projects.quick(root, "package", batch, "--no-report", "-o", "../x.zip", "--anonymous", "--yes")
    assert ended.returncode == 2
    assert [line for line in ended.stderr.splitlines() if line.startswith("project/") and "/.sierra/" not in line] == [
        "project/a.png: tEXt chunk \"Author\": 'Jane Doe' (author)",
        "project/c.mp4: box moov/udta/meta/ilst/\xa9ART/data: 'Ann Vu' (author)",
        "project/e.pdf: object 7: 'Jane Doe' (author)",
        "project/f.zip: docs/readme.txt, line 3: 'Ann Vu' (author)",
        "project/g.svg, line 2, base64: iTXt chunk \"A\": 'Jane Doe' (author)",
        "project/i.jpg: comment: 'Vu' (author)",
        "project/j.gz (decompressed), line 1 and 98 more: 'Jane Doe' (author)",
    ]
    for name in ("a.png", "c.mp4", "e.pdf", "f.zip", "g.svg"):
        (root / name).unlink()
    (root / "i.jpg").write_bytes(jpeg()[:-9])
    (root / "j.gz").write_bytes(gzip.compress(b"nobody" * 99)[:-9])
    batch = sierra.open(root).run("population_size=1", runs=1, figures=False).batch
    ended = projects.quick(root, "package", batch, "--no-report", "-o", "../x.zip", "--anonymous")
    assert (ended.returncode, (tmp_path / "x.zip").exists()) == (2, False)
    for said in ("project/i.jpg: a segment is cut off", "project/j.gz: its compressed data are cut off"):
        assert f"not all of it can be searched for names: {said}" in ended.stderr
    assert projects.quick(root, "package", batch, "--no-report", "-o", "../x.zip", "--anonymous", "--yes").returncode == 0
