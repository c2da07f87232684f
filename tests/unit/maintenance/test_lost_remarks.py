"""What people said about executions survives damage: an execution whose remarks are lost does not count."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

import sierra
from sierra.maintenance.findings import Kind
from tests import projects, robots, stores
from tests.tiers import needs_extension

SHARED = """
SELECT run, execution, batch FROM executions SEMI JOIN (
    SELECT run FROM batch_runs GROUP BY run HAVING count(DISTINCT batch) > 1
) USING (run) WHERE purpose = 'run' ORDER BY run LIMIT 1
"""
"""SQL: an execution whose run belongs to several batches."""


def flip(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 0x20
    path.write_bytes(content)


def statuses(root: Path) -> dict[str, str]:
    return {row["execution"]: row["status"] for row in projects.sql(root, "SELECT execution, status FROM executions")}


@pytest.mark.nightly
@pytest.mark.each_case
@pytest.mark.parametrize("damage", [flip, Path.unlink])
@needs_extension("trials")
def test_an_invalid_trial_whose_remark_is_lost_does_not_count(
    recorded: Path, tmp_path: Path, damage: Callable[[Path], None]
) -> None:
    from sierra.extensions.trials import mark_trial

    root = stores.copy(recorded, tmp_path / "p")
    project = sierra.open(root)
    [chosen] = projects.sql(root, SHARED)
    mark_trial(project, chosen["run"], valid=False, reason="fell over", note="at the wall")
    before = statuses(root)
    [remark] = root.glob(".sierra/segments/*/trials.parquet")
    damage(remark)
    if damage is Path.unlink:
        refused = projects.quick(root, "sql", "SELECT count(*) FROM executions")
        assert refused.returncode == 1
        assert "trials.parquet is missing: run sierra fsck --repair" in refused.stderr
    repaired = projects.quick(root, "fsck", "--repair")
    assert repaired.returncode == 0, repaired.stderr
    assert f"batch {chosen['batch'][:10]}: remarks on its executions are lost; " in repaired.stdout
    now = statuses(root)
    assert now.keys() == before.keys(), "nothing that was measured is lost"
    assert now[chosen["execution"]] == "invalid"
    assert {now[one] for one, status in before.items() if status == "invalid"} == {"invalid"}
    of_batch = f"SELECT run FROM batch_runs WHERE batch = '{chosen['batch']}'"
    others = projects.sql(root, f"SELECT DISTINCT status FROM executions WHERE run NOT IN ({of_batch})")
    assert others == [{"status": "ok"}]
    mark_trial(project, chosen["execution"], valid=True)
    assert statuses(root)[chosen["execution"]] == "ok"
    assert projects.quick(root, "fsck").returncode == 0


@pytest.mark.integration
def test_a_repair_says_which_executions_have_lost_their_robots(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    robots.register(monkeypatch)
    root = robots.project(tmp_path / "p")
    sierra.open(root).run("population_size=2", runs=1, target="robots", figures=False)
    assert sierra.open(root).maintenance.fsck().findings == ()
    [table] = root.glob(".sierra/segments/*/robots.parquet")
    flip(table)
    repaired = sierra.open(root).maintenance.repair()
    assert repaired.report.sound
    [lost] = [one for one in repaired.report.findings if one.kind is Kind.UNKNOWN]
    assert lost.what == "the clocks, batteries and ends of the robots of executions are not recorded"
    assert len(lost.affected.executions) == 1
    assert projects.sql(root, "SELECT count(*) AS n FROM swarm") == [{"n": 8}], "what was measured stays"
