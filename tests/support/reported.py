"""A project whose report has every section: figures, tables, comparisons, claims, failures; and texts that attack the page."""

from __future__ import annotations

from pathlib import Path

from tests import projects

ATTACK = "</script><script>alert(1)</script><img src=x onerror=alert(2)> \"'&amp; \u202eevil\u202c שלום"
"""A text that a careless page would execute, or show in the wrong order."""
ATTACK_IN_TOML = ATTACK.replace('"', '\\"')
LINES_IN_TOML = rf"{ATTACK_IN_TOML}\n\r\n# a second\tline"
"""The same with several lines, where a project may have them."""
SIMULATOR = (
    projects.SIMULATOR
    + f"""
print({ATTACK!r}, "a\\rline", "line before the end", file=sys.stderr, sep="\\n")
if count == 4 and seed % 2:
    print("the wheels came off", file=sys.stderr)
    sys.exit(3)
"""
)
CONFIG = f"""
template = "arena.xml"
command = "python3 sim.py {{input}}"
runs = 6

[seed]
set = "//random/@seed"

[variables.population_size]
set = "//swarm/@count"
label = "population size"
unit = "robots"

[variables.noise]
set = "//noise"
label = "{LINES_IN_TOML}"

[controllers.slow]
changes = [{{ set = "//swarm/@controller", value = "slow" }}]

[outputs.swarm]
file = "swarm.csv"
time = "tick"
units = {{ tick = "s", coverage = "m²" }}

[queries.sizes]
criteria = "population_size=1,2,4"

[figures.over_time]
kind = "timeseries"
column = "coverage"
title = "{LINES_IN_TOML}"

[figures.at_the_end]
kind = "summary"
column = "coverage"
title = "Coverage at the end"

[figures.spread]
kind = "box"
column = "coverage"
title = "Spread of runs"

[figures.impossible]
column = "no_such_column"

[paper_tables.coverage]
column = "coverage"
caption = "Coverage {LINES_IN_TOML}"

[comparisons.sizes]
by = "population_size"
groups = ["1", "2"]
column = "coverage"

[claims.more]
says = "More robots cover more {ATTACK_IN_TOML}"
paper = "Fig. 1"
query = "sizes"
lost = 6
sql = "SELECT avg(coverage) FILTER (population_size = 2) > avg(coverage) FILTER (population_size = 1) AS more FROM swarm"

[claims.wrong]
says = "One robot covers ten square metres."
paper = "Section 4"
query = "sizes"
lost = 6
sql = "SELECT min(coverage) > 10 AS wrong FROM swarm"

[claims.later]
says = "Noise does not matter."
paper = "Fig. 2"
query = "noise=0,1"
sql = "SELECT true AS fine"

[package]
title = "Coverage of swarms {ATTACK_IN_TOML}"
authors = [{{ name = "Jane Doe" }}]
license = "MIT"
date = "2026-11-23"
"""


def make(folder: Path) -> Path:
    """Write the project, in a repository with an uncommitted change; return its folder."""
    root = projects.commit(projects.make(folder, CONFIG, simulator=SIMULATOR))
    (root / "sim.py").write_text(SIMULATOR + "# not committed\n")
    return root
