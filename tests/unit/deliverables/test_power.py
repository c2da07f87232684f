"""`sierra plan-n` answers how many runs a comparison needs, from two groups or one, as `sierra compare` would test them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

import sierra
from tests import projects

pytestmark = pytest.mark.integration


@pytest.fixture(scope="module")
def pilots(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[str]]:
    """Return a project with two batches of 8 runs in 2 experiments each; tests only read its store."""
    root = projects.make(tmp_path_factory.mktemp("pilots") / "project")
    project = sierra.open(root)
    batches = [
        project.run("population_size=1,2", runs=8, sets=sets, figures=False).batch for sets in ((), [("//noise", "0.2")])
    ]
    return root, batches


def answer(root: Path, *words: str) -> dict[str, Any]:
    done = projects.quick(root, "plan-n", *words, "--json")
    assert done.returncode == 0, done.stderr
    found: dict[str, Any] = json.loads(done.stdout)
    return found


@pytest.mark.nightly
def test_two_groups_are_paired_by_seed_and_shifted_to_the_difference(pilots: tuple[Path, list[str]]) -> None:
    root, (quiet, noisy) = pilots
    found = answer(root, quiet[:8], noisy[:8], "--difference", "50", "--runs", "4")
    assert [one["point"] for one in found["comparisons"]] == [{"population_size": 1}, {"population_size": 2}]
    for one in found["comparisons"]:
        assert (one["test"], one["pilot"], one["alpha"]) == ("Wilcoxon signed-rank test", 8, 0.025)
        # no difference of pairs is below 0, so that only n counts: 2 ** (1 - n) is at most alpha
        assert (one["runs"], one["power"], one["power_with"]) == (7, 1.0, 0.0)
    assert (found["seed"], found["resamples"]) == (1, 2000)
    assert found == answer(root, quiet[:8], noisy[:8], "--difference", "50", "--runs", "4")
    (own,) = answer(root, quiet[:8], "--by", "population_size")["comparisons"]
    assert (own["first"], own["second"], own["difference"]) == ("population_size=1", "population_size=2", pytest.approx(4))


def test_each_experiment_of_one_batch_is_the_pilot_of_a_group(pilots: tuple[Path, list[str]]) -> None:
    root, (quiet, _) = pilots
    found = answer(root, quiet[:8], "-d", "2", "--power", "0.9")
    assert [one["test"] for one in found["comparisons"]] == ["Mann-Whitney test"] * 2
    assert all(one["power"] >= 0.9 for one in found["comparisons"])
    shown = projects.quick(root, "plan-n", quiet[:8], "-d", "2", "--power", "0.9").stdout.splitlines()
    assert shown[-1] == f"for a power of 0.9, final coverage: --runs {max(one['runs'] for one in found['comparisons'])}"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ((), "name --half-width W, or what to compare"),
        (("-d", "0"), "a difference must be a number other than 0, not 0"),
        (("-d", "1", "--power", "1"), "a power must be above 0 and below 1, not 1"),
        (("-d", "1", "--runs", "1"), "ask about 2 or more"),
        (("-d", "1", "--alpha", "0.7"), "alpha should be less than 0.5, not 0.7"),
        (("-d", "1", "--paired", "yes"), "one group has no pairs"),
        (("-w", "1", "-d", "1"), "leave out --difference"),
        (("-d", "1", "--by", "population_size", "--groups", "1"), "two groups, not of 1"),
        (("-d", "1", "--by", "size"), "no variable 'size'"),
        (("-d", "1", "--measure", "time_to", "--threshold", "11.5"), "some runs never reached the threshold"),
    ],
)
def test_a_question_without_an_answer_is_one_line(pilots: tuple[Path, list[str]], words: tuple[str, ...], message: str) -> None:
    done = projects.quick(pilots[0], "plan-n", pilots[1][0][:8], *words)
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1)
    assert message in done.stderr
