"""The pictures in the documentation: `make pictures` draws all kinds of figures as two pages say, and the packages of the code.

    python -m tests.pictures

The pages have a figure for each kind as TOML. The batch is made anew by a small simulator. A test compares the hashes of the
data in the pictures with those of a new batch, and not their bytes, which depend on the version of matplotlib.
"""

from __future__ import annotations

import tempfile
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import sierra
from sierra.config import project_file
from sierra.config.deliverable_tables import Figure
from sierra.deliverables.figures.drawing import Drawing, draw
from sierra.deliverables.gallery import Gallery
from sierra.store.batch_data import BatchData
from tests import architecture, projects

DOCS = Path(__file__).parents[1] / "docs"
PAGES = (DOCS / "gallery.md", DOCS / "extensions" / "figures.md")
FOLDER = DOCS / "pictures"
QUERY = ("controller=walk,levy,pheromone", "population_size=2,4,8")
RUNS = 8
SIMULATOR = """\
import math, sys

arena = open(sys.argv[1]).read()
count = int(arena.split('<swarm count="')[1].split('"')[0])
name = arena.split('controller="')[1].split('"')[0]
skill = {"walk": 1.0, "levy": 1.1, "pheromone": 1.6}[name]
state = (int(arena.split('<random seed="')[1].split('"')[0]) + 7919 * len(name)) % 2147483647 or 1


def chance():
    global state  # numbers of Park and Miller, which are the same everywhere
    state = state * 16807 % 2147483647
    return state / 2147483647


luck = 0.6 + 0.8 * chance()
robots = [(6 * chance() - 3, 4 * chance() - 2, 7 * chance()) for _ in range(count)]
names = ["swarm", "poses", "links", "field", "guesses"]
files = {name: open(name + ".csv", "w") for name in names}
heads = ["tick,coverage,energy,distance,sensing", "tick,robot,x,y", "tick,source,target,weight,x,y", "tick,row,column,heat"]
for name, head in zip(names, [*heads, "tick,truth,prediction,score,loss"]):
    print(head, file=files[name])


def write(name, *values):
    print(*(round(one, 4) if isinstance(one, float) else one for one in values), sep=",", file=files[name])


covered = spent = 0.0
for tick in range(0, 21):
    part = round(100 * (1 - math.exp(-covered)), 2)
    driven = round(0.3 * covered * (1 + chance()), 3)
    write("swarm", tick, part, round(spent, 3), driven, round(count * tick * (0.15 - 0.05 * chance()), 3))
    covered += 0.03 * skill * luck * math.sqrt(count) * (0.5 + chance())
    spent += count * (0.3 + 0.2 * skill * chance())
    robots = [(x + 0.5 * math.cos(a), y + 0.5 * math.sin(a), a + chance() - 0.5) for x, y, a in robots]
    robots = [(x, y, a if abs(x) < 3 and abs(y) < 2 else math.atan2(-y, -x)) for x, y, a in robots]
    for robot, (x, y, _) in enumerate(robots):
        write("poses", tick, robot, round(x, 2), round(y, 2))
        write("links", tick, robot, "", "", round(x, 2), round(y, 2))
        for other in range(robot):
            far = math.hypot(x - robots[other][0], y - robots[other][1])
            if far < 2:
                write("links", tick, robot, other, round(2 - far, 2), round(x, 2), round(y, 2))
    for row in range(6 if tick == 20 else 0):
        for column in range(8):
            heat = skill * math.exp(-((row - 2) ** 2 + (column - 4) ** 2) / 8) + 0.1 * chance()
            write("field", tick, row, column, round(heat, 3))
    truth = "food" if chance() < 0.4 else "nest" if chance() < 0.5 else "none"
    score = round(min(1.0, max(0.0, (0.22 if truth == "food" else 0.0) * skill + 0.6 * chance())), 3)
    guess = "food" if score > 0.5 else "nest" if chance() < 0.6 else "none"
    write("guesses", tick, truth, guess, score, int(guess != truth))
"""
CONFIG = """\
template = "arena.xml"
command = "python3 sim.py {input}"
seed = "//random/@seed"
[variables.population_size]
set = "//swarm/@count"
label = "robots"
[controllers.walk]
changes = [{ set = "//swarm/@controller", value = "walk" }]
[controllers.levy]
changes = [{ set = "//swarm/@controller", value = "levy" }]
[controllers.pheromone]
changes = [{ set = "//swarm/@controller", value = "pheromone" }]
[outputs.swarm]
file = "swarm.csv"
time = "tick"
units = { tick = "s", coverage = "%", energy = "J", distance = "m", sensing = "J" }
[outputs.poses]
file = "poses.csv"
time = "tick"
units = { x = "m", y = "m" }
[outputs.links]
file = "links.csv"
time = "tick"
units = { x = "m", y = "m" }
[outputs.field]
file = "field.csv"
time = "tick"
[outputs.guesses]
file = "guesses.csv"
time = "tick"
"""


def declared() -> dict[str, Figure]:
    """Return the figures of the pages that have the name of their kind. Others show keys, for data that this batch lacks."""
    text = "".join(page.read_text("utf-8") for page in PAGES)
    blocks = [block.partition("```")[0] for block in text.split("```toml\n")[1:]]
    found = tomllib.loads("\n".join(blocks))["figures"]
    return {name: Figure.model_validate(table) for name, table in found.items() if name == table["kind"]}


@contextmanager
def drawings(folder: Path) -> Iterator[dict[str, Drawing]]:
    """Run the batch in a new folder; yield the content of each picture by its name."""
    root = projects.make(folder, CONFIG, simulator=SIMULATOR)
    project = sierra.open(root)
    batch = project.run(*QUERY, runs=RUNS, figures=False).batch
    with BatchData(project.store, batch) as frame:
        gallery = Gallery(project_file.load(root), project.store, frame)
        yield {name: gallery.drawing(name, figure) for name, figure in declared().items()}


def main() -> None:
    architecture.main()
    with tempfile.TemporaryDirectory() as folder, drawings(Path(folder, "project")) as found:
        for drawing in found.values():
            (file,) = draw(replace(drawing, formats=("svg",)), FOLDER)
            print(f"{file.stat().st_size / 1000:5.1f} kB  {file.relative_to(DOCS.parent)}")


if __name__ == "__main__":
    main()
