"""`sierra paper`: one folder with everything that is bound to queries; it changes only where numbers change."""

from __future__ import annotations

import hashlib
import json
import re
import shutil
from pathlib import Path

import pytest

import sierra
from sierra.config import project_file
from sierra.deliverables.paper import folder as folder_of_paper
from sierra.design.query.query_request import request
from sierra.errors import ConfigError, Damaged, NotFound
from sierra.execution.batches_of_queries import labelled
from tests import projects

CONFIG = (
    projects.CONFIG
    + """
[source]
paths = ["sim.py"]
[queries.small]
criteria = "population_size=1,2"
runs = 2
[queries.more]
criteria = "population_size=1,2"
runs = 3
[queries.noisy]
criteria = "noise=0.1,0.2"
runs = 2
[figures.lines]
query = "small"
column = "coverage"
formats = ["png", "pgf"]
[figures.boxes]
query = "population_size=1,2"
kind = "box"
column = "coverage"
[figures.together]
query = ["a=small", "b=more"]
kind = "summary"
column = "coverage"
[figures.free]
kind = "summary"
column = "coverage"
[paper_tables.noise]
query = "noisy"
column = "coverage"
label = "tab:noise"
[comparisons.sizes]
query = "small"
by = "population_size"
column = "coverage"
[comparisons.batches]
groups = ["small", "more"]
column = "coverage"
[comparisons.free]
by = "noise"
column = "coverage"
"""
)
FILES = {
    *(f"captions/{name}.tex" for name in ("lines", "boxes", "together", "sizes", "batches")),
    *(f"figures/{name}" for name in ("lines.png", "lines.pgf", "boxes.pdf", "together.pdf", "sizes.pdf", "batches.pdf")),
    *(f"tables/{name}.tex" for name in ("noise", "sizes", "batches")),
    *(f"texts/{name}.tex" for name in ("sizes", "batches")),
    "sql/noise.sql",
    "provenance.json",
}


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = projects.commit(projects.make(tmp_path_factory.mktemp("paper") / "project", CONFIG))
    preview = projects.quick(folder, "paper", "-n", "--json")
    assert [row["to_execute"] for row in json.loads(preview.stdout)] == [4, 6, 4], "a query counts once, whatever it is called"
    assert not (folder / "paper").exists()
    done = projects.quick(folder, "paper")
    assert done.returncode == 0, done.stderr
    assert f"{len(FILES)} files written, 0 unchanged" in done.stdout
    return folder


@pytest.fixture
def paper(built: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(built, tmp_path / "project"))


def content(folder: Path) -> dict[str, bytes]:
    root = folder / "paper" / "sierra"
    return {path.relative_to(root).as_posix(): path.read_bytes() for path in root.rglob("*") if path.is_file()}


def checked(folder: Path) -> tuple[int, list[str]]:
    done = projects.quick(folder, "paper", "--check")
    return done.returncode, done.stdout.splitlines()


@pytest.mark.integration
def test_the_folder_has_the_files_of_all_bound_deliverables(paper: Path) -> None:
    found = content(paper)
    assert set(found) == FILES
    assert b"\\label{fig:together}" in found["captions/together.tex"]
    table = found["tables/noise.tex"].decode().splitlines()
    assert table[0].startswith("% sierra ")
    assert table[0].endswith("; SQL: sql/noise.sql")
    assert not any(line.startswith("%") for line in table[1:]), "the SQL stands in its own file"
    assert b"SELECT" in found["sql/noise.sql"]
    described = json.loads(found["provenance.json"])
    assert set(described["files"]) == FILES - {"provenance.json"}
    assert set(described["queries"]) == {"small", "population_size=1,2", "a=small", "b=more", "noisy", "more"}
    assert all(query["source"].startswith("swh:1:dir:") for query in described["queries"].values())
    assert checked(paper) == (0, ["all files follow from the store"])


CLAIM = """
[claims.{name}]
says = "It covers 100 %"
query = "population_size=1,2"
runs = 2
{shown}
sql = "SELECT count(*) > 0 FROM swarm"
"""


@pytest.mark.integration
def test_captions_say_which_claims_they_show_and_if_these_were_planned(paper: Path) -> None:
    before, config = content(paper), paper / "sierra.toml"
    places = {"one": 'figure = "lines"', "two": 'table = "noise"', "three": 'paper = "Sec. 1"', "four": 'figure = "free"'}
    config.write_text(config.read_text() + "".join(CLAIM.format(name=name, shown=shown) for name, shown in places.items()))
    assert {line.split()[0] for line in checked(paper)[1]} > {
        "paper/sierra/captions/lines.tex",
        "paper/sierra/tables/noise.tex",
    }
    done = projects.quick(paper, "paper")
    assert done.returncode == 0, done.stderr
    assert checked(paper) == (0, ["all files follow from the store"])
    after = content(paper)
    assert {name for name in after if after[name] != before[name]} == {
        "captions/lines.tex",
        "tables/noise.tex",
        "provenance.json",
    }
    said = b"Claim (exploratory): It covers 100 \\%."
    assert after["captions/lines.tex"].splitlines()[0].endswith(b" " + said + b"}")
    assert after["tables/noise.tex"].count(said) == 1
    for file in ("captions/lines.tex", "tables/noise.tex"):
        assert "follows from the store" in projects.quick(paper, "show", f"paper/sierra/{file}").stdout
    config.write_text(config.read_text().replace('label = "tab:noise"', 'label = "tab:noise"\ncaption = "Noise"'))
    assert projects.quick(paper, "paper").returncode == 0
    assert b"\\caption{Noise. " + said + b"}" in content(paper)["tables/noise.tex"]


@pytest.mark.integration
def test_nothing_is_executed_and_written_again(paper: Path) -> None:
    before = {path: path.stat().st_mtime_ns for path in (paper / "paper").rglob("*")}
    done = projects.quick(paper, "paper")
    assert done.returncode == 0, done.stderr
    assert ": 4 runs: 0 executed, 4 reused, 0 failed" in done.stdout
    assert f"0 files written, {len(FILES) - 1} unchanged" in done.stdout
    assert {path: path.stat().st_mtime_ns for path in (paper / "paper").rglob("*")} == before


@pytest.mark.integration
def test_two_clones_make_the_same_bytes_and_an_edit_changes_what_it_changes(built: Path, tmp_path: Path) -> None:
    clone = projects.make(tmp_path / "clone", CONFIG)
    projects.commit(clone)
    assert projects.quick(clone, "paper").returncode == 0
    before = content(clone)
    assert before == content(built)
    simulator = clone / "sim.py"
    simulator.write_text(simulator.read_text() + "\n# a comment\n")
    code, lines = checked(clone)
    assert code == 1
    assert all("has not been run with the code as it is now; its last batch is" in line for line in lines)
    assert len(lines) == 4
    assert projects.quick(clone, "paper").returncode == 0
    assert {name for name, data in content(clone).items() if data != before[name]} == {"provenance.json"}
    assert checked(clone)[0] == 0
    simulator.write_text(simulator.read_text().replace("noise * (seed % 100)", "(noise + (noise > 0.15)) * (seed % 100)"))
    assert projects.quick(clone, "paper").returncode == 0
    changed = {name for name, data in content(clone).items() if data != before[name]}
    assert changed == {"provenance.json", "tables/noise.tex", "sql/noise.sql"}


@pytest.mark.integration
def test_files_that_somebody_edited_are_named_and_left_alone(paper: Path) -> None:
    edited = paper / "paper" / "sierra" / "texts" / "sizes.tex"
    edited.write_text("my own words\n")
    (paper / "paper" / "sierra" / "figures" / "boxes.pdf").unlink()
    code, lines = checked(paper)
    assert code == 1
    assert lines == [
        "paper/sierra/figures/boxes.pdf is missing",
        "paper/sierra/texts/sizes.tex was edited: it is not the file that SIERRA wrote",
    ]
    done = projects.quick(paper, "paper")
    assert done.returncode == 1
    assert "paper/sierra/texts/sizes.tex was edited, and is left as it is; remove it to have it made again" in done.stderr
    assert "1 file written" in done.stdout
    assert edited.read_text() == "my own words\n"
    edited.unlink()
    assert projects.quick(paper, "paper").returncode == 0
    assert checked(paper)[0] == 0


@pytest.mark.integration
def test_a_file_that_was_edited_together_with_its_hash_is_named_and_made_again(paper: Path) -> None:
    folder = paper / "paper" / "sierra"
    table = folder / "tables" / "noise.tex"
    before = table.read_bytes()
    table.write_bytes(before + b"% 0.99\n")
    provenance = (folder / "provenance.json").read_text()
    hashes = (hashlib.sha256(text).hexdigest() for text in (before, table.read_bytes()))
    (folder / "provenance.json").write_text(provenance.replace(*hashes))
    code, lines = checked(paper)
    why = "is not the file that the store has recorded: provenance.json has the hash of another one"
    assert (code, lines) == (1, [f"paper/sierra/tables/noise.tex {why}"])
    done = projects.quick(paper, "paper")
    assert (done.returncode, table.read_bytes()) == (0, before), done.stderr
    assert (folder / "provenance.json").read_text() == provenance
    assert checked(paper)[0] == 0
    others = json.loads(provenance)  # of a clone with other libraries
    table.write_bytes(before + b"% other bytes\n")
    file = others["files"]["tables/noise.tex"]
    file.update(sha256=hashlib.sha256(table.read_bytes()).hexdigest(), made_by=["matplotlib==3.0"])
    (folder / "provenance.json").write_text(json.dumps(others))
    assert checked(paper)[0] == 0
    assert "0 files written" in projects.quick(paper, "paper").stdout


@pytest.mark.integration
def test_what_sierra_toml_changes_is_named_and_made_again(paper: Path) -> None:
    config = paper / "sierra.toml"
    config.write_text(
        config.read_text().replace('kind = "box"', 'kind = "violin"').replace("[figures.lines]", "[figures.curves]")
    )
    code, lines = checked(paper)
    assert code == 1
    assert lines == [
        "paper/sierra/captions/boxes.tex is made otherwise now: sierra.toml or SIERRA has changed",
        "paper/sierra/captions/lines.tex: sierra.toml no longer binds this figure to a query",
        "paper/sierra/figures/boxes.pdf is made otherwise now: sierra.toml or SIERRA has changed",
        "paper/sierra/figures/lines.pgf: sierra.toml no longer binds this figure to a query",
        "paper/sierra/figures/lines.png: sierra.toml no longer binds this figure to a query",
        "paper/sierra/figures/curves.png was not made yet",
        "paper/sierra/figures/curves.pgf was not made yet",
        "paper/sierra/captions/curves.tex was not made yet",
    ]
    done = projects.quick(paper, "paper")
    assert "paper/sierra/figures/lines.png (removed)" in done.stdout
    assert set(content(paper)) == {name.replace("lines", "curves") for name in FILES}
    assert checked(paper)[0] == 0


@pytest.mark.integration
def test_a_clone_without_a_store_is_checked_by_its_provenance(paper: Path) -> None:
    shutil.rmtree(paper / ".sierra")
    done = projects.quick(paper, "paper", "--check")
    assert done.returncode == 0
    assert done.stdout == "all files are as they were written\n"
    assert "there is no store here: the files are compared with provenance.json alone" in done.stderr
    (paper / "paper" / "sierra" / "tables" / "noise.tex").write_text("0.99\n")
    assert checked(paper) == (1, ["paper/sierra/tables/noise.tex was edited: it is not the file that SIERRA wrote"])


@pytest.mark.integration
def test_a_copy_of_any_file_is_known(paper: Path, tmp_path: Path) -> None:
    copied = Path(shutil.copy(paper / "paper" / "sierra" / "figures" / "boxes.pdf", tmp_path / "copy.pdf"))
    shown = projects.quick(paper, "show", str(copied))
    assert shown.returncode == 0, shown.stderr
    assert "boxes" in shown.stdout


@pytest.mark.integration
def test_runs_that_fail_end_with_exit_code_1(tmp_path: Path) -> None:
    simulator = projects.SIMULATOR + "sys.exit('<noise>0.2<' in open(sys.argv[1]).read())\n"
    folder = projects.make(tmp_path / "project", CONFIG, simulator=simulator)
    done = projects.quick(folder, "paper")
    assert done.returncode == 1, done.stderr
    assert ": 4 runs: 2 executed, 2 reused, 2 failed" in done.stdout
    assert "files written" in done.stdout, "the paper shows what there is, and n says so"


@pytest.mark.parametrize("text", ["", "[]", '{"version": 2}', '{"version": 1, "files": {"../x": {}}}', "\0"])
def test_a_damaged_provenance_is_named(tmp_path: Path, text: str) -> None:
    folder = projects.make(tmp_path / "project", CONFIG)
    (folder / "paper" / "sierra").mkdir(parents=True)
    (folder / "paper" / "sierra" / "provenance.json").write_text(text)
    done = projects.quick(folder, "paper", "--check")
    assert done.returncode in (1, 2)
    assert "provenance.json" in done.stderr
    assert "Traceback" not in done.stderr


def test_a_file_outside_the_folder_is_refused(tmp_path: Path) -> None:
    folder = projects.make(tmp_path / "project", CONFIG)
    (folder / "paper" / "sierra").mkdir(parents=True)
    file = {"sha256": "0", "kind": "figure", "name": "x", "batches": [], "data": "", "definition": ""}
    described = {"version": 1, "files": {"../../sim.py": file}}
    (folder / "paper" / "sierra" / "provenance.json").write_text(json.dumps(described))
    with pytest.raises(Damaged, match=r"sim\.py"):
        sierra.open(folder).paper.check()


def test_without_anything_bound_or_made_the_command_says_so(tmp_path: Path) -> None:
    folder = projects.make(tmp_path / "project")
    with pytest.raises(NotFound, match="nothing is bound to a query"):
        sierra.open(folder).paper.queries()
    with pytest.raises(NotFound, match="make it with: sierra paper"):
        sierra.open(folder).paper.check()
    refused = projects.quick(folder, "paper", "--check", "-n")
    assert refused.returncode == 2


def test_a_criterion_whose_value_is_the_name_of_a_query_stays_one(tmp_path: Path) -> None:
    text = CONFIG.replace('query = "noisy"', 'query = "population_size=1,2 noise=small"')
    config = project_file.load(projects.make(tmp_path / "p", text)).config
    assert labelled(config, "a=small") == ("a", request(["small"]))
    assert labelled(config, "small") == ("small", request(["small"]))
    assert labelled(config, "noise=small") == ("", request(["noise=small"]))
    assert labelled(config, "population_size=1,2 noise=small") == ("", request(["population_size=1,2", "noise=small"]))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('[figures.x]\nquery = ""\n', "is neither the name of a query nor criteria"),
        ('[figures.x]\nquery = "population_size=1 --runs 3"\n', "options belong to [queries.NAME]"),
        ('[paper]\nfolder = "."\n', "the folder of a paper is one within the project"),
        ('[paper]\nfolder = "../x"\n', "a path within the project"),
        ('[paper]\nprefix = "s1"\n', "prefix"),
    ],
)
def test_keys_that_cannot_be_right_are_refused(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(ConfigError, match=re.escape(message)):
        project_file.load(projects.make(tmp_path / "p", CONFIG + text))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (CONFIG.replace('["small", "more"]', '["small", "mor"]'), "'mor' is not the name of a query, but others are"),
        (CONFIG + '[paper_tables.sizes]\nquery = "small"\ncolumn = "coverage"\n', "would have files of the same name"),
        (CONFIG + '[paper]\nfolder = "src"\n', "src/helper.py is not a file of `sierra paper`"),
        (CONFIG + '[paper]\nfolder = "sim.py"\n', "is a file"),
    ],
)
def test_what_cannot_be_made_is_refused_before_anything_is_executed(tmp_path: Path, text: str, message: str) -> None:
    folder = projects.make(tmp_path / "p", text)
    (folder / "src").mkdir()
    (folder / "src" / "helper.py").write_text("")
    done = projects.quick(folder, "paper")
    assert done.returncode == 2
    assert message in done.stderr
    assert not (folder / ".sierra").exists()


@pytest.mark.integration
def test_a_killed_process_leaves_files_that_are_known(paper: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    config = paper / "sierra.toml"
    config.write_text(config.read_text().replace('kind = "box"', 'kind = "strip"').replace('"png", "pgf"', '"png", "svg"'))
    project, written, real = sierra.open(paper), [], folder_of_paper.write_whole

    def killed(path: Path, content: bytes) -> Path:
        if len(written) == 3:
            raise KeyboardInterrupt
        written.append(path)
        return real(path, content)

    monkeypatch.setattr(folder_of_paper, "write_whole", killed)
    with pytest.raises(KeyboardInterrupt):
        project.paper.write()
    monkeypatch.undo()
    code, lines = checked(paper)
    assert code == 1
    assert "paper/sierra/provenance.json: the paper was not finished; make it again with: sierra paper" in lines
    config.write_text(config.read_text().replace('kind = "strip"', 'kind = "violin"'))
    done = projects.quick(paper, "paper")
    assert done.returncode == 0, done.stderr
    assert "0 executed" in done.stdout, "the folder is not part of the source"
    assert checked(paper) == (0, ["all files follow from the store"])


@pytest.mark.integration
def test_files_that_are_lost_or_forgotten_are_named_and_made_again(paper: Path) -> None:
    described = paper / "paper" / "sierra" / "provenance.json"
    content = json.loads(described.read_text())
    del content["files"]["tables/noise.tex"]
    described.write_text(json.dumps(content))
    (paper / "paper" / "sierra" / "tables" / "noise.tex").unlink()
    assert checked(paper) == (1, ["paper/sierra/tables/noise.tex was not made yet"])
    assert projects.quick(paper, "paper").returncode == 0
    assert checked(paper)[0] == 0
    edited = paper / "paper" / "sierra" / "captions" / "boxes.tex"
    edited.write_text("my own words\n")
    config = paper / "sierra.toml"
    config.write_text(re.sub(r"(?s)\[figures.boxes\].*?(?=\[figures.together\])", "", config.read_text()))
    for _ in range(2):
        done = projects.quick(paper, "paper")
        assert done.returncode in (1, 2)
        assert "captions/boxes.tex" in done.stderr, "it is named as long as it is there"
    assert edited.read_text() == "my own words\n"


@pytest.mark.integration
def test_a_clone_with_a_committed_folder_knows_its_files(built: Path, tmp_path: Path) -> None:
    clone = projects.make(tmp_path / "clone", CONFIG)
    shutil.copytree(built / "paper", clone / "paper")
    projects.commit(clone)
    done = projects.quick(clone, "paper")
    assert done.returncode == 0, done.stderr
    assert f"0 files written, {len(FILES) - 1} unchanged" in done.stdout
    assert "follows from the store" in projects.quick(clone, "show", "paper/sierra/tables/noise.tex").stdout


@pytest.mark.integration
def test_one_batch_can_belong_to_queries_of_two_targets(tmp_path: Path) -> None:
    targets = '[targets.alt]\n[queries.alt]\ncriteria = "population_size=1,2"\nruns = 2\ntarget = "alt"\n'
    bound = '[figures.of_alt]\nquery = "alt"\nkind = "summary"\ncolumn = "coverage"\n'
    folder = projects.make(tmp_path / "p", CONFIG + targets + bound)
    done = projects.quick(folder, "paper")
    assert done.returncode == 0, done.stderr
    assert checked(folder)[0] == 0
