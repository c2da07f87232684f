"""Robots that cover a walled arena, in MuJoCo: `python swarm.py INPUT.xml OUTPUT_FOLDER [FRAMES_FOLDER]`.

All settings stand in the input, and the same input gives the same bytes. Two files are written:
`swarm.csv`, a row per tick: the clock [s], the coverage (share of the free floor cells that robots have been
in), the contacts (how often two robots have run into each other) and the energy [J] that the motors have spent;
`poses.csv`, a row per robot and second: the clock [s], the robot's number, its x and y [m].
With a third argument, the camera `top` also writes an image of every second tick, `TICK.png`; it changes nothing else.
"""

from __future__ import annotations

import csv
import ctypes.util
import math
import os
import struct
import sys
import zlib
from pathlib import Path
from random import Random

if len(sys.argv) < 4:
    os.environ["MUJOCO_GL"] = "disable"  # physics alone: `import mujoco` need not look for a display
elif "MUJOCO_GL" not in os.environ:
    if not ctypes.util.find_library("EGL"):
        sys.exit("images need EGL, which is not installed (Debian, Ubuntu: apt install libegl1 libgl1)")
    os.environ["MUJOCO_GL"] = "egl"

import mujoco as mj
import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]
Cells = npt.NDArray[np.int_]


def vectors(headings: list[float]) -> Floats:
    """Unit vectors, rounded: the last bit of a sine depends on the CPU (FMA or not), enough for another run."""
    return np.array([(round(math.cos(heading), 9), round(math.sin(heading), 9)) for heading in headings])


WAYS = [2 * math.pi * way / 16 for way in range(16)]  # the headings that the pheromone controller chooses between
LOOK_AHEAD = (0.25, 0.5)  # m, where it smells the floor on each way
SIGHT = 1.0  # m, how near another robot repels it
REPULSION, INERTIA = 1.0, 0.2  # s of pheromone that a robot next to it, and going straight on, are worth


class InputError(Exception):
    """The input cannot be simulated."""


class Swarm:
    """The robots and their world. Positions are arrays of (robots, 2) in m, headings are in rad."""

    def __init__(self, model: mj.MjModel) -> None:
        self.model, self.data, self.size = model, mj.MjData(model), model.nq // 2
        if self.size < 1 or not model.nq == model.nv == model.nu == 2 * self.size:
            raise InputError("there must be one robot or more, each with two slide joints and two motors")
        self.random = Random(int(number(model, "seed")))
        step, self.tick = model.opt.timestep, 1 / number(model, "ticks_per_second", positive=True)
        self.steps = round(self.tick / step)
        if not math.isclose(self.steps * step, self.tick):
            raise InputError(f"a tick of {self.tick} s is not a whole number of timesteps of {step} s")
        self.noise = number(model, "noise") * math.sqrt(self.tick)
        speed, radius = number(model, "max_speed"), model.geom_size[model.geom_bodyid == model.nbody - 1].max()
        if speed * step > radius / 2:
            raise InputError(f"at {speed} m/s and a timestep of {step} s, robots would go through walls")
        self.force = speed * model.dof_damping[0]  # what holds that speed against the damping
        self.cell = number(model, "cell_size", positive=True)
        self.half = model.geom("floor").size[:2]
        self.robot_of_geom = np.where(model.body_dofnum == 2, model.body_dofadr // 2, -1)[model.geom_bodyid]
        self.pheromone = self._empty_floor()
        self.free = np.isfinite(self.pheromone)
        self.last = np.array(self.pheromone.shape) - 1
        if not self.free.any():
            raise InputError(f"no cell of {self.cell} m is free")
        self._place()
        self.headings = [self.random.uniform(-math.pi, math.pi) for _ in range(self.size)]

    @property
    def positions(self) -> Floats:
        return np.array(self.data.qpos).reshape(self.size, 2)

    @property
    def coverage(self) -> float:
        return np.count_nonzero(self.pheromone[self.free]) / np.count_nonzero(self.free)

    def touching(self) -> set[tuple[int, int]]:
        """Pairs of robots that touch, the smaller number first; it is -1 for what is no robot."""
        return {(min(pair), max(pair)) for pair in self.robot_of_geom[self.data.contact.geom].tolist()}

    def cells(self, points: Floats) -> tuple[Cells, Cells]:
        """The indices of the floor's cells that points lie in; the outermost ring is all beyond the walls."""
        index = np.floor((points + self.half) / self.cell).astype(int) + 1
        index = np.minimum(np.maximum(index, 0), self.last)
        return index[..., 0], index[..., 1]

    def steer(self, wanted: list[float]) -> None:
        """Turn to the wanted headings, give or take the noise; a robot that touches something turns back."""
        bumped = {robot for pair in self.touching() for robot in pair}
        for robot, heading in enumerate(wanted):
            back = self.random.uniform(math.pi / 2, math.pi * 3 / 2) if robot in bumped else 0
            self.headings[robot] = heading + back + self.random.normalvariate(0, self.noise)

    def move(self) -> float:
        """Drive on for a tick, mark the floor with the seconds spent on it, and return the energy spent [J]."""
        before, forces = self.positions, self.force * vectors(self.headings)
        self.data.ctrl[:] = forces.ravel()[self.model.jnt_dofadr[self.model.actuator_trnid[:, 0]]]
        mj.mj_step(self.model, self.data, nstep=self.steps)
        if self.data.warning.number.any():
            raise InputError(f"the physics became unstable at {self.data.time} s")
        np.add.at(self.pheromone, self.cells(self.positions), self.tick)
        return float(np.maximum((forces * (self.positions - before)).sum(axis=1), 0).sum())

    def _empty_floor(self) -> Floats:
        """The pheromone in each cell [s]: none, or infinitely much where a ray from above meets no floor."""
        floor, hit = self.model.geom("floor").id, np.zeros(1, np.int32)
        groups, down = np.array([1, 0, 0, 0, 0, 0], np.uint8), np.array([0.0, 0.0, -1.0])  # robots are in group 1
        pheromone = np.full(np.round(2 * self.half / self.cell).astype(int) + 2, np.inf)
        mj.mj_kinematics(self.model, self.data)
        for index in np.ndindex(pheromone.shape):
            above = np.array([*(np.array(index) - 0.5) * self.cell - self.half, 9.0])
            mj.mj_ray(self.model, self.data, above, down, groups, True, -1, hit)
            pheromone[index] = 0 if hit[0] == floor else np.inf
        return pheromone

    def _place(self) -> None:
        """Put the robots at random places where they touch nothing: who touches something is put elsewhere."""
        homeless = set(range(self.size))
        for _ in range(200):
            for robot in sorted(homeless):
                self.data.qpos[2 * robot : 2 * robot + 2] = [self.random.uniform(-half, half) for half in self.half]
            mj.mj_fwdPosition(self.model, self.data)
            homeless = {later for _, later in self.touching()}
            if not homeless:
                return
        raise InputError(f"there is no room for {self.size} robots")


def random_walk(swarm: Swarm) -> list[float]:
    """Go straight on; the noise makes it a correlated random walk."""
    return swarm.headings


def pheromone(swarm: Swarm) -> list[float]:
    """Go where the floor was visited least and no other robot is near, straight on rather than not."""
    here, ways = swarm.positions, vectors(WAYS)
    cost = -INERTIA * (vectors(swarm.headings)[:, None] * ways).sum(axis=2)
    for ahead in LOOK_AHEAD:
        cost += swarm.pheromone[swarm.cells(here[:, None] + ahead * ways)]
    apart = here[None] - here[:, None]
    distance = np.maximum(np.sqrt((apart**2).sum(axis=2)), 1e-9)
    near = (apart * (np.maximum(1 - distance / SIGHT, 0) / distance)[:, :, None]).sum(axis=1)
    cost += REPULSION * (near[:, None] * ways).sum(axis=2)
    return [WAYS[way] for way in cost.argmin(axis=1)]


CONTROLLERS = {"random_walk": random_walk, "pheromone": pheromone}


class Camera:
    """The camera `top`, which writes images as PNG."""

    def __init__(self, model: mj.MjModel, folder: Path, side: int = 480) -> None:
        self.renderer, self.folder = mj.Renderer(model, side, side), folder
        folder.mkdir(parents=True)

    def look(self, data: mj.MjData, tick: int) -> None:
        self.renderer.update_scene(data, "top")
        (self.folder / f"{tick}.png").write_bytes(png(self.renderer.render()))


def png(pixels: npt.NDArray[np.uint8]) -> bytes:
    """An image as PNG; the pixels are height x width x 3 bytes, and each row begins with its filter: none."""
    height, width, _ = pixels.shape
    rows = np.hstack([np.zeros((height, 1), np.uint8), pixels.reshape(height, -1)]).tobytes()
    header = struct.pack(">2I5B", width, height, 8, 2, 0, 0, 0)
    parts = [b"IHDR" + header, b"IDAT" + zlib.compress(rows, 1), b"IEND"]
    chunks = (struct.pack(">I", len(part) - 4) + part + struct.pack(">I", zlib.crc32(part)) for part in parts)
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunks)


def simulate(model: mj.MjModel, folder: Path, frames: Path | None = None) -> None:
    """Run the whole experiment and write its two files, and images into `frames`."""
    controller = text(model, "controller")
    if controller not in CONTROLLERS:
        raise InputError(f"there is no controller {controller!r}; use {' or '.join(CONTROLLERS)}")
    swarm, rate = Swarm(model), number(model, "ticks_per_second")
    contacts, energy, before = 0, 0.0, swarm.touching()
    folder.mkdir(parents=True, exist_ok=True)
    camera = Camera(model, frames) if frames else None
    with (folder / "swarm.csv").open("w", newline="") as one, (folder / "poses.csv").open("w", newline="") as other:
        rows, poses = csv.writer(one, lineterminator="\n"), csv.writer(other, lineterminator="\n")
        rows.writerow(["clock", "coverage", "contacts", "energy"])
        poses.writerow(["clock", "robot", "x", "y"])
        for tick in range(1, round(number(model, "duration", positive=True) * rate) + 1):
            swarm.steer(CONTROLLERS[controller](swarm))
            energy += swarm.move()
            now = {(a, b) for a, b in swarm.touching() if a >= 0}
            contacts, before = contacts + len(now - before), now
            rows.writerow([tick / rate, swarm.coverage, contacts, energy])
            if tick % max(1, round(rate)) == 0:
                poses.writerows([tick / rate, robot, *xy] for robot, xy in enumerate(swarm.positions.tolist()))
            if camera and tick % 2 == 0:
                camera.look(swarm.data, tick)


def number(model: mj.MjModel, name: str, *, positive: bool = False) -> float:
    """A `<custom><numeric>` of the input. Raises InputError where it is negative, or 0 and has to be positive."""
    value = float(model.numeric(name).data[0])
    if not 0 <= value < math.inf or (positive and value == 0):
        raise InputError(f"{name} must be {'positive' if positive else '0 or more'}, not {value}")
    return value


def text(model: mj.MjModel, name: str) -> str:
    """A `<custom><text>` of the input."""
    found = mj.mj_name2id(model, mj.mjtObj.mjOBJ_TEXT, name)
    if found < 0:
        raise InputError(f"the input has no text {name!r}")
    return bytes(model.text_data[model.text_adr[found] :]).split(b"\0")[0].decode()


def main(arguments: list[str]) -> None:
    """Simulate; say in one line what is wrong with the input."""
    if len(arguments) not in (2, 3):
        sys.exit("usage: python swarm.py INPUT.xml OUTPUT_FOLDER [FRAMES_FOLDER]")
    try:
        simulate(mj.MjModel.from_xml_path(arguments[0]), *map(Path, arguments[1:]))
    except (InputError, ValueError, KeyError, OSError, MemoryError, mj.FatalError) as error:
        sys.exit(f"{arguments[0]}: {' '.join(str(error.args[0] if isinstance(error, KeyError) else error).split())}")


if __name__ == "__main__":
    main(sys.argv[1:])
