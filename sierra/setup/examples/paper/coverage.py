"""Robots walk over a grid and cover it: `python coverage.py INPUT.json` writes `coverage.csv`."""

from __future__ import annotations

import csv
import json
import random
import sys
from pathlib import Path

WAYS = ((0, 1), (1, 0), (0, -1), (-1, 0))


class Robot:
    """A robot that keeps its direction with a given probability, and turns at walls."""

    def __init__(self, chance: random.Random, side: int, straight: float) -> None:
        self._chance, self._side, self._straight = chance, side, straight
        self.cell = (chance.randrange(side), chance.randrange(side))
        self._way = chance.choice(WAYS)

    def step(self) -> None:
        if self._chance.random() >= self._straight:
            self._way = self._chance.choice(WAYS)
        x, y = self.cell[0] + self._way[0], self.cell[1] + self._way[1]
        if 0 <= x < self._side and 0 <= y < self._side:
            self.cell = (x, y)
        else:
            self._way = self._chance.choice(WAYS)


def main() -> None:
    arena = json.loads(Path(sys.argv[1]).read_text())
    side, chance = arena["side"], random.Random(arena["seed"])
    robots = [Robot(chance, side, arena["straight"]) for _ in range(arena["robots"])]
    visited = {robot.cell for robot in robots}
    with Path("coverage.csv").open("w", newline="") as file:
        rows = csv.writer(file, lineterminator="\n")
        rows.writerow(["step", "coverage"])
        for step in range(arena["steps"] + 1):
            rows.writerow([step, len(visited) / side**2])
            for robot in robots:
                robot.step()
                visited.add(robot.cell)


if __name__ == "__main__":
    main()
