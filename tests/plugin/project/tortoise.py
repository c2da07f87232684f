"""A simulator of tortoises: it reads a configuration, and writes how far they are together after each step."""

import random
import sys
from pathlib import Path

lines = Path(sys.argv[1]).read_text().splitlines()
given = dict(line.replace(" ", "").split("=") for line in lines if "=" in line)
chance = random.Random(int(given["seed"]))
distance = 0.0
with Path("walk.track").open("w") as track:
    print("track 1\ntick distance", file=track)
    for tick in range(int(given["steps"])):
        distance += sum(float(given["speed"]) * chance.random() for _ in range(int(given["tortoises"])))
        print(tick, distance, file=track)
    print("end", file=track)
