"""Of many possible figures, those are drawn whose columns differ most between the experiments."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.projects import make, quick

WIDE = """\
import random, sys
text = open(sys.argv[1]).read()
count, seed = (int(text.split(before)[1].split('"')[0]) for before in ('<swarm count="', '<random seed="'))
rng = random.Random(seed)
names = [f"a{number:02}" for number in range(20)]
with open("wide.csv", "w") as file:
    print(*names, "energy", "huge", sep=",", file=file)
    print(*(rng.random() for _ in names), count * 10 + rng.random(), 1e308, sep=",", file=file)
"""


@pytest.mark.integration
def test_columns_that_differ_between_experiments_have_figures_before_others(tmp_path: Path) -> None:
    folder = make(tmp_path / "project", simulator=WIDE)
    assert quick(folder, "run", "population_size=1,2,4", "--runs", "4", "--no-figures").returncode == 0
    done = quick(folder, "figures", "--json")
    assert done.returncode == 0, done.stderr
    assert "6 more figures can be drawn" in done.stderr + done.stdout
    drawn = {Path(path).stem for path in json.loads(done.stdout)}
    assert "wide_energy_summary" in drawn
    assert len(drawn) == 16
