"""A run of MuJoCo: `python mujoco_driver.py MODEL.xml FOLDER --seed 1 --duration 10 --interval 0.1 …`.

SIERRA lays this file beside the model of each run. It needs Python, MuJoCo and NumPy. It writes, each with a row per interval:

- `sensors.csv`, with a column for each value of the sensors;
- `joints.csv`, with a column for each position (qpos) of the joints;
- `bodies.csv`, with a row for each body: its position x, y, z in the world.

With `--frames FOLDER`, it also renders off screen: an image `FOLDER/NUMBER.png` for every so many intervals. Rendering changes
nothing of the simulation.

A controller may write files of its own.

One generator with the run's seed draws all random numbers: the noise of the first positions, the noise of the controls before
each step, and what the function `control(model, data, random)` of a controller draws before each step.
"""

from __future__ import annotations

import argparse
import csv
import ctypes.util
import math
import os
import runpy
import struct
import sys
import zlib
from collections.abc import Callable, Iterator
from fnmatch import fnmatchcase
from pathlib import Path

if "--frames" not in sys.argv:
    os.environ["MUJOCO_GL"] = "disable"  # physics alone: `import mujoco` need not look for a display
elif "MUJOCO_GL" not in os.environ:
    if not (ctypes.util.find_library("EGL") or ctypes.util.find_library("OSMesa")):
        sys.exit("rendering needs EGL or OSMesa, and neither is installed (Debian, Ubuntu: apt install libegl1 libgl1)")
    os.environ["MUJOCO_GL"] = "egl" if ctypes.util.find_library("EGL") else "osmesa"

import mujoco as mj
import numpy as np

XYZ, WXYZ = ("_x", "_y", "_z"), ("_w", "_x", "_y", "_z")
ENDINGS = {1: ("",), 3: XYZ, 4: WXYZ, 7: (*XYZ, "_qw", "_qx", "_qy", "_qz")}
QPOS = {mj.mjtJoint.mjJNT_FREE: 7, mj.mjtJoint.mjJNT_BALL: 4, mj.mjtJoint.mjJNT_SLIDE: 1, mj.mjtJoint.mjJNT_HINGE: 1}


class InputError(Exception):
    """The input cannot be simulated."""


class Simulation:
    """A model, its state, and what acts on it."""

    def __init__(self, given: argparse.Namespace) -> None:
        self.model = mj.MjModel.from_xml_path(given.model)
        self.data = mj.MjData(self.model)
        self.random = np.random.default_rng(given.seed)
        self.noise = given.control_noise
        self.controller = function(given.control) if given.control else None
        if given.keyframe:
            mj.mj_resetDataKeyframe(self.model, self.data, self.model.key(given.keyframe).id)
        if given.position_noise:
            mj.mj_integratePos(self.model, self.data.qpos, given.position_noise * self.random.standard_normal(self.model.nv), 1)
        self.look()
        self.first = self.data.ctrl.copy()

    def advance(self, steps: int) -> None:
        """Simulate some steps. Raises InputError if the physics becomes unstable."""
        if self.controller is None and not self.noise:
            mj.mj_step(self.model, self.data, nstep=steps)
        else:
            for _ in range(steps):
                self._act()
                mj.mj_step(self.model, self.data)
        if self.data.warning.number.any() or not np.isfinite(self.data.qpos).all():
            raise InputError(f"the physics became unstable at {self.data.time:g} s; use a smaller timestep")

    def look(self) -> None:
        """Compute what sensors measure now. What the next step begins with stays as it is, so that looking changes nothing."""
        before = self.data.qacc_warmstart.copy()
        mj.mj_forward(self.model, self.data)
        self.data.qacc_warmstart[:] = before

    def _act(self) -> None:
        self.data.ctrl[:] = self.first
        if self.controller is not None:
            self.controller(self.model, self.data, self.random)
        if self.noise:
            self.data.ctrl[:] += self.noise * self.random.standard_normal(self.model.nu)

    def chosen(self, kind: mj.mjtObj, count: int, wanted: list[str]) -> list[tuple[int, str]]:
        """Return the numbers and names of elements; `wanted` has names, and patterns such as `robot*`."""
        names = [mj.mj_id2name(self.model, kind, number) or f"unnamed_{number}" for number in range(count)]
        found: dict[int, str] = {}
        for text in wanted:
            fits = {number: name for number, name in enumerate(names) if name == text or fnmatchcase(name, text)}
            if not fits and text != "*":
                raise InputError(f"the model has no {text!r}; known are {', '.join(names[:8]) or 'none'}")
            found |= fits
        return list(found.items())


Row = list[object]
Recorded = tuple[str, list[str], Callable[[], Iterator[Row]]]
"""A file to write: its name, its columns, and the function that returns the rows of the current time."""


def function(path: str) -> Callable[..., object]:
    """Return the function `control` of a file. Raises InputError if it has none."""
    found = runpy.run_path(path).get("control")
    if not callable(found):
        raise InputError(f"{path} has no function control(model, data, random)")
    return found  # type: ignore[no-any-return]


def recorded(simulation: Simulation, given: argparse.Namespace) -> Iterator[Recorded]:
    """Yield the files that a run writes."""
    model, data = simulation.model, simulation.data
    sensors = simulation.chosen(mj.mjtObj.mjOBJ_SENSOR, model.nsensor, given.sensors)
    joints = simulation.chosen(mj.mjtObj.mjOBJ_JOINT, model.njnt, given.joints)
    bodies = simulation.chosen(mj.mjtObj.mjOBJ_BODY, model.nbody, given.bodies)
    if sensors:
        places = [(int(model.sensor_adr[n]), int(model.sensor_dim[n])) for n, _ in sensors]
        columns = [column for (_, name), (_, size) in zip(sensors, places, strict=True) for column in titles(name, size)]
        yield "sensors", columns, lambda: iter([values(data.sensordata, places)])
    if joints:
        spots = [(int(model.jnt_qposadr[n]), QPOS[mj.mjtJoint(model.jnt_type[n])]) for n, _ in joints]
        columns = [column for (_, name), (_, size) in zip(joints, spots, strict=True) for column in titles(name, size)]
        yield "joints", columns, lambda: iter([values(data.qpos, spots)])
    if bodies:
        yield "bodies", ["body", "x", "y", "z"], lambda: ([name, *data.xpos[number].tolist()] for number, name in bodies)


def titles(name: str, size: int) -> list[str]:
    return [name + ending for ending in ENDINGS.get(size, tuple(f"_{number}" for number in range(size)))]


def values(source: np.ndarray, places: list[tuple[int, int]]) -> Row:
    return [value for start, size in places for value in source[start : start + size].tolist()]


class Camera:
    """An off-screen renderer that writes images."""

    def __init__(self, model: mj.MjModel, folder: Path, name: str | None, size: list[int], every: int) -> None:
        """Render every so many intervals. Raises InputError for an unknown camera."""
        cameras = [mj.mj_id2name(model, mj.mjtObj.mjOBJ_CAMERA, number) for number in range(model.ncam)]
        if name and name not in cameras:
            raise InputError(f"the model has no camera {name!r}; known are {', '.join(filter(None, cameras)) or 'none'}")
        self._camera: str | int = name or (0 if cameras else -1)  # -1: the free camera, which sees the whole model
        self._folder, self._every = folder, every
        width, height = size
        model.vis.global_.offwidth = max(width, model.vis.global_.offwidth)
        model.vis.global_.offheight = max(height, model.vis.global_.offheight)
        self._renderer = mj.Renderer(model, height, width)
        folder.mkdir(parents=True)

    def look(self, data: mj.MjData, number: int) -> None:
        """Write an image, if one is wanted of this interval."""
        if number % self._every == 0:
            self._renderer.update_scene(data, self._camera)
            (self._folder / f"{number:06}.png").write_bytes(png(self._renderer.render()))


def png(pixels: np.ndarray) -> bytes:
    """Return an image as PNG; `pixels` are height × width × 3 bytes, and each row begins with its filter: none."""
    height, width, _ = pixels.shape
    rows = np.hstack([np.zeros((height, 1), np.uint8), pixels.reshape(height, -1)]).tobytes()
    header = struct.pack(">2I5B", width, height, 8, 2, 0, 0, 0)
    parts = [b"IHDR" + header, b"IDAT" + zlib.compress(rows, 1), b"IEND"]
    chunks = (struct.pack(">I", len(part) - 4) + part + struct.pack(">I", zlib.crc32(part)) for part in parts)
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunks)


def simulate(given: argparse.Namespace) -> None:
    """Run the whole simulation and write its files. Raises InputError."""
    simulation = Simulation(given)
    steps = round(given.interval / simulation.model.opt.timestep)
    if steps < 1 or not math.isclose(steps * simulation.model.opt.timestep, given.interval, rel_tol=1e-6):
        raise InputError(f"{given.interval:g} s is not a whole number of timesteps of {simulation.model.opt.timestep:g} s")
    files = list(recorded(simulation, given))
    if not files and simulation.controller is None:
        raise InputError("nothing would be recorded: the model has no sensors; choose joints or bodies")
    opened = [(given.folder / f"{name}.csv").open("w", newline="") for name, _, _ in files]
    writers = [csv.writer(file, lineterminator="\n") for file in opened]
    for writer, (_, columns, _) in zip(writers, files, strict=True):
        writer.writerow(["time", *columns])
    camera = Camera(simulation.model, given.frames, given.camera, given.size, given.every) if given.frames else None
    for number in range(round(given.duration / given.interval) + 1):
        if number:
            simulation.advance(steps)
            simulation.look()
        for writer, (_, _, rows) in zip(writers, files, strict=True):
            writer.writerows([round(number * given.interval, 9), *row] for row in rows())
        if camera:
            camera.look(simulation.data, number)
    for file in opened:
        file.close()


def main() -> None:
    """Simulate; print in one line what is wrong with the input."""
    parser = argparse.ArgumentParser()
    parser.add_argument("model")
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seed", type=int, required=True)
    for name in ("duration", "interval"):
        parser.add_argument(f"--{name}", type=float, required=True)
    for name in ("position-noise", "control-noise"):
        parser.add_argument(f"--{name}", type=float, default=0.0)
    for name in ("control", "keyframe", "camera"):
        parser.add_argument(f"--{name}")
    parser.add_argument("--frames", type=Path)
    parser.add_argument("--size", type=int, nargs=2, default=[640, 480])
    parser.add_argument("--every", type=int, default=1)
    for name in ("sensors", "joints", "bodies"):
        parser.add_argument(f"--{name}", nargs="*", default=[])
    given = parser.parse_args()
    try:
        simulate(given)
    except (InputError, ValueError, KeyError, OSError, mj.FatalError) as error:
        sys.exit(f"{given.model}: {' '.join(str(error.args[0] if error.args else error).split())}")


if __name__ == "__main__":
    main()
