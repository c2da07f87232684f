"""Recorded files are listed and exported: unchanged, only into the target folder, without overwriting."""

from __future__ import annotations

import hashlib
import json
import random
import subprocess
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from sierra.store import recorded_files
from sierra.store.objects import Objects
from sierra.store.recorded_files import ChosenExecution, FileContent
from sierra.store.store import Store
from tests import projects
from tests.projects import make, quick

SIMULATOR = """\
import os, pathlib, sys
import xml.etree.ElementTree as ET

arena = ET.parse(sys.argv[1]).getroot()
count = int(arena.find("swarm").get("count"))
seed = int(arena.find("random").get("seed"))
print("said", seed)
print("complained", file=sys.stderr)
if count > 90:
    sys.exit(3 if count < 95 else 4)
rows = "".join(f"{tick},{tick / 3!r},{seed}\\n" for tick in range(50))
pathlib.Path("swarm.csv").write_text("tick,run,Cover age\\n" + rows)
pathlib.Path("odd.csv").write_text("a,b\\n1.50,x\\n2.25,\\n")
pathlib.Path("said.jsonl").write_text('{"text": "a \\\\"quoted\\\\", one", "n": 1}\\n{"text": "", "n": null}\\n')
pathlib.Path("deep/er").mkdir(parents=True)
pathlib.Path("deep/er/a \\n'b\\u00e9").write_bytes(bytes(range(256)))
pathlib.Path("empty").touch()
if os.environ.get("GREAT"):
    with open("great", "wb") as file:
        for part in range(20):
            file.write(bytes([part]) * (1 << 20))
"""
DROPPED = projects.CONFIG + "[store]\nraw = false\n"
"""Tables are stored only as rows."""
HOSTILE = "deep/er/a \n'bé"
INPUT, STDOUT = "input/input.xml", "stdout"


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a project with a batch of two experiments of two runs; tests only read it."""
    folder = make(tmp_path_factory.mktemp("files") / "project", simulator=SIMULATOR)
    assert quick(folder, "run", "noise=0:1:2", "--no-figures").returncode == 0
    return folder


def rows(folder: Path, text: str) -> list[dict[str, Any]]:
    return Store(folder / ".sierra").rows(text)


def batch_of(folder: Path) -> str:
    return str(rows(folder, "SELECT batch FROM batches ORDER BY created DESC LIMIT 1")[0]["batch"])


def first_run(folder: Path) -> dict[str, Any]:
    return rows(folder, "SELECT run, seed FROM batch_runs JOIN batches USING (batch) ORDER BY created DESC, ordinal, number")[0]


def listed(folder: Path, *words: str) -> list[dict[str, Any]]:
    """Return all files of all runs with the fields of their runs."""
    runs = json.loads(quick(folder, "files", *words, "--json").stdout)["runs"]
    return [{**run, **file} for run in runs for file in run["files"]]


def written(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def refused(ended: subprocess.CompletedProcess[str], code: int, *said: str) -> None:
    assert (ended.returncode, ended.stdout, ended.stderr.count("\n")) == (code, "", 1)
    assert all(text in ended.stderr for text in said)


# the listing


@pytest.mark.integration
def test_files_of_a_run_are_listed_with_kind_size_and_hash(project: Path) -> None:
    run = first_run(project)["run"]
    files = {file["path"]: file for file in listed(project, run)}
    assert {path: file["kind"] for path, file in files.items()} == {
        INPUT: "input",
        "output/swarm.csv": "table",
        "output/odd.csv": "table",
        "output/said.jsonl": "table",
        "output/empty": "file",
        "output/" + HOSTILE: "file",
        "stdout": "log",
        "stderr": "log",
    }
    hostile = files["output/" + HOSTILE]
    assert (hostile["bytes"], hostile["sha256"]) == (256, hashlib.sha256(bytes(range(256))).hexdigest())
    assert not any(file["remark"] for file in files.values())
    assert {(file["number"], file["which"], file["status"]) for file in files.values()} == {(0, "counts", "ok")}
    said = quick(project, "files", run[:12]).stdout
    assert ", the effective one" in said
    assert "\\n'bé" in said  # a line feed in a name is escaped


@pytest.mark.parametrize(("kind", "runs"), [("batch", 4), ("experiment", 2), ("run", 1), ("execution", 1)])
def test_files_of_a_batch_experiment_run_or_execution_are_listed(project: Path, kind: str, runs: int) -> None:
    table = {"batch": "batches", "experiment": "experiments", "run": "runs", "execution": "executions"}[kind]
    identity = rows(project, f"SELECT min({kind}) AS id FROM {table}")[0]["id"]
    files = listed(project, identity)
    assert len({(file["experiment"], file["number"]) for file in files}) == runs
    assert len(files) == 8 * runs
    assert len(quick(project, "files", identity).stdout.splitlines()) >= len(files)


# one file


@pytest.mark.nightly
@pytest.mark.integration
def test_one_file_is_written_to_standard_output_byte_for_byte(project: Path) -> None:
    run = first_run(project)
    from tests.projects import SIERRA

    said = subprocess.run([SIERRA, "files", run["run"], HOSTILE], cwd=project, capture_output=True, check=True)
    assert (said.stdout, said.stderr) == (bytes(range(256)), b"")
    assert quick(project, "files", run["run"], STDOUT).stdout == f"said {run['seed']}\n"
    assert quick(project, "files", run["run"], "output/empty").stdout == ""
    assert f'seed="{run["seed"]}"' in quick(project, "files", run["run"], "input.xml").stdout


def test_a_file_that_became_a_table_is_exported_byte_for_byte(project: Path) -> None:
    run = first_run(project)
    ended = quick(project, "files", run["run"], "swarm.csv")
    expected = "tick,run,Cover age\n" + "".join(f"{tick},{tick / 3!r},{run['seed']}\n" for tick in range(50))
    assert (ended.stdout, ended.stderr) == (expected, "")


@pytest.mark.integration
def test_a_table_whose_bytes_were_dropped_is_listed_and_not_exported(tmp_path: Path) -> None:
    folder = make(tmp_path / "project", DROPPED, simulator=SIMULATOR)
    assert quick(folder, "run", "population_size=1", "--runs", "1", "--no-figures").returncode == 0
    run = first_run(folder)["run"]
    remark = "not in the store, which has its rows: table swarm"
    files = {file["path"]: file["remark"] for file in listed(folder, run)}
    assert files["output/swarm.csv"] == remark
    assert {path for path, said in files.items() if not said} == {INPUT, STDOUT, "stderr", "output/empty", "output/" + HOSTILE}
    refused(quick(folder, "files", run, "swarm.csv"), 1, f"output/swarm.csv: {remark}")
    ended = quick(folder, "files", run, "--to", str(tmp_path / "out"))
    assert (ended.returncode, ended.stderr) == (0, "")
    assert "5 files of 1 run" in ended.stdout
    assert "3 tables not written: the store has only their rows (sierra sql)" in ended.stdout
    assert len(written(tmp_path / "out")) == 5
    ended = quick(folder, "files", run, "swarm.csv", "--to", str(tmp_path / "other"), "--json")
    assert (ended.returncode, remark in ended.stderr) == (1, True)
    told = json.loads(ended.stdout)
    [file] = told["runs"][0]["files"]
    assert (file["written"], file["failure"], file["identical"]) == (None, remark, None)


@pytest.mark.nightly
@pytest.mark.integration
def test_a_listed_path_selects_only_that_file(tmp_path: Path) -> None:
    simulator = "open('stdout', 'w').write('mine'); open('a[b]', 'w').write('brackets'); print('log')\n"
    folder = make(tmp_path / "project", simulator=simulator)
    assert quick(folder, "run", "population_size=1", "--runs", "1", "--no-figures").returncode == 0
    run = first_run(folder)["run"]
    for path, content in (("stdout", "log\n"), ("output/stdout", "mine"), ("output/a[b]", "brackets"), ("a[b]", "brackets")):
        assert quick(folder, "files", run, path).stdout == content


@pytest.mark.nightly
@pytest.mark.integration
def test_paths_that_match_no_file_or_several_are_reported(project: Path) -> None:
    run = first_run(project)["run"]
    refused(quick(project, "files", run, "nope.csv"), 2, "no recorded file 'nope.csv'", "'output/swarm.csv'")
    refused(quick(project, "files", run, "*.csv"), 2, "2 files", "--to FOLDER")
    refused(quick(project, "files", batch_of(project), STDOUT), 2, "4 files match")
    refused(quick(project, "files", "0000000"), 2, "no batch, experiment, run, execution or study")


# a folder


def test_a_batch_is_exported_into_folders_by_experiment_and_number(project: Path, tmp_path: Path) -> None:
    ended = quick(project, "files", batch_of(project), "--to", str(tmp_path / "new" / "out"))
    assert (ended.returncode, ended.stderr) == (0, "")
    assert "32 files of 4 runs" in ended.stdout
    found = written(tmp_path / "new" / "out")
    for file in listed(project, batch_of(project)):
        content = found.pop(f"{file['experiment'][:10]}/{file['number']}/{file['path']}")
        assert hashlib.sha256(content).hexdigest() == file["sha256"]
    assert found == {}


@pytest.mark.nightly
@pytest.mark.integration
def test_all_files_of_one_table_and_of_a_run_in_two_experiments_are_exported(tmp_path: Path) -> None:
    simulator = (
        "import pathlib\n"
        "for part in range(3):\n"
        "    pathlib.Path(f'part-{part}.csv').write_text(f'file,n\\na,{part}\\n' * 1 + f'b,{part}\\n' * part)\n"
    )
    config = projects.CONFIG + '[outputs.parts]\nfile = "part-*.csv"\n[scenarios.a]\n[scenarios.b]\n'
    folder = make(tmp_path / "project", config, simulator=simulator)
    assert quick(folder, "run", "scenario=a,b", "--runs", "1", "--no-figures").returncode == 0
    assert len(rows(folder, "FROM executions")) == 1
    ended = quick(folder, "files", batch_of(folder), "output/*", "--to", str(tmp_path / "out"))
    assert "6 files of 2 runs" in ended.stdout
    experiments = {path.name for path in (tmp_path / "out").iterdir()}
    assert len(experiments) == 2
    for experiment in experiments:
        output = tmp_path / "out" / experiment / "0" / "output"
        assert [(output / f"part-{part}.csv").read_text().count("\n") for part in range(3)] == [2, 3, 4]


def test_only_files_that_match_the_patterns_are_exported(project: Path, tmp_path: Path) -> None:
    ended = quick(project, "files", batch_of(project), "swarm.csv", "std*", "--to", str(tmp_path / "out"), "--json")
    assert ended.returncode == 0
    told = json.loads(ended.stdout)
    files = [file for run in told["runs"] for file in run["files"]]
    assert {file["path"] for file in files} == {"output/swarm.csv", "stdout", "stderr"}
    assert all(file["identical"] and not file["failure"] for file in files)
    assert {file["written"] for file in files} == set(written(tmp_path / "out"))


def test_existing_files_are_not_overwritten_and_all_others_are_exported(project: Path, tmp_path: Path) -> None:
    first = listed(project, batch_of(project))[0]
    place = tmp_path / first["experiment"][:10] / "0"
    (place / "output").mkdir(parents=True)
    (place / "output" / "empty").write_text("mine")
    (place / STDOUT).symlink_to(tmp_path / "elsewhere")
    ended = quick(project, "files", batch_of(project), "--to", str(tmp_path))
    assert ended.returncode == 1
    assert "30 files of 4 runs" in ended.stdout
    assert sorted(ended.stderr.splitlines()) == [
        f"sierra: {first['experiment'][:10]}/0/{name}: a file or folder of that name exists already, and is not overwritten"
        for name in ("output/empty", "stdout")
    ]
    assert (place / "output" / "empty").read_text() == "mine"
    assert not (tmp_path / "elsewhere").exists()
    assert not list(tmp_path.rglob(".sierra-*"))


def test_a_link_in_the_target_folder_is_not_followed(project: Path, tmp_path: Path) -> None:
    run, elsewhere = first_run(project)["run"], tmp_path / "elsewhere"
    elsewhere.mkdir()
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / listed(project, run)[0]["experiment"][:10]).symlink_to(elsewhere)
    ended = quick(project, "files", run, "--to", str(tmp_path / "out"))
    assert ended.returncode == 1
    assert ended.stderr.count("is a symbolic link, and links are not followed") == 8
    assert list(elsewhere.iterdir()) == []


@pytest.mark.integration
def test_paths_of_a_hostile_record_stay_in_the_target_folder(tmp_path: Path) -> None:
    folder = make(tmp_path / "project")
    assert quick(folder, "run", "population_size=1", "--runs", "1", "--no-figures").returncode == 0
    [one] = rows(folder, "SELECT execution, run, batch FROM executions")
    store = Store(folder / ".sierra")
    bad = ("../../../../stolen", str(tmp_path / "stolen"), "..", ".", "", "a/../../../../../stolen", "a\0b", "x" * 300)
    writer = store.writer(store.paths.work / "forged", one["batch"])
    digest = hashlib.sha256(b"forged").hexdigest()
    row = {"execution": one["execution"], "run": one["run"], "kind": "file", "size": 6, "sha256": digest}
    writer.rows("artifacts", [{**row, "path": path} for path in (*bad, "good")])
    writer.rows("objects", [{"sha256": digest, "part": 0, "size": 6, "content": b"forged"}])
    store.publish(writer)
    ended = quick(folder, "files", one["run"], "--to", str(tmp_path / "out" / "deep"))
    assert (ended.returncode, ended.stderr.count("\n")) == (1, len(bad))
    assert ended.stderr.count("leads outside the folder") == len(bad) - 1
    [good] = [path for path in tmp_path.rglob("*") if path.is_file() and path.read_bytes() == b"forged"]
    assert good.relative_to(tmp_path / "out" / "deep").parts[1:] == ("0", "output", "good")


def test_an_export_into_the_store_is_refused(project: Path) -> None:
    refused(quick(project, "files", batch_of(project), "--to", ".sierra/segments/x"), 2, "is in the store itself")
    assert not (project / ".sierra" / "segments" / "x").exists()


def test_a_target_folder_that_is_part_of_the_source_gets_a_note(project: Path) -> None:
    ended = quick(project, "files", first_run(project)["run"], "empty", "--to", "shown")
    assert (ended.returncode, ended.stderr.count("\n")) == (0, 1)
    assert "note: shown is in the project, and changes its source" in ended.stderr


# damaged, truncated, failed and large files


def _damage(folder: Path, digest: str) -> None:
    """Change a byte of one object, as a faulty disk does."""
    for path in folder.glob(".sierra/segments/*/objects.parquet"):
        table = pq.read_table(path)
        contents = [
            content[:-1] + b"\0" if name == digest else content
            for name, content in zip(table["sha256"].to_pylist(), table["content"].to_pylist(), strict=True)
        ]
        pq.write_table(table.set_column(3, table.schema.field(3), pa.array(contents, table.schema.field(3).type)), path)


@pytest.mark.integration
def test_a_damaged_file_is_reported_and_all_others_are_exported(tmp_path: Path) -> None:
    folder = make(tmp_path / "project", simulator=SIMULATOR)
    assert quick(folder, "run", "population_size=1", "--no-figures").returncode == 0
    run = first_run(folder)["run"]
    digest = next(file["sha256"] for file in listed(folder, run) if file["path"] == STDOUT)
    _damage(folder, digest)
    ended = quick(folder, "files", batch_of(folder), "--to", str(tmp_path / "out"))
    assert (ended.returncode, ended.stderr.count("\n")) == (1, 1)
    assert f"/0/stdout: its content in the store differs from the record (SHA-256 {digest})" in ended.stderr
    assert "15 files of 2 runs" in ended.stdout
    assert len(written(tmp_path / "out")) == 15
    refused(quick(folder, "files", run, STDOUT), 1, "stdout: its content in the store differs from the record")


@pytest.mark.integration
def test_bytes_that_a_damaged_store_lacks_are_not_taken_for_dropped_ones(tmp_path: Path) -> None:
    folder = make(tmp_path / "project", simulator=SIMULATOR)
    assert quick(folder, "run", "population_size=1", "--no-figures").returncode == 0
    [digest, *_] = [file["sha256"] for file in listed(folder, first_run(folder)["run"]) if file["path"] == "output/swarm.csv"]
    for path in folder.glob(".sierra/segments/*/objects.parquet"):
        table = pq.read_table(path)
        pq.write_table(table.filter(pa.array([name != digest for name in table["sha256"].to_pylist()])), path)
    ended = quick(folder, "files", batch_of(folder), "--to", str(tmp_path / "out"))
    assert ended.returncode == 1
    assert "objects.parquet has other bytes than SIERRA wrote" in ended.stderr


@pytest.mark.nightly
@pytest.mark.integration
def test_a_store_that_cannot_be_read_is_reported_in_one_line(tmp_path: Path) -> None:
    folder = make(tmp_path / "project")
    assert quick(folder, "run", "population_size=1", "--runs", "1", "--no-figures").returncode == 0
    run = first_run(folder)["run"]
    for path in folder.glob(".sierra/segments/*/artifacts.parquet"):
        path.write_bytes(b"nothing")
    refused(quick(folder, "files", run), 1, "artifacts.parquet has other bytes than SIERRA wrote", "run sierra fsck")


@pytest.mark.nightly
@pytest.mark.integration
def test_files_of_a_failed_run_come_from_its_last_execution(tmp_path: Path) -> None:
    folder = make(tmp_path / "project", simulator=SIMULATOR)
    for _ in range(2):
        assert quick(folder, "run", "population_size=91", "--runs", "1", "--no-figures").returncode == 1
    run = first_run(folder)["run"]
    [last] = rows(folder, "SELECT arg_max(execution, ended) AS id FROM executions")
    assert {(file["execution"], file["which"]) for file in listed(folder, run)} == {(last["id"], "last")}
    ended = quick(folder, "files", run, "stderr")
    assert ended.stdout == "complained\n"
    assert f"execution {last['id'][:10]} (failed), the last one; none is effective" in ended.stderr
    [other] = rows(folder, "SELECT arg_min(execution, ended) AS id FROM executions")
    assert {file["execution"] for file in listed(folder, other["id"])} == {other["id"]}
    ended = quick(folder, "files", batch_of(folder), "--to", str(tmp_path / "out"))
    assert "1 run without an effective execution: files of the last execution" in ended.stdout


@pytest.mark.nightly
@pytest.mark.integration
def test_large_files_and_truncated_logs_are_exported(tmp_path: Path) -> None:
    simulator = SIMULATOR + "print('x' * 3_000_000)\n"
    folder = make(tmp_path / "project", projects.CONFIG + '[environment]\nset = { GREAT = "1" }\n', simulator=simulator)
    assert quick(folder, "run", "population_size=1", "--no-figures").returncode == 0
    ended = quick(folder, "files", batch_of(folder), "great", STDOUT, "--to", str(tmp_path / "out"))
    assert ended.returncode == 0
    assert "2 logs shortened when recorded" in ended.stdout
    great = list((tmp_path / "out").rglob("great"))
    assert len(great) == 2
    expected = b"".join(bytes([part]) * (1 << 20) for part in range(20))
    assert all(path.read_bytes() == expected for path in great)


# show


@pytest.mark.nightly
@pytest.mark.integration
def test_show_names_the_files_of_a_run_and_the_command_to_export_them(project: Path) -> None:
    run = first_run(project)["run"]
    said = quick(project, "show", run).stdout
    assert "output/swarm.csv" in said
    assert f"sierra show {run[:10]} --files" in said
    assert len(json.loads(quick(project, "show", run, "--json").stdout)["files"]) == 8


@pytest.mark.nightly
@pytest.mark.integration
def test_show_groups_failures_by_their_reason(tmp_path: Path) -> None:
    folder = make(tmp_path / "project", simulator=SIMULATOR)
    ask = ("run", "population_size=1,91,92,96", "--runs", "3", "--no-figures")
    assert quick(folder, *ask).returncode == 1
    said = quick(folder, "show", batch_of(folder))
    failing = rows(folder, "SELECT run FROM batch_runs WHERE number = 0 ORDER BY ordinal")
    assert f"\n  6 runs: exit status 3, e.g. run {failing[1]['run'][:10]} (population_size=91, number 0)\n" in said.stdout
    assert f"\n  3 runs: exit status 4, e.g. run {failing[3]['run'][:10]} (population_size=96, number 0)\n" in said.stdout
    failures = json.loads(quick(folder, "show", batch_of(folder), "--json").stdout)["failures"]
    assert [(failure["reason"], failure["runs"]) for failure in failures] == [("exit status 3", 6), ("exit status 4", 3)]


@pytest.mark.nightly
@pytest.mark.integration
def test_show_lists_at_most_ten_reasons(tmp_path: Path) -> None:
    simulator = "import os, sys\nsys.exit(1 + int(os.environ['SIERRA_SEED']) % 200)\n"
    folder = make(tmp_path / "project", simulator=simulator)
    assert quick(folder, "run", "population_size=1", "--runs", "30", "--no-figures").returncode == 1
    reasons = len(json.loads(quick(folder, "show", batch_of(folder), "--json").stdout)["failures"])
    assert reasons > 10
    said = quick(folder, "show", batch_of(folder)).stdout
    assert said.count(", e.g. run ") == 10
    assert f"and {reasons - 10} more reasons" in said


@pytest.mark.nightly
@pytest.mark.integration
def test_columns_of_axes_are_in_the_order_of_the_query(tmp_path: Path) -> None:
    folder = make(tmp_path / "project", simulator=SIMULATOR)
    for ask in (("noise=0,1", "population_size=1,2"), ("population_size=1,2", "noise=0,1")):
        ran = quick(folder, "run", *ask, "--runs", "1", "--no-figures").stdout
        names = [criterion.partition("=")[0] for criterion in ask]
        assert [*names, "runs", "succeeded", "failed"] in [line.split() for line in ran.splitlines()]
        shown = quick(folder, "show", batch_of(folder)).stdout
        assert ["ordinal", "experiment", *names, "runs", "succeeded", "accepted", "failed"] in [
            line.split() for line in shown.splitlines()
        ]


@pytest.mark.integration
@pytest.mark.parametrize("sizes", [(30_000,) * 800, (9 << 20, 100, 0, 5)])
def test_objects_are_read_in_any_order_with_little_memory(tmp_path: Path, sizes: tuple[int, ...]) -> None:
    """Readers have the compressed bytes of a row group in memory, which has up to 32 MiB, and only a few rows of it."""
    generator = random.Random(1)
    written = [generator.randbytes(size) for size in sizes]
    objects = Objects(tmp_path / "objects.parquet")
    digests = [objects.add(content) for content in written]
    objects.close()
    groups, most = recorded_files._Groups([str(tmp_path / "objects.parquet")]), 0
    groups.find(digests)
    begin = pa.total_allocated_bytes()
    for place in (*range(0, len(sizes), 7), *reversed(range(max(0, len(sizes) - 20), len(sizes)))):
        taken = ChosenExecution("", 0, 0, "", None, None, "counts")
        file = recorded_files.Recorded(taken, "f", "file", None, digests[place], sizes[place], None, None, None)
        assert b"".join(groups.pieces(FileContent(file, groups.pieces))) == written[place]
        most = max(most, pa.total_allocated_bytes() - begin)
    assert most < 64 << 20
