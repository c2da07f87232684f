"""Nouns: the parts of the Python interface, each with the methods of a project about one kind of thing.

Also the former names of these methods, and defaults that several of them share.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from functools import wraps
from importlib import import_module
from types import FunctionType
from typing import TYPE_CHECKING, Any, TypeVar

from sierra.errors import UsageError

if TYPE_CHECKING:
    from sierra.api.project import Project
    from sierra.config.project_file import LoadedProject
    from sierra.execution.observer import Observer
    from sierra.store.store import Store


def observer_for(wanted: bool | None) -> Observer:
    """Return the observer that shows the progress of executions, if that is `wanted`; None: in terminals and notebooks."""
    from sierra.execution import progress_display as progress

    return progress.observer(wanted)


def slots(jobs: int | None) -> int:
    """Return the number of runs at a time: `jobs`, or the user's setting, or the number of cores that this process has.

    Raises UsageError for less than 1.
    """
    from sierra.config import user
    from sierra.worker.machine import granted_cores

    slots = (user.load().jobs or granted_cores()) if jobs is None else jobs
    if slots < 1:
        raise UsageError(f"cannot execute {slots} runs at a time; use 1 or more")
    return slots


T = TypeVar("T")


def within_project(owner: type[T]) -> type[T]:
    """Let the plug-ins of a project count in all public methods of a class: see `sierra.config.current_project`."""
    for name, method in vars(owner).items():
        if isinstance(method, FunctionType) and not name.startswith("_"):
            setattr(owner, name, _within(method))
    return owner


def _within(method: Callable[..., Any]) -> Callable[..., Any]:
    @wraps(method)
    def call(owner: Project | Noun, *arguments: Any, **named: Any) -> Any:
        with owner._plugins():
            return method(owner, *arguments, **named)

    return call


class Noun:
    """Methods of a project about one kind of thing."""

    def __init_subclass__(cls) -> None:
        within_project(cls)

    def __init__(self, project: Project) -> None:
        self._project = project
        self._plugins = project._plugins

    @property
    def _loaded(self) -> LoadedProject:
        return self._project.loaded

    @property
    def _store(self) -> Store:
        return self._project.store

    def __repr__(self) -> str:
        return f"{self._project!r}.{type(self).__name__.lower()}"

    if not TYPE_CHECKING:

        def __call__(self, *arguments: object, **named: object) -> object:
            """Call the method of `Project` that had the name of this noun, if there was one."""
            name = type(self).__name__.lower()
            if name not in FORMER:
                raise TypeError(f"project.{name} is no method; dir(project.{name}) lists its methods")
            return former_method(self._project, name)(*arguments, **named)


class _ImportedNoun:
    """An attribute of `Project` with the class of the same name in a module, which is imported at the first use."""

    def __init__(self, module: str) -> None:
        self._module = module

    def __set_name__(self, owner: type, name: str) -> None:
        self._name = name

    def __get__(self, project: Project | None, owner: type) -> object:
        kind = getattr(import_module(f"sierra.api.{self._module or self._name}"), self._name.capitalize())
        if project is None:
            return kind
        return vars(project).setdefault(self._name, kind(project))


def noun(module: str = "") -> Any:
    """Return a noun as the value of an attribute of `Project` that is annotated with its class.

    `module` has the class; by default, it is the module with the name of the noun.
    """
    return _ImportedNoun(module)


MOVED = {
    "plans": "plans=of_targets resolve build write_inputs proposal=estimate runner_of=runner check_attended",
    "studies": "study=run planned_study=planned runs_needed runs_for_power",
    "jobs": "status left attach cancel",
    "records": "batch record_id=id show files outputs declare_outputs why diff removal remove",
    "deliverables": "figures draw draw_batches draw_together=draw_targets "
    "check_figures=check deliverable=find report model_errors",
    "comparisons": "compare=make compare_declared=declared groups_of=groups draw_comparison=draw paper_comparison=text",
    "claims": "claims=evaluate register_claims=register claims_against=against set_baseline",
    "paper": "paper=write check_paper=check paper_queries=queries paper_table=table",
    "packages": "package=pack import_package=import_records diff_packages=diff metadata",
    "images": "images=known image=contents image_name=name pin pin_all "
    "build_image=build import_image=import_archive export_image=export",
    "sources": "push_sources=push fetch_sources=fetch",
    "maintenance": "fsck repair collection collect",
}
"""The methods of each noun that `Project` had: with the same name, or as `former=new`."""
FORMER = {
    former: f"{noun}.{new or former}"
    for noun, words in MOVED.items()
    for former, _, new in (word.partition("=") for word in words.split())
}
"""The new name of each method, as `noun.method`. The former names go in version 0.2."""


def former_method(project: Project, name: str) -> Any:
    """Return the method of a project that has this former name; warn the caller's caller."""
    noun, _, new = FORMER[name].partition(".")
    text = f"project.{name} is now project.{noun}.{new}; the former name goes in version 0.2"
    warnings.warn(text, DeprecationWarning, stacklevel=3)
    return getattr(getattr(project, noun), new)
