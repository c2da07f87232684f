"""The names of the files in a package.

A package is a folder in one file. Its folder `project/` is an ordinary project of SIERRA with its store, so that every command
works in it once it is extracted.

    README.md                 the first text to read, which archives show
    REPRODUCING.md            instructions for evaluators; see sierra.packages.instructions
    reproduce.py              the program that verifies the package, on Python's standard library
    package.json              the description for programs; see sierra.packages.manifest
    manifest-sha256.txt       the hashes of all members; see sierra.packages.members
    ro-crate-metadata.json    the same as a Provenance Run Crate
    report.html               what the records say, as one page for a browser
    CITATION.cff
    project/                  sierra.toml, sierra.lock, templates, the source of the newest batch, files that runs need
    project/.sierra/          the store with the packed batches
    source/<tree, 12 digits>/ sources of the other batches
    source/history.bundle     the history of the recorded commits, for git clone
    figures/<batch>/          figures, tables and videos as they were made
    execution/                programs and jobs that execute the runs without SIERRA; see sierra.worker.execute_runs
    environment/              used-files.txt: files of the machine that runs used; images.json: container images
    environment/images/       container images, by id
    environment/sierra/       the wheel of the SIERRA that wrote the package, and requirements.txt, with which pip installs it
    environment/wheels/       Python packages, with their lock environment/requirements.lock
"""

from __future__ import annotations

from sierra.store.layout import FIGURES, STORE

README = "README.md"
INSTRUCTIONS = "REPRODUCING.md"
PROGRAM = "reproduce.py"
PACKAGE = "package.json"
REPORT = "report.html"
CRATE = "ro-crate-metadata.json"
PROJECT = "project/"
STORED = f"{PROJECT}{STORE}/"
SOURCE = "source/"
HISTORY = "source/history.bundle"
DRAWN = "figures/"
USED = "environment/used-files.txt"
EXECUTION = "execution/"
EXECUTOR = f"{EXECUTION}execute_runs.py"
PLAN = f"{EXECUTION}plan.json"
IMAGES = "environment/images.json"
IMAGE_FILES = "environment/images/"
SIERRA = "environment/sierra/"
OWN_REQUIREMENTS = f"{SIERRA}requirements.txt"
WHEELS = "environment/wheels/"
REQUIREMENTS = "environment/requirements.lock"


def drawn(file: str) -> str:
    """Return the member of a deliverable's file, which a record names relative to the project."""
    return DRAWN + file.removeprefix(f"{FIGURES}/")
