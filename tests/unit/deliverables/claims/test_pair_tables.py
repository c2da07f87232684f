"""Claims on one table of pairs are corrected together, and say how many of its pairs were claimed."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

import sierra
from tests import projects

pytestmark = pytest.mark.integration
CONFIG = (
    projects.CONFIG
    + """
[queries.main]
criteria = ["population_size=1,2,8", "noise=0.1,0.2"]
runs = 10
[queries.small]
criteria = "noise=0.1"
runs = 6
[queries.medium]
criteria = "noise=0.1"
scenario = "medium"
runs = 6
[queries.large]
criteria = "noise=0.1"
scenario = "large"
runs = 6
[scenarios.medium]
changes = [{ set = "//swarm/@count", value = 4 }]
[scenarios.large]
changes = [{ set = "//swarm/@count", value = 9 }]
"""
)
SIMULATOR = projects.SIMULATOR.replace("with open", 'if count == 2 and noise == 0.2:\n    sys.exit("no")\nwith open', 1)
AT = 'experiments = "noise=0.1"'
BIG = f'order = {{ by = "population_size", groups = ["8", "1"], {AT} }}'
MIDDLE = f'order = {{ by = "population_size", column = "coverage", groups = ["8", "2"], {AT} }}'
ALIKE = f'equivalence = {{ by = "population_size", groups = ["1", "2"], margin = 4.5, {AT} }}'
"""Ten pairs of runs with the same seeds, whose differences all have one sign: by the exact signed-rank test, the two-sided p is
2 / 2^10, and that of each one-sided test of the equivalence 1 / 2^10."""


def claim(name: str, decision: str, query: str = 'query = "main"') -> str:
    return f'[claims.{name}]\nsays = "It is so."\npaper = "Fig. 1"\n{query}\n{decision}\n'


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = projects.make(tmp_path_factory.mktemp("pairs") / "project", CONFIG, simulator=SIMULATOR)
    for query in ("main", "small", "medium", "large"):
        sierra.open(root).run(query, figures=False)
    return root


def found(root: Path, *tables: str) -> dict[str, dict[str, Any]]:
    """Return the evaluated claims by name."""
    (root / "sierra.toml").write_text(CONFIG + "".join(tables))
    done = projects.quick(root, "claims", "--json")
    assert "Traceback" not in done.stderr
    return {one["name"]: one for one in json.loads(done.stdout)}


def test_three_claims_on_one_table_are_corrected_by_holm(recorded: Path) -> None:
    answer = found(recorded, claim("big", BIG), claim("middle", MIDDLE), claim("alike", ALIKE))
    # Holm: the smallest p, 1 / 1024, three times; then 2 / 1024 twice; then 2 / 1024 once, but not less than the one before.
    expected = {"alike": 3 / 1024, "big": 4 / 1024, "middle": 4 / 1024}
    assert {name: one["p"] for name, one in answer.items()} == pytest.approx(expected)
    assert {(one["tests"], one["pairs"], one["claimed_pairs"]) for one in answer.values()} == {(3, 6, 3)}
    assert {one["verdict"] for one in answer.values()} == {"holds"}
    command = f"sierra compare {answer['big']['batches'][0][:10]} --by population_size --table swarm --column coverage"
    for one in answer.values():
        assert "after correction for 3 tests (Holm)" in one["text"]
        assert one["text"].endswith(f"; 3 of 6 pairs of this comparison were claimed: {command}")
    assert projects.quick(recorded, *command.split()[1:], "--no-figure").returncode == 0, "the command is one"


def test_a_single_claim_is_not_corrected_and_names_the_declared_comparison(recorded: Path) -> None:
    declared = '[comparisons.others]\nby = "noise"\n[comparisons.sizes]\nquery = "main"\nby = "population_size"\n'
    [alone] = found(recorded, claim("big", BIG), declared).values()
    assert (alone["p"], alone["tests"]) == (pytest.approx(2 / 1024), 1)
    assert alone["text"].endswith("; 1 of 6 pairs of this comparison was claimed: sierra compare sizes")
    [alone] = found(recorded, claim("big", BIG), declared.replace('query = "main"\n', "")).values()
    assert alone["text"].endswith(f"was claimed: sierra compare sizes {alone['batches'][0][:10]}")
    [alone] = found(recorded, claim("big", BIG), declared.replace('query = "main"', 'query = "large"')).values()
    assert "sierra compare sizes" not in alone["text"], "that comparison is about another batch"


def test_claims_on_other_values_are_no_family_but_other_experiments_and_groups_are(recorded: Path) -> None:
    answer = found(
        recorded,
        claim("big", BIG),
        claim("elsewhere", BIG.replace("noise=0.1", "noise=0.2")),
        claim("everywhere", BIG.replace(f", {AT}", "")),
        claim("rows", BIG.replace(" }", ', where = "tick > 2" }')),
        claim("mean", BIG.replace(" }", ', measure = "mean" }')),
        claim("noise", 'order = { by = "noise", groups = ["0.2", "0.1"], experiments = "population_size=1" }'),
    )
    assert {name: one["tests"] for name, one in answer.items()} == {
        **dict.fromkeys(("big", "elsewhere", "everywhere"), 3),
        **dict.fromkeys(("rows", "mean", "noise"), 1),
    }
    assert answer["big"]["claimed_pairs"] == 2, "a pair that two claims name counts once"
    assert answer["noise"]["pairs"] == 3
    assert "of this comparison was claimed;" not in answer["rows"]["text"]
    assert answer["rows"]["text"].endswith("1 of 6 pairs of this comparison was claimed")


def test_a_refuted_claim_counts_in_its_family(recorded: Path) -> None:
    answer = found(recorded, claim("big", BIG), claim("other", BIG.replace('["8", "1"]', '["2", "8"]')))
    assert answer["other"]["verdict"] == "does not hold"
    assert [one["p"] for one in answer.values()] == pytest.approx([4 / 1024, 4 / 1024])


def test_a_claim_without_runs_counts_in_its_family_with_p_1(recorded: Path) -> None:
    answer = found(recorded, claim("big", BIG), claim("lost", MIDDLE.replace("noise=0.1", "noise=0.2")))
    assert "10 of 20 runs failed" in answer["lost"]["text"]
    assert (answer["big"]["p"], answer["big"]["tests"]) == (pytest.approx(2 * 2 / 1024), 2)


def test_batches_of_a_declared_comparison_are_one_table(recorded: Path) -> None:
    def order(*names: str) -> str:
        groups = json.dumps(names)
        return claim("_".join(names), f"order = {{ groups = {groups} }}", f"batches = {groups}")

    [alone] = found(recorded, order("large", "small")).values()
    assert (alone["tests"], alone["pairs"], "claimed" in alone["text"]) == (1, 1, False), "a table of one pair needs no word"
    declared = '[comparisons.three]\ngroups = ["small", "medium", "large"]\n'
    answer = found(recorded, order("large", "small"), order("large", "medium"), declared)
    for one in answer.values():
        assert (one["tests"], one["pairs"], one["claimed_pairs"]) == (2, 3, 2)
        assert one["p"] == pytest.approx(2 * 2 / 2**6)
        assert one["text"].endswith("2 of 3 pairs of this comparison were claimed: sierra compare three")
    apart = found(recorded, order("large", "small"), order("large", "medium"))
    assert {one["tests"] for one in apart.values()} == {1}, "without the comparison, these are two tables"
