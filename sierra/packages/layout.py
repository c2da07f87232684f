"""The names of the files in a package.

A package is a folder in one file. Its folder `project/` is an ordinary project of SIERRA with its store, so that every command
works in it once it is extracted.

    README.md                 first text to read
    REPRODUCING.md            the way to reproduce the results, for people
    reproduce.py              the same as a program on Python's standard library
    package.json              the same for programs; see sierra.packages.manifest
    manifest-sha256.txt       the hashes of all members; see sierra.packages.members
    ro-crate-metadata.json    the same as a Provenance Run Crate
    CITATION.cff  .zenodo.json  codemeta.json  LICENSE
    project/                  sierra.toml, sierra.lock, templates, the source of the newest batch, files that runs need
    project/.sierra/          the store with the packed batches
    project/figures/          figures and tables as they were drawn
    source/<tree, 12 digits>/ sources of the other batches
    source.bundle             the history of the sources, as git bundles it
    environment/              used-files.txt: files of the machine that runs used; image.tar  image.sif  wheels/
"""

from __future__ import annotations

from sierra.store.layout import STORE

README = "README.md"
REPRODUCING = "REPRODUCING.md"
PROGRAM = "reproduce.py"
PACKAGE = "package.json"
CRATE = "ro-crate-metadata.json"
PROJECT = "project/"
STORED = f"{PROJECT}{STORE}/"
SOURCE = "source/"
BUNDLE = "source.bundle"
ENVIRONMENT = "environment/"
IMAGE, SIF = f"{ENVIRONMENT}image.tar", f"{ENVIRONMENT}image.sif"
USED = f"{ENVIRONMENT}used-files.txt"
WHEELS = f"{ENVIRONMENT}wheels/"
