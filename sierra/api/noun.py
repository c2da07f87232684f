"""Nouns: the parts of the Python interface, each with the methods of a project about one kind of thing."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from importlib import import_module
from types import FunctionType
from typing import TYPE_CHECKING, Any, TypeVar

if TYPE_CHECKING:
    from sierra.api.project import Project
    from sierra.config.project_file import LoadedProject
    from sierra.store.store import Store

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
            """Call the method of `Project` that had the name of this noun: see `sierra.api.former`."""
            from sierra.api import former

            return former.method(self._project, type(self).__name__.lower())(*arguments, **named)


class _ImportedNoun:
    """An attribute of `Project` with the class in the module of the same name, which is imported at the first use."""

    def __set_name__(self, owner: type, name: str) -> None:
        self._name = name

    def __get__(self, project: Project | None, owner: type) -> object:
        kind = getattr(import_module(f"sierra.api.{self._name}"), self._name.capitalize())
        if project is None:
            return kind
        return vars(project).setdefault(self._name, kind(project))


def noun() -> Any:
    """Return a noun as the value of an attribute of `Project` that is annotated with its class."""
    return _ImportedNoun()
