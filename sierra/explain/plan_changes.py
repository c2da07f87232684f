"""Differences between a plan and a recorded batch. The command line gives them words (`sierra.cli.render_reasons`)."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum


class Aspect(StrEnum):
    """The part of a plan that differs."""

    QUERY = "query"
    """A setting of the query; `name` is its name."""
    SET_ADDED = "set added"
    SET_REMOVED = "set removed"
    """A value that `--set` sets; `name` has it as XPATH=VALUE."""
    COMMAND = "command"
    AROUND = "around"
    """A command that is executed around the main one; `name` is `before`, `after` or `service NAME`."""
    VARIABLE = "variable"
    """A declared variable; `name` is its name."""
    PLATFORM = "platform"
    INPUT_NAMES = "input names"
    SHARED_FILES = "shared files"
    """Files beside the inputs of runs (`files` in `sierra.toml`); `details` lists those that differ."""
    IMAGE = "image"
    VARIANTS = "images by processor"
    PACKAGES = "packages"
    FILES = "files"
    """Packages or files of the image; `details` lists them."""
    SAME_CONTENT = "same content"
    """The images have other ids, but the same packages and files."""
    HOST_ACCESS = "host access"
    SOURCE = "source"
    """The code; `details` lists the files, unless they are not recorded."""
    EXCLUSIONS = "exclusions"
    """Advice on files that the source should leave out."""
    TEMPLATE = "template"
    NEW_TEMPLATE = "new template"
    NO_TEMPLATE = "no template"
    """There was no template before, or there is none now; `name` is the one that there was or is."""
    SETTINGS = "settings"
    """Nothing else differs, so that `sierra.toml` makes other inputs."""
    PROGRAM = "program"
    """A program outside source and image; `details` says how it differs."""


@dataclass(frozen=True, slots=True)
class PlanChange:
    """One difference, with the recorded and the new value."""

    aspect: Aspect
    name: str = ""
    was: str | int | None = None
    now: str | int | None = None
    details: tuple[str, ...] = ()


class Basis(StrEnum):
    """The batch, if any, with which a plan that has new runs is compared."""

    EMPTY_STORE = "empty store"
    SAME_BATCH = "same batch"
    """The batch is recorded; an earlier session ended before it executed the runs."""
    NOTHING = "nothing"
    """No batch with these variables is recorded."""
    BATCH = "batch"


@dataclass(frozen=True, slots=True)
class NewRuns:
    """The reason why runs of a plan are new: its differences from a recorded batch."""

    basis: Basis
    batch: str = ""
    query: str = ""
    changes: tuple[PlanChange, ...] = ()
