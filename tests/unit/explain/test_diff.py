"""`sierra diff` reports every difference of two recorded items, most relevant first, and what is the same."""

from __future__ import annotations

import json
import shutil
import subprocess
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest

import sierra
from sierra.explain.diff.model import changed
from sierra.explain.diff.results import Mean, newcombe, welch
from tests import projects, stores

Make = Callable[..., Path]
OTHER = projects.SIMULATOR.replace("count * tick", "count * tick + 1")
STAMPED = projects.SIMULATOR + "open('log.txt', 'w').write(f'# written {__import__(\"time\").time_ns()}\\nfine\\n')\n"


def test_a_long_list_that_only_one_side_has_is_cut() -> None:
    packages = "\n".join(f"package{number}==1.0" for number in range(900))
    [found] = changed("environment", "packages", packages, None)
    assert len(found.line) < 200
    assert found.line.endswith("package5==1.0 and 894 more → nothing")


def git(root: Path, *words: str) -> None:
    subprocess.run(["git", "-c", "user.name=a", "-c", "user.email=a@b", *words], cwd=root, check=True, capture_output=True)


def made(folder: Path, simulator: str = projects.SIMULATOR, more: str = "") -> Path:
    return projects.make(folder, projects.CONFIG + more, simulator=simulator)


@pytest.fixture
def make(tmp_path: Path) -> Make:
    """Return a function that makes a project outside git."""
    return partial(made, tmp_path / "project")


@pytest.fixture(params=["git", pytest.param("none", marks=pytest.mark.nightly)])
def make_either(request: pytest.FixtureRequest, tmp_path: Path) -> Make:
    """Return a function that makes a project, in git and outside git."""

    def make(*parts: str) -> Path:
        root = made(tmp_path / "project", *parts)
        if request.param == "git":
            first(root)
        return root

    return make


def first(root: Path) -> None:
    """Put a project into git."""
    git(root, "init", "-q")
    git(root, "add", ".")
    git(root, "commit", "-q", "-m", "first")


def ask(root: Path, *query: str, **more: Any) -> str:
    return stores.ask(root, *(query or ("population_size=1,2",)), **more)


def diff(root: Path, before: str, after: str) -> dict[str, Any]:
    ended = projects.quick(root, "diff", before, after, "--json")
    assert (ended.returncode, ended.stderr) == (1 if json.loads(ended.stdout)["differences"] else 0, "")
    said: dict[str, Any] = json.loads(ended.stdout)
    ranks = [one["rank"] for one in said["differences"]]
    assert ranks == sorted(ranks)
    assert not {one["kind"] for one in said["differences"]} & set(said["same"])
    return said


def kinds(said: dict[str, Any]) -> list[str]:
    return list(dict.fromkeys(one["kind"] for one in said["differences"]))


def lines(said: dict[str, Any], kind: str) -> list[str]:
    return [one["line"] for one in said["differences"] if one["kind"] == kind]


def executions(root: Path, purpose: str = "run") -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = (
        sierra.open(root).sql("SELECT * FROM executions WHERE purpose = $p ORDER BY started, execution", p=purpose).to_pylist()
    )
    return rows


@pytest.mark.integration
def test_changed_code_is_reported_with_its_patch_and_the_changed_results(make_either: Make) -> None:
    root = make_either()
    before = ask(root)
    (root / "sim.py").write_text(OTHER)
    said = diff(root, before, ask(root))
    assert kinds(said) == ["source", "results"]
    [source] = [one for one in said["differences"] if one["kind"] == "source"]
    assert source["line"].startswith("source: 1 file differs: sim.py (+1 −1)")
    assert (
        "+        print(tick, count * tick + 1 + noise * (seed % 100), sep=',', file=file)".replace("','", '","')
        in source["details"]
    )
    bytes_too, mean = [one for one in said["differences"] if one["kind"] == "results"]
    assert bytes_too["line"] == "results: 4 of 4 runs wrote different bytes"
    assert [now - was for was, now in zip(mean["before"], mean["after"], strict=True)] == pytest.approx([1, 1])
    assert {"query", "command", "programs", "inputs", "seed", "environment", "rules"} <= set(said["same"])


@pytest.mark.nightly
def test_changed_code_with_equal_results_reports_results_as_the_same(make_either: Make) -> None:
    root = make_either()
    before = ask(root)
    (root / "sim.py").write_text(projects.SIMULATOR + "# more\n")
    said = diff(root, before, ask(root))
    assert kinds(said) == ["source"], lines(said, "files")
    assert "results" in said["same"]
    assert "commit" not in said["same"]


@pytest.mark.integration
def test_added_removed_renamed_and_binary_files_are_listed(make_either: Make) -> None:
    root = make_either()
    (root / "old.txt").write_text("a\nb\n")
    (root / "kept.txt").write_text("the same\n")
    (root / "data.bin").write_bytes(b"\0one")
    before = ask(root)
    (root / "old.txt").unlink()
    (root / "new.txt").write_text("c\n")
    (root / "kept.txt").rename(root / "moved.txt")
    (root / "data.bin").write_bytes(b"\0two")
    [line] = lines(diff(root, before, ask(root)), "source")
    assert "4 files differ: data.bin (binary), kept.txt → moved.txt, new.txt (added, +1 −0), old.txt (removed, +0 −2)" in line


@pytest.mark.nightly
def test_commits_in_between_and_uncommitted_changes_are_reported(tmp_path: Path) -> None:
    root = projects.make(tmp_path)
    first(root)
    before = ask(root)
    (root / "sim.py").write_text(OTHER)
    git(root, "commit", "-q", "-a", "-m", "Add one")
    middle = ask(root)
    [source] = [one for one in diff(root, before, middle)["differences"] if one["kind"] == "source"]
    assert source["line"].endswith("; 1 commit ahead")
    assert source["details"][0].endswith(" Add one")
    git(root, "commit", "-q", "--allow-empty", "-m", "Say nothing")
    assert ask(root, "population_size=1,2", runs=3) != middle
    (root / "sim.py").write_text(OTHER + "# not yet\n")
    [source] = [one for one in diff(root, middle, ask(root))["differences"] if one["kind"] == "source"]
    assert source["line"].endswith("; 1 commit ahead, with uncommitted changes")


@pytest.mark.nightly
def test_other_commit_with_the_same_files_is_reported_after_relevant_differences(tmp_path: Path) -> None:
    root = projects.make(tmp_path)
    first(root)
    before = ask(root)
    git(root, "commit", "-q", "--allow-empty", "-m", "Say nothing")
    said = diff(root, before, ask(root, "population_size=1,2,4"))
    assert kinds(said) == ["query", "commit"]
    assert "the same files; 1 commit ahead" in lines(said, "commit")[0]


@pytest.mark.integration
def test_difference_is_reported_without_patch_if_git_lost_the_code(tmp_path: Path) -> None:
    root = projects.make(tmp_path)
    first(root)
    before = ask(root)
    (root / "sim.py").write_text(OTHER)
    git(root, "commit", "-q", "-a", "-m", "second")
    after = ask(root)
    shutil.rmtree(root / ".git")
    git(root, "init", "-q")
    [source] = [one for one in diff(root, before, after)["differences"] if one["kind"] == "source"]
    assert "1 file differs: sim.py" in source["line"]
    assert "not in this repository" in source["line"]
    assert any("neither in git nor in the store" in line for line in source["details"])


@pytest.mark.nightly
def test_query_difference_is_reported_before_the_input_difference(make: Make) -> None:
    root = make()
    before = ask(root)
    said = diff(root, before, ask(root, sets=[("//noise", "0.2")]))
    assert kinds(said) == ["query", "inputs", "results"]
    assert lines(said, "query") == ["--set //noise=0.2 was added"]
    assert lines(said, "inputs") == ["input, as requested: //noise: 0.1 → 0.2 (in all 4 runs)"]


@pytest.mark.integration
def test_changed_values_and_run_counts_are_reported_and_common_runs_are_compared(make: Make) -> None:
    root = make()
    before = ask(root, "population_size=1,2")
    said = diff(root, before, ask(root, "population_size=2,4", runs=3))
    assert lines(said, "query") == ["population_size: 1, 2 → 2, 4", "runs per experiment: 2 → 3"]
    assert kinds(said) == ["query"]
    assert any("2 runs in both, 2 with the same effective execution" in note for note in said["notes"])


@pytest.mark.integration
def test_batches_without_common_experiments_do_not_report_equal_results(make: Make) -> None:
    root = make()
    said = diff(root, ask(root, "population_size=1,2"), ask(root, "population_size=3,4"))
    assert not {"inputs", "seed", "results"} & set(said["same"])
    assert any("no experiment is in both" in note for note in said["notes"])


@pytest.mark.nightly
def test_axis_with_a_single_value_does_not_prevent_comparison_of_experiments(make: Make) -> None:
    root = make()
    said = diff(root, ask(root, "population_size=1,2"), ask(root, "population_size=1,2", "noise=0.3"))
    assert lines(said, "inputs") == ["input: //noise: 0.1 → 0.3 (in all 4 runs)"]


@pytest.mark.nightly
def test_two_experiments_and_two_runs_can_be_compared(make: Make) -> None:
    root = make()
    batch = ask(root)
    one, other = sierra.open(root).sql("SELECT experiment FROM experiments ORDER BY ordinal").column(0).to_pylist()
    said = diff(root, one, other)
    assert lines(said, "query") == ["population_size: 1 → 2"]
    assert lines(said, "inputs") == ["input, as requested: //swarm/@count: 1 → 2 (in all 2 runs)"]
    runs = sierra.open(root).sql("SELECT run FROM batch_runs WHERE ordinal = 0 ORDER BY number").column(0).to_pylist()
    said = diff(root, *runs)
    assert kinds(said) == ["seed", "inputs", "results"]
    assert lines(said, "inputs")[0].startswith("input, the seed: //random/@seed: ")
    assert "different: row 0: 'coverage' was " in lines(said, "results")[0]
    assert batch


@pytest.mark.nightly
def test_changed_base_seed_is_reported(make: Make) -> None:
    root = make()
    before = ask(root)
    based = 'seed = { set = "//random/@seed", base = 7 }'
    (root / "sierra.toml").write_text(projects.CONFIG.replace('seed = "//random/@seed"', based))
    said = diff(root, before, ask(root))
    assert "base seed: 0 → 7" in lines(said, "seed")


@pytest.mark.nightly
def test_template_change_without_effect_is_reported_as_formatting_only(make: Make) -> None:
    root = make()
    before = ask(root)
    (root / "arena.xml").write_text(projects.TEMPLATE.replace("an arena", "the arena"))
    said = diff(root, before, ask(root))
    assert kinds(said) == ["inputs", "template"]
    assert "only white space, order of attributes or comments differ" in lines(said, "inputs")[0]


@pytest.mark.integration
def test_changed_program_between_two_executions_is_reported(tmp_path: Path, require: Callable[..., str]) -> None:
    require("strace")
    program = tmp_path / "sim"
    root = projects.make(tmp_path / "project", projects.CONFIG.replace("python3 sim.py", str(program)))
    for value in (1, 2):
        program.write_text(f"#!/bin/sh\nprintf 'tick,v\\n0,{value}\\n' > out.csv\n")
        program.chmod(0o755)
        ask(root, "population_size=1", runs=1)
    one, other = executions(root)
    assert one["run"] == other["run"]
    said = diff(root, one["execution"], other["execution"])
    assert kinds(said) == ["programs", "files", "results"]
    assert lines(said, "programs")[0].startswith("sim: ")
    assert lines(said, "files") == [f"files that executions used: other content: {program}"]
    assert "'v' was 1 and is 2" in lines(said, "results")[0]
    assert kinds(diff(root, one["run"], one["execution"])) == ["programs", "files", "results"]
    assert diff(root, one["run"], other["execution"])["differences"] == []


@pytest.mark.nightly
def test_changed_status_of_a_run_is_reported(make: Make) -> None:
    root = make("import sys, pathlib\nsys.exit(pathlib.Path(sys.argv[1]).read_text().count('count=\"2\"'))\n")
    batch = ask(root)
    runs = sierra.open(root).sql("SELECT run FROM batch_runs WHERE number = 0 ORDER BY ordinal").column(0).to_pylist()
    assert lines(diff(root, *runs), "status") == ["status: ok → failed (exit status 1)"]
    assert batch


@pytest.mark.nightly
def test_changed_ingest_rules_are_reported_by_key(make: Make) -> None:
    root = make()
    before = ask(root, "population_size=1")
    (root / "sierra.toml").write_text(projects.CONFIG + '[success]\nmarker = "stdout"\ncontains = "fine"\n')
    after = ask(root, "population_size=1", runs=3)
    [rules] = [one for one in diff(root, before, after)["differences"] if one["kind"] == "rules"]
    assert "success.contains nothing → fine" in rules["details"]


@pytest.mark.integration
def test_replay_equals_its_record_except_for_volatile_content(make_either: Make) -> None:
    root = make_either(STAMPED, '[outputs.log]\nfile = "log.txt"\nvolatile = ["^# written"]\n')
    ask(root, "population_size=1", runs=1)
    sierra.open(root).replay(executions(root)[0]["run"])
    said = diff(root, executions(root)[0]["execution"], executions(root, "replay")[0]["execution"])
    assert said["differences"] == []
    assert "log.txt: only volatile lines differ" in said["notes"]


@pytest.mark.nightly
def test_changed_host_is_the_last_environment_difference(tmp_path: Path, require: Callable[..., str]) -> None:
    unshare = require("unshare")
    alone = subprocess.run([unshare, "-r", "--uts", "hostname", "elsewhere"], capture_output=True, check=False)
    require("a host name of one's own (unshare -r --uts)", there=alone.returncode == 0)
    root = projects.make(tmp_path)
    before = ask(root)
    (root / "sim.py").write_text(OTHER)
    elsewhere = f"hostname elsewhere && {projects.SIERRA} run population_size=1,2 --no-figures --json"
    ended = subprocess.run(
        [unshare, "-r", "--uts", "sh", "-c", elsewhere], cwd=root, capture_output=True, text=True, check=True
    )
    said = diff(root, before, json.loads(ended.stdout)["batch"])
    assert kinds(said) == ["source", "environment", "results"]
    assert lines(said, "environment")[-1].endswith(" → elsewhere")


@pytest.mark.nightly
def test_equal_batches_are_reported_with_the_list_of_compared_kinds(make: Make, require: Callable[..., str]) -> None:
    require("strace")
    root = make()
    batch = ask(root)
    ended = projects.quick(root, "diff", batch, batch[:10])
    assert ended.returncode == 0
    assert "no difference in query, platform, command, image, programs, files, source" in ended.stdout


@pytest.mark.integration
def test_items_that_cannot_be_compared_are_a_usage_error(make: Make) -> None:
    root = make()
    batch = ask(root)
    for words in ((batch, executions(root)[0]["run"]), (batch, "ffff"), ("x", batch)):
        ended = projects.quick(root, "diff", *words)
        assert (ended.returncode, ended.stdout, ended.stderr.count("\n")) == (2, "", 1)


@pytest.mark.nightly
def test_long_patch_is_shortened_unless_patch_is_given(make: Make) -> None:
    root = make()
    before = ask(root)
    (root / "sim.py").write_text(projects.SIMULATOR + "".join(f"# line {n}\n" for n in range(50)))
    words = ("diff", before, ask(root))
    short, whole = projects.quick(root, *words).stdout, projects.quick(root, *words, "--patch").stdout
    assert "# line 49" not in short
    assert "more lines (--patch shows them)" in short
    assert "+# line 49" in whole


@pytest.mark.integration
def test_inputs_missing_from_the_store_are_noted_and_the_rest_is_compared(make: Make) -> None:
    root = make()
    before = ask(root)
    after = ask(root, sets=[("//noise", "0.2")])
    for path in root.glob(".sierra/segments/*/objects.parquet"):
        path.unlink()
    said = diff(root, before, after)
    assert lines(said, "query") == ["--set //noise=0.2 was added"]
    assert "inputs" not in said["same"]
    assert any("not in the store" in note for note in said["notes"])


@pytest.mark.integration
def test_runs_without_executions_report_neither_equal_results_nor_programs(make: Make) -> None:
    root = make("import sys, time; time.sleep(0.4); sys.exit(1)\n")
    sierra.open(root).run("population_size=1", runs=20, jobs=1, fail_fast=True, figures=False)
    missing = "SELECT run FROM batch_runs WHERE run NOT IN (SELECT run FROM executions) ORDER BY number"
    one, other, *_ = sierra.open(root).sql(missing).column(0).to_pylist()
    said = diff(root, one, other)
    assert kinds(said) == ["seed", "inputs"]
    assert not {"results", "status", "programs", "environment"} & set(said["same"])
    assert any("was never executed; results are not compared" in note for note in said["notes"])


@pytest.mark.integration
def test_changed_results_that_are_not_tables_are_reported(make: Make) -> None:
    root = make("open('picture.bin', 'wb').write(b'\\0one')\n")
    before = ask(root)
    (root / "sim.py").write_text("open('picture.bin', 'wb').write(b'\\0two')\n")
    assert lines(diff(root, before, ask(root)), "results") == ["results: 4 of 4 runs wrote different bytes"]


@pytest.mark.parametrize("seed", range(5))
def test_interval_of_a_difference_of_means_contains_the_welch_interval(seed: int) -> None:
    import numpy as np
    from scipy import stats

    random = np.random.default_rng(seed)
    one, other = random.normal(0, 1, 5 + seed), random.normal(1, 3, 9)
    found = welch(*(Mean(len(x), float(x.mean()), float(x.std(ddof=1))) for x in (one, other)))
    exact = stats.ttest_ind(other, one, equal_var=False).confidence_interval(0.95)
    assert found is not None
    assert found[0] <= exact.low
    assert found[1] >= exact.high
    assert found == pytest.approx((exact.low, exact.high), rel=0.1, abs=0.1)


def test_interval_of_a_difference_of_rates_is_the_newcombe_interval() -> None:
    """The first example of Newcombe's paper: 56 of 70 and 48 of 80."""
    from scipy import stats

    def rate(good: int, n: int) -> Mean:
        interval = stats.binomtest(good, n).proportion_ci(0.95, method="wilson")
        return Mean(n, good / n, 0.0, (interval.low, interval.high))

    assert newcombe(rate(48, 80), rate(56, 70)) == pytest.approx((0.0524, 0.3339), abs=5e-5)
    assert newcombe(rate(0, 5), Mean(5, 0.5, 0.1)) is None


@pytest.mark.parametrize("scale", [1e-300, 1e-170, 1e170, 1e300])
def test_interval_of_a_difference_scales_with_the_magnitude_of_values(scale: float) -> None:
    one, other = (welch(Mean(5, 1.0 * by, 0.5 * by), Mean(7, 2.0 * by, 0.25 * by)) for by in (1.0, scale))
    assert one is not None
    assert other == pytest.approx((one[0] * scale, one[1] * scale), rel=1e-12)


@pytest.mark.integration
def test_runs_with_only_logs_do_not_report_equal_results(make: Make) -> None:
    root = make("print(__import__('time').time_ns())\n")
    ask(root, "population_size=1", runs=2)
    one, other = executions(root)
    said = diff(root, one["execution"], other["execution"])
    assert "results" not in said["same"]
    assert any("only logs were written" in note for note in said["notes"])
