"""A received package is verified and executed again, its claims are decided by the new values, and it chooses nothing here."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import pytest

import sierra
from sierra.errors import Missing, UsageError
from sierra.packages import archive
from sierra.packages.members import MANIFEST
from sierra.packages.reproduction.planned import RecordedRun
from sierra.packages.reproduction.reproduce import untouched, within_budget
from sierra.packages.subject import Member
from tests import projects

PACKAGE = """
[package]
title = "Coverage of a swarm"
authors = [{ name = "Jane Doe" }]
license = "MIT"
"""
SQL = "SELECT max(coverage) {} AS holds, max(coverage) AS most FROM swarm"
SECRET = "SELECT count(*) > 0 FROM read_text('/etc/passwd')"
DRIFTING = projects.SIMULATOR.replace("import sys", "import sys, time").replace(
    "noise * (seed % 100), sep", "noise * (seed % 100) + time.time_ns() % 1000 * 1e-6, sep"
)
SLOW = projects.SIMULATOR.replace("import sys", "import sys, time\ntime.sleep(1)")
ALONE = ("unshare", "--user", "--map-user=1234", "--map-group=1234", "--net")


def claim(name: str, sql: str) -> str:
    query = 'query = "population_size=1,2"'
    return f'[claims.{name}]\nsays = "It is {name}."\npaper = "Fig. 1"\n{query}\nsql = "{sql}"\n'


def packed(folder: Path, claims: str, simulator: str = projects.SIMULATOR, config: str = projects.CONFIG) -> Path:
    """Return a package of a batch with two experiments of two runs; `{most}` in its claims is the recorded maximum."""
    root = projects.make(folder / "project", config + PACKAGE, simulator=simulator)
    project = sierra.open(root)
    batch = project.run("population_size=1,2", figures=False).batch
    [most] = project.sql("SELECT max(coverage) AS most FROM swarm").to_pylist()
    (root / "sierra.toml").write_text(config + PACKAGE + claims.replace("{most}", repr(most["most"])))
    sierra.open(root).packages.pack(batch, report=False, path=folder / "swarm.zip")
    shutil.rmtree(root)
    return folder / "swarm.zip"


@pytest.fixture(scope="module")
def package(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return packed(tmp_path_factory.mktemp("reproduction"), claim("exact", SQL.format("= {most}")) + claim("reading", SECRET))


def changed(package: Path, target: Path, change: Callable[[dict[str, bytes]], None]) -> Path:
    """Write a package with other members, whose hashes are right."""
    with zipfile.ZipFile(package) as file:
        members = {name: file.read(name) for name in file.namelist() if name != MANIFEST}
    change(members)
    archive.write(target, {name: Member(name, content, "") for name, content in members.items()})
    return target


def reproduce(folder: Path, *words: str) -> tuple[int, dict[str, Any]]:
    done = projects.quick(folder, "reproduce", *words, "--json")
    assert (done.stderr.count("\n") <= 1, "Traceback" in done.stderr) == (True, False), done.stderr
    return done.returncode, json.loads(done.stdout) if done.stdout else {"error": done.stderr}


@pytest.mark.integration
def test_a_package_is_reproduced_by_another_user_without_network_and_git(package: Path, tmp_path: Path) -> None:
    programs = tmp_path / "bin"
    programs.mkdir()
    for folder in os.environ["PATH"].split(os.pathsep):
        for program in Path(folder).glob("*") if Path(folder).is_dir() else ():
            if not program.name.startswith("git") and not (programs / program.name).exists():
                (programs / program.name).symlink_to(program)
    allowed = not subprocess.run([*ALONE, "true"], check=False, capture_output=True).returncode
    environment = {"PATH": str(programs), "HOME": str(tmp_path / "home"), "LANG": "C", "USER": "another"}
    words = ["reproduce", str(package), "--into", "some where", "--claim", "exact", "--yes", "--junit", "verdicts.xml"]
    done = subprocess.run(
        [*(ALONE if allowed else ()), str(projects.SIERRA), *words],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert "on this machine without a container: python3 {project}/sim.py {input}" in done.stderr
    assert "exact  holds" in done.stdout
    assert "re-executed (4 of 4 runs executed again)" in done.stdout
    said = json.loads((tmp_path / "some where" / "reproduction.json").read_text())
    assert (said["exit_code"], said["batches"][0]["counts"], said["claims"][0]["n"]) == (0, {"identical": 4}, 4)
    assert "**holds**" in (tmp_path / "some where" / "reproduction.md").read_text()
    suites = ET.parse(tmp_path / "verdicts.xml").getroot()  # noqa: S314 - SIERRA wrote it
    assert [(one.get("name"), one.get("tests")) for one in suites] == [
        ("population_size=1", "2"),
        ("population_size=2", "2"),
        ("claims", "1"),
    ]


@pytest.mark.integration
def test_nothing_is_executed_on_this_machine_without_consent(package: Path, tmp_path: Path) -> None:
    code, said = reproduce(tmp_path, str(package))
    assert (code, "use --yes if you trust the package" in said["error"], "sim.py" in said["error"]) == (3, True, True)
    copy = tmp_path / "swarm-reproduction" / "package" / "project"
    assert sierra.open(copy).sql("SELECT * FROM replays").num_rows == 0
    with pytest.raises(Missing, match="would not be isolated"):
        sierra.api.reproduce(package, into=tmp_path / "other")
    code, said = reproduce(tmp_path, str(package), "--engine", "podman", "--yes")
    assert (code, said["batches"][0]["reason"]) == (3, "it was executed without an image: leave out --engine podman")


@pytest.mark.integration
def test_variables_of_a_package_start_nothing_before_the_consent(tmp_path: Path) -> None:
    config = projects.CONFIG + '[environment]\nset = { PYTHONPATH = "{project}" }\n'
    root = projects.make(tmp_path / "project", config + PACKAGE + claim("any", SQL.format("> 0")))
    (root / "sitecustomize.py").write_text(f"open({str(tmp_path / 'started')!r}, 'w')")
    batch = sierra.open(root).run("population_size=1,2", figures=False).batch
    sierra.open(root).packages.pack(batch, report=False, path=tmp_path / "swarm.zip")
    (tmp_path / "started").unlink()
    assert reproduce(tmp_path, "swarm.zip")[0] == 3
    assert not (tmp_path / "started").exists()
    assert reproduce(tmp_path, "swarm.zip", "--yes")[0] == 0
    assert (tmp_path / "started").exists()


@pytest.mark.integration
def test_claims_are_decided_by_the_values_of_the_new_executions(tmp_path: Path) -> None:
    config = projects.CONFIG + '[equivalence.coverage]\ntable = "swarm"\ncolumn = "coverage"\nmargin = 0.1\n'
    claims = claim("exact", SQL.format("= {most}")) + claim("large", SQL.format("> 1"))
    package = packed(tmp_path, claims, DRIFTING, config)
    code, said = reproduce(tmp_path, str(package), "--yes")
    found = {one["name"]: (one["verdict"], one["ground"]) for one in said["claims"]}
    assert (code, said["verdict"], said["batches"][0]["verdict"]) == (
        1,
        "not reproduced: 1 of 2 claims not shown to hold",
        "equivalent",
    )
    assert found == {name: (verdict, "statistically re-executed") for name, verdict in VERDICTS.items()}
    assert reproduce(tmp_path, str(package), "--yes")[1]["claims"] == said["claims"]  # by the same executions
    copy = sierra.open(tmp_path / "swarm-reproduction" / "package" / "project")
    [longest] = copy.sql("SELECT max(wall_s) AS s FROM executions WHERE purpose = 'run'").to_pylist()
    some = ("--budget", f"{longest['s'] + 1e-3:.3f}s", "-j1")
    code, said = reproduce(tmp_path, str(package), "--yes", "--claim", "large", "--into", "part", *some)
    assert (said["claims"][0]["verdict"], said["claims"][0]["ground"]) == ("holds", "recomputed from recorded data")
    assert said["left_out"], said


@pytest.mark.nightly
def test_a_project_in_pyproject_toml_is_reproduced(tmp_path: Path) -> None:
    root = projects.make(tmp_path / "project", projects.CONFIG)
    settings = projects.CONFIG + PACKAGE + claim("large", SQL.format("> 0"))
    text = "[tool.sierra]\n" + re.sub(r"(?m)^(\[+)", r"\1tool.sierra.", settings)
    (root / "sierra.toml").unlink()
    (root / "pyproject.toml").write_text(text)
    batch = sierra.open(root).run("population_size=1,2", figures=False).batch
    sierra.open(root).packages.pack(batch, report=False, path=tmp_path / "swarm.zip")
    code, said = reproduce(tmp_path, "swarm.zip", "--yes")
    assert (code, said["claims"][0]["verdict"], said["claims"][0]["ground"]) == (0, "holds", "re-executed")


VERDICTS = {"exact": "does not hold", "large": "holds"}


@pytest.mark.integration
def test_a_package_chooses_nothing_outside_of_itself(package: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SECRET_KEY", "1234")
    keys = f"""
store = {{ work_folder = "{tmp_path}/work" }}
environment = {{ record = ["SECRET_*"] }}
programs = {{ version = ["-c", "open('{tmp_path}/started', 'w')"] }}
container = {{ image = "x.tar", mounts = {{ "/home" = "{tmp_path}" }} }}
[runners.mine]
scheduler = "slurm"
python = "touch {tmp_path}/started;"
"""
    first = projects.CONFIG.replace('template = "arena.xml"', 'template = "../../../arena.xml"')
    first = first.replace("python3 sim.py {input}", f"touch {tmp_path}/started")

    def change(members: dict[str, bytes]) -> None:
        text = members["project/sierra.toml"].decode().replace(projects.CONFIG, "")
        members["project/sierra.toml"] = (
            keys.split("[runners")[0] + first + text + "[runners" + keys.split("[runners")[1]
        ).encode()

    code, said = reproduce(tmp_path, str(changed(package, tmp_path / "bad.zip", change)), "--yes")
    assert {note.split()[1] for note in said["notes"]} == {
        "store.work_folder",
        "environment.record",
        "programs",
        "container.mounts",
        "runners",
        "template",
    }
    assert (code, said["batches"][0]["counts"]) == (1, {"identical": 4})
    assert {one["name"]: one["verdict"] for one in said["claims"]} == {"exact": "holds", "reading": "can't tell"}
    assert sorted(path.name for path in tmp_path.iterdir()) == ["bad-reproduction", "bad.zip"]
    assert b"SECRET_KEY" not in b"".join(path.read_bytes() for path in (tmp_path / "bad-reproduction").rglob("*.json"))
    code, said = reproduce(tmp_path, str(tmp_path / "bad.zip"), "--yes", "--on", "mine")
    assert (code, "mine" in said.get("error", "")) == (2, True)


@pytest.mark.integration
def test_statements_of_claims_read_nothing_but_the_store(package: Path, tmp_path: Path) -> None:
    code, said = reproduce(tmp_path, str(package), "--claim", "reading", "--yes")
    [one] = said["claims"]
    assert (code, one["verdict"], "read_text() is not allowed" in one["text"]) == (1, "can't tell", True)


@pytest.mark.integration
def test_claims_of_an_opened_package_are_decided_by_its_records_alone(tmp_path: Path) -> None:
    claims = claim("exact", SQL.format("= {most}")) + claim("less", SQL.format("< {most}")) + claim("reading", SECRET)
    package = packed(tmp_path, claims)
    done = projects.quick(tmp_path, "open", str(package), "claims", "--json", "--junit", "claims.xml")
    exact, less, reading = json.loads(done.stdout)
    assert (done.returncode, exact["verdict"], less["verdict"]) == (1, "holds", "does not hold"), done.stderr
    assert (exact["ground"], len(exact["batches"])) == ("recomputed from recorded data", 1)
    assert (reading["verdict"], "read_text() is not allowed" in reading["text"]) == ("can't tell", True)
    assert 'tests="3"' in (tmp_path / "claims.xml").read_text()
    assert projects.quick(tmp_path, "open", str(package), "claims", "exact").returncode == 0
    assert projects.quick(tmp_path, "open", str(package), "claims", "other").returncode == 2
    assert sorted(path.name for path in tmp_path.iterdir()) == ["claims.xml", "swarm.zip"]


@pytest.mark.integration
def test_an_extracted_package_is_verified_and_stays_as_it_is(package: Path, tmp_path: Path) -> None:
    folder = tmp_path / "extracted"
    with zipfile.ZipFile(package) as file:
        file.extractall(folder)
    before = {path: path.stat().st_mtime_ns for path in folder.rglob("*")}
    code, _ = reproduce(tmp_path, str(folder), "--into", "work", "--claim", "exact", "--yes")
    assert (code, {path: path.stat().st_mtime_ns for path in folder.rglob("*")} == before) == (0, True)
    code, _ = reproduce(tmp_path, str(folder), "--claim", "exact", "--yes")
    assert (code, (folder / "reproduction" / "reproduction.md").is_file()) == (0, True)
    assert subprocess.run([sys.executable, folder / "reproduce.py"], capture_output=True, check=False).returncode == 0
    (folder / "link").symlink_to("/etc/passwd")
    assert "link or a device" in reproduce(tmp_path, str(folder), "--into", "a", "--yes")[1]["error"]
    (folder / "link").unlink()
    (folder / "project" / "more.txt").write_text("")
    assert "is not listed in" in reproduce(tmp_path, str(folder), "--into", "a", "--yes")[1]["error"]
    (folder / "project" / "more.txt").unlink()
    (folder / "project" / "sim.py").write_text("print()")
    code, said = reproduce(tmp_path, str(folder), "--into", "a", "--yes")
    assert (code, "'project/sim.py' is not what" in said["error"]) == (1, True)
    assert not (tmp_path / "a" / "package").exists()


@pytest.mark.integration
@pytest.mark.parametrize(
    ("lost", "added"),
    [
        ("package.json", "a"),
        ("project/sierra.toml", "project/other.toml"),
        ("README.md", "project/.sierra/work/1/elsewhere"),
    ],
)
def test_a_package_without_a_project_or_with_more_than_records_is_refused(
    package: Path, tmp_path: Path, lost: str, added: str
) -> None:
    def change(members: dict[str, bytes]) -> None:
        members[added] = members.pop(lost)

    code, said = reproduce(tmp_path, str(changed(package, tmp_path / "bad.zip", change)), "--yes")
    assert (code, said["error"].count("\n")) == (1, 1)
    assert not (tmp_path / "bad-reproduction").exists()


@pytest.mark.nightly
def test_a_killed_reproduction_is_continued_in_the_same_folder(tmp_path: Path) -> None:
    package = packed(tmp_path, claim("exact", SQL.format("= {most}")), SLOW)
    command = [str(projects.SIERRA), "reproduce", str(package), "--yes", "-j1"]
    folder = tmp_path / "swarm-reproduction"
    started = subprocess.Popen(command, cwd=tmp_path, stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
    until = time.monotonic() + 60
    journal = "package/project/.sierra/work/*/journal.jsonl"
    while not any(b'"end"' in path.read_bytes() for path in folder.glob(journal)) and time.monotonic() < until:
        time.sleep(0.1)
    busy = reproduce(tmp_path, str(package), "--yes")
    assert (busy[0], "another sierra process works in" in busy[1]["error"]) == (2, True)
    started.send_signal(signal.SIGKILL)
    started.wait()
    (folder / ".sierra-unfinished" / "project").mkdir(parents=True)
    code, said = reproduce(tmp_path, str(package), "--yes")
    whole = (0, {"identical": 4}, "re-executed")
    assert (code, said["batches"][0]["counts"], said["claims"][0]["ground"]) == whole
    project = sierra.open(folder / "package" / "project")
    replays = "SELECT count(DISTINCT session), count(*), count(DISTINCT run) FROM executions WHERE purpose = 'replay'"
    executed = project.sql(replays).to_pylist()
    assert list(executed[0].values()) == [2, 4, 4]
    code, said = reproduce(tmp_path, str(package), "--yes")
    assert (code, said["batches"][0]["counts"], said["claims"][0]["ground"]) == whole
    assert project.sql(replays).to_pylist() == executed
    assert project.maintenance.fsck().sound
    (folder / "package" / "project" / "sim.py").write_text("changed")
    assert "is not what" in reproduce(tmp_path, str(package), "--yes")[1]["error"]


@pytest.mark.nightly
def test_other_files_are_not_replaced_and_missing_programs_are_named(
    package: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "swarm-reproduction" / "package").mkdir(parents=True)
    code, said = reproduce(tmp_path, str(package), "--yes")
    assert (code, "exists already; choose another folder with --into" in said["error"]) == (2, True)
    code, said = reproduce(tmp_path, str(package), "--claim", "exat", "--into", "a")
    assert (code, "did you mean 'exact'?" in said["error"]) == (2, True)
    code, said = reproduce(tmp_path, str(package), "--budget", "0.001s", "--into", "a")
    assert (code, "the shortest run took" in said["error"]) == (2, True)
    monkeypatch.setenv("PATH", str(tmp_path))
    code, said = reproduce(tmp_path, str(package), "--into", "a", "--yes", "--claim", "exact")
    assert (code, said["verdict"]) == (3, "not reproduced: nothing was executed")
    assert "python3" in said["batches"][0]["reason"]
    assert (said["claims"][0]["verdict"], said["claims"][0]["ground"]) == ("holds", "recomputed from recorded data")


def test_the_budget_touches_every_claim_before_anything_else() -> None:
    runs = [
        RecordedRun(batch, ordinal, n, f"{batch}{ordinal}{n}", 10 - n)
        for batch in "abc"
        for ordinal in (0, 1)
        for n in range(4)
    ]
    rests = {"one": ["a"], "two": ["b"]}
    first = [f"{batch}{ordinal}3" for ordinal in (0, 1) for batch in "ab"]
    chosen = {run.run for run in within_budget(runs, rests, budget=14, slots=2)}
    assert chosen == set(first)
    assert {run.run for run in within_budget(runs, rests, 7, 1)} == {"a03"}
    assert {run.run for run in within_budget(runs, rests, 42, 1)} == {*first, "c03", "c13"}
    assert len(within_budget(runs, rests, 1e6, 1)) == len(runs)
    some = within_budget(runs, rests, 14, 1)
    assert [untouched(runs, some, batches) for batches in rests.values()] == [1, 1]
    with pytest.raises(UsageError, match="the shortest run took 0:07, more than 0:05"):
        within_budget(runs, rests, 5, 8)


@pytest.mark.nightly
def test_python_packages_that_runs_used_and_that_are_missing_are_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, require: Callable[..., str]
) -> None:
    require("strace")
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", tmp_path / "venv"], check=True)
    [site] = (tmp_path / "venv" / "lib").glob("python*/site-packages")
    (site / "tiny.py").write_text("")
    (site / "tiny-1.0.dist-info").mkdir()
    (site / "tiny-1.0.dist-info" / "METADATA").write_text("Metadata-Version: 2.1\nName: tiny\nVersion: 1.0\n")
    (site / "tiny-1.0.dist-info" / "RECORD").write_text("tiny.py,,\n")
    monkeypatch.setenv("PATH", f"{tmp_path}/venv/bin{os.pathsep}{os.environ['PATH']}")
    package = packed(tmp_path, "", f"import tiny\n{projects.SIMULATOR}")
    shutil.rmtree(site / "tiny-1.0.dist-info")
    (site / "tiny.py").unlink()
    code, said = reproduce(tmp_path, str(package), "--yes", "--junit", "verdicts.xml")
    assert (code, said["batches"][0]["reason"]) == (
        3,
        "Python packages that runs used are not installed: pip install tiny==1.0",
    )
    [suite] = ET.parse(tmp_path / "verdicts.xml").getroot()  # noqa: S314 - SIERRA wrote it
    assert (suite.get("errors"), suite[0][0].tag) == ("1", "error")
