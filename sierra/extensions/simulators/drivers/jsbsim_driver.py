"""A flight of JSBSim: `python jsbsim_driver.py SCRIPT.xml FOLDER [--root FOLDER]` writes the script's outputs into the folder.

SIERRA lays this file beside the script of each run. It needs Python and JSBSim. Aircraft come from the installed package, or
from the root folder. The program `jsbsim` omits columns of unknown properties; this one fails.
"""

from __future__ import annotations

import argparse
import math
import os
import sys
from xml.etree import ElementTree

os.environ.setdefault("JSBSIM_DEBUG", "0")

import jsbsim


class InputError(Exception):
    """The script cannot be simulated."""


def fly(script: str, folder: str, root: str | None) -> None:
    """Simulate the whole script. Raises InputError."""
    executive = jsbsim.FGFDMExec(root)
    executive.set_output_path(folder)
    if not executive.load_script(script) or not executive.run_ic():
        raise InputError("JSBSim cannot load the script, or the aircraft that it uses")
    names = [(element.text or "").strip() for element in ElementTree.parse(script).iterfind("output/property")]  # noqa: S314
    known = executive.get_property_manager()
    for name in names:
        if not known.hasNode(name):
            raise InputError(f"there is no property {name!r}, which an output names")
    while executive.run():
        pass
    for name in names:
        if not math.isfinite(executive[name]):
            raise InputError(f"the property {name!r} became {executive[name]}; use a smaller dt")


def main() -> None:
    """Simulate; print in one line what is wrong with the script."""
    parser = argparse.ArgumentParser()
    parser.add_argument("script")
    parser.add_argument("folder")
    parser.add_argument("--root")
    given = parser.parse_args()
    try:
        fly(given.script, given.folder, given.root)
    except (InputError, RuntimeError, OSError, ElementTree.ParseError) as error:
        sys.exit(f"{given.script}: {' '.join(str(error).split())}")


if __name__ == "__main__":
    main()
