"""People walk over a grid and tell a rumour to those whom they meet: `python rumour.py INPUT.json` writes `rumour.csv`."""

from __future__ import annotations

import csv
import json
import sys
from pathlib import Path

import mesa
from mesa.discrete_space import CellAgent, OrthogonalMooreGrid


class Person(CellAgent):
    """A person who may know the rumour."""

    def __init__(self, model: Town, *, knows: bool) -> None:
        super().__init__(model)
        self.knows = knows
        self.cell = model.random.choice(model.grid.all_cells.cells)

    def walk(self) -> None:
        self.cell = self.cell.neighborhood.select_random_cell()

    def tell(self) -> None:
        for other in self.cell.agents if self.knows else ():
            if not other.knows and self.model.random.random() < self.model.belief:
                other.knows = True


class Town(mesa.Model):
    """A town, in which one person knows the rumour at first."""

    def __init__(self, seed: int, people: int, width: int, belief: float) -> None:
        super().__init__(seed=seed)
        self.belief = belief
        self.grid = OrthogonalMooreGrid((width, width), torus=True, random=self.random)
        for number in range(people):
            Person(self, knows=number == 0)

    def step(self) -> None:
        self.agents.shuffle_do("walk")
        self.agents.shuffle_do("tell")

    @property
    def informed(self) -> float:
        return sum(person.knows for person in self.agents) / len(self.agents)


def main() -> None:
    given = json.loads(Path(sys.argv[1]).read_text())
    steps = given.pop("steps")
    town = Town(**given)
    with Path("rumour.csv").open("w", newline="") as file:
        rows = csv.writer(file, lineterminator="\n")
        rows.writerow(["step", "informed"])
        rows.writerow([0, town.informed])
        for number in range(1, steps + 1):
            town.step()
            rows.writerow([number, town.informed])


if __name__ == "__main__":
    main()
