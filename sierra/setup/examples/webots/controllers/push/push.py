"""Push the ball, write where it is, and end the simulation after five seconds.

Webots starts this program in the folder `controllers/push`, with the words of `controllerArgs`: the speed of the ball, the
seed, and the file to be written.
"""

import random
import sys
from pathlib import Path

from controller import Supervisor

END_S = 5.0


def main() -> None:
    speed, seed, path = float(sys.argv[1]), int(sys.argv[2]), Path(sys.argv[3])
    chance = random.Random(seed)
    webots = Supervisor()
    step = int(webots.getBasicTimeStep())
    ball = webots.getFromDef("BALL")
    ball.setVelocity([speed, chance.gauss(0, speed / 10), 0, 0, 0, 0])
    with path.open("w") as file:
        print("time,x,y", file=file)
        while webots.getTime() < END_S and webots.step(step) != -1:
            x, y, _ = ball.getPosition()
            print(webots.getTime(), x, y, sep=",", file=file)
    webots.simulationQuit(0)
    webots.step(step)


main()
