"""A package is reproduced on a cluster of the user's own configuration."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests import projects
from tests.clusters import Slurm
from tests.unit.packages.test_reproduction import SQL, claim, packed

pytestmark = pytest.mark.real


@pytest.mark.nightly
def test_a_package_is_reproduced_on_a_cluster_of_the_user(
    tmp_path: Path, slurm: Slurm, monkeypatch: pytest.MonkeyPatch
) -> None:
    package = packed(
        tmp_path, claim("exact", SQL.format("= {most}")), config=projects.CONFIG + "[runners.mine]\nscheduler = 'pbs'\n"
    )
    settings = tmp_path / "config" / "sierra" / "config.toml"
    settings.parent.mkdir(parents=True)
    settings.write_text('[runners.mine]\nscheduler = "slurm"\narray_tasks = 1\n')
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    done = projects.quick(tmp_path, "reproduce", str(package), "--on", "mine", "--yes", "--json")
    assert done.returncode == 0, done.stderr
    said = json.loads(done.stdout)
    assert (said["batches"][0]["counts"], said["claims"][0]["ground"]) == ({"identical": 4}, "re-executed")
    assert (tmp_path / "swarm-reproduction" / "reproduction.md").is_file()
