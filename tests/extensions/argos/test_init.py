"""`sierra init` finds a template of ARGoS."""

from __future__ import annotations

import json
from pathlib import Path

from tests.projects import quick
from tests.unit.setup.test_init import written


def test_an_argos_template_selects_the_platform_argos(tmp_path: Path) -> None:
    (tmp_path / "a.argos").write_text(
        '<argos-configuration><framework><experiment length="9" ticks_per_second="10" random_seed="1"/></framework>'
        '<arena size="4,4,1"><distribute><entity quantity="5"><foot-bot id="f"><controller config="x"/></foot-bot></entity>'
        "</distribute></arena></argos-configuration>"
    )
    ended = quick(tmp_path, "init", "--json")
    assert json.loads(ended.stdout)["next"] == "sierra run population_size.Log8 -n"
    assert written(tmp_path) == {"template": "a.argos", "platform": "argos", "runs": 10, "variables": {}}
