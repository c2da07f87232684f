"""The source of a project: its code, without the paths that SIERRA writes or hashes by their meaning."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

from sierra.config.project_file import LoadedProject
from sierra.containers.images.containerfile_folder import is_recipe
from sierra.errors import ConfigError
from sierra.provenance import source
from sierra.store.layout import BASELINES, CONFIG, DRAWN, FIGURES, LOCK, PROVENANCE, PYPROJECT, STORE, ProjectPaths, StorePaths
from sierra.util.hashing import sha256
from sierra.util.processors import ARCH, NAMES


def code(project: LoadedProject, *, dirty: str | None = None) -> source.Source:
    """Return the source of a project as it is now; `dirty` replaces the project's setting.

    The source always has the files of plug-ins of the project, as they were read. Raises ConfigError if it has not.
    """
    plugins = project.plugin_files()
    wanted, store = project.config.source, StorePaths(ProjectPaths(project.root).store)
    captured = source.capture(
        project.root,
        paths=wanted.paths,
        without=own_paths(project),
        code=tuple(plugins),
        prose=bool(wanted.paths) or project.config.build is not None,  # a build may read what describes the project
        dirty=dirty or wanted.dirty,
        git=wanted.git,
        large=wanted.max_untracked,
        memory=store.files if store.format.is_file() else None,
    )
    for path, content in plugins.items():
        if not source.holds(captured.manifest, path, content) and captured.converted.get(path) != sha256(content):
            raise ConfigError(_not_captured(captured, path))
    return captured


def _not_captured(captured: source.Source, path: str) -> str:
    """Return the message that a plug-in's file is not in the source as it is on disk."""
    start = f"[plugins]: {path} must be part of the source of runs"
    if os.fsencode(path) not in source.paths(captured.manifest):
        return f"{start}, but git ignores it, or it is beside the code, as in docs/ or in a repository of its own; move it"
    if captured.checkout:
        return f'{start}, but the file on disk is not the commit\'s, which [source] dirty = "ignore" executes; commit it'
    return f"{start}, but it has changed meanwhile; run the command again"


def own_paths(project: LoadedProject) -> tuple[str, ...]:
    """Return the paths that SIERRA writes, or whose meaning it hashes; they do not belong to the source."""
    return (
        STORE,
        LOCK,
        BASELINES,
        *_drawn(project.root),
        *_paper(project),
        CONFIG,
        PYPROJECT if project.file.name == PYPROJECT else CONFIG,
        *(path for template in project.config.template_paths for path in _inside(template)),
        *(table.file for table in project.config.tables.values() if table.file is not None),
        *(model.file for model in project.config.models.values() if model.file is not None),
        *_images(project),
    )


def _images(project: LoadedProject) -> Iterator[str]:
    """Yield the files of images for several processors, of which each host has those that it needs.

    The source leaves them out, because it would differ between hosts. The ids of the images are part of the identity anyway.
    """
    name = project.config.container.image if project.config.container else ""
    if ARCH in name:
        for one in (name.replace(ARCH, processor) for processor in NAMES):
            if not is_recipe(project.root / one):
                yield from _inside(one)


def not_in_checkouts(project: LoadedProject) -> tuple[str, ...]:
    """Return the files and folders of a project that no checkout of its source has, except those that git ignores."""
    return (*own_paths(project), ".git")


def _drawn(root: Path) -> list[str]:
    """Return the folders that figures were drawn to; other files in `figures` belong to the project."""
    return [f"{FIGURES}/{mark.parent.name}" for mark in ProjectPaths(root).figures.glob(f"*/{DRAWN}*")]


def _paper(project: LoadedProject) -> list[str]:
    """Return the folder of the paper, if `sierra paper` wrote it."""
    folder = project.config.paper.folder
    return _inside(folder) if (project.root / folder / PROVENANCE).is_file() else []


def _inside(template: str) -> list[str]:
    """Return the template's path if it is in the project.

    The source leaves it out, because the inputs that are made from it are hashed.
    """
    path = os.path.normpath(template)
    return [] if path.startswith((os.pardir, os.sep)) else [path]
