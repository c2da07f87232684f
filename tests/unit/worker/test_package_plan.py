"""The plan of a package: inputs as differences, and the runs that are chosen."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from hypothesis import strategies as st

from sierra.worker import package_plan
from tests.properties import given_in_tiers

LINE = {
    "run": "ab" * 32,
    "experiment": 0,
    "number": 0,
    "seconds": 2.0,
    "argv": ["python3", "/@sierra-project@/sim.py"],
    "environment": {},
    "files": {"input.xml": "<a/>"},
    "outputs": {"swarm.csv": "0" * 64},
}
BATCH: dict[str, Any] = {
    "batch": "cd" * 32,
    "obstacle": "",
    "of": 4,
    "project": "project",
    "programs": [],
    "files": {},
    "beside": {},
    "needs": [],
    "requires": [],
    "image": None,
    "clients": {},
    "limits": {},
    "success": [0],
    "notes": [],
    "jobs": "execution/jobs.jsonl",
    "environment": {},
    "by_value": {},
}


def made(folder: Path, *lines: Any, **batch: Any) -> Path:
    """Write the files of an extracted package that the program reads."""
    (folder / "execution").mkdir(parents=True)
    plan = {"format": package_plan.FORMAT, "batches": [{**BATCH, **batch}]}
    (folder / "execution/plan.json").write_text(json.dumps(plan))
    (folder / "execution/jobs.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    return folder


@given_in_tiers(st.text(alphabet="ab\n\r\0é"), st.text(alphabet="ab\n\r\0é"))
def test_inputs_as_differences_are_the_same_inputs(before: str, text: str) -> None:
    described = json.loads(json.dumps(package_plan.changes(before, text)))
    assert package_plan.changed(before, described) == text
    assert package_plan.changed(None, package_plan.changes(None, text)) == text


def test_a_budget_gives_each_experiment_a_run_first(tmp_path: Path) -> None:
    lines = [
        {**LINE, "run": f"{place}{number}", "experiment": place, "number": number} for place in (0, 1) for number in (0, 1)
    ]
    for options, expected in (((None, 4.0), ["00", "10"]), ((1, None), ["00", "10"]), ((None, 0.1), ["00"])):
        [batch], _ = package_plan.read_plan(tmp_path / "x" if (tmp_path / "x").exists() else made(tmp_path / "x", *lines))
        assert package_plan.choose([batch], *options) == (len(expected), 2.0 * len(expected))
        assert [run.run for run in batch.runs()] == expected
