"""Several templates, or none: `templates = { world = "w.sdf", params = "p.yaml" }`.

The path of a change begins with the name of its template: `params:/speed`. What follows the colon begins with `/` or `(`, which
is not possible after the prefix of a name in XML, so that the two cannot be confused. If there is one template, the name may be
left out.

The generated files keep the paths of the templates, relative to the project: files that name each other by relative paths still
find each other in the folder of a run.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import ClassVar

from sierra.config.field_types import Table
from sierra.config.plugin_registry import NoOptions, Tables
from sierra.config.project_file import Project
from sierra.errors import ConfigError, Missing, TemplateError
from sierra.model import Change, Value
from sierra.templates.base import Document, Files, Rendered, Renderer, Template, read
from sierra.util.hashing import sha256
from sierra.util.lazy_definitions import dataclass, regex, replace
from sierra.util.regular_files import read_regular
from sierra.util.text import few, one_line

_PREFIX = regex(r"\s*([A-Za-z_]\w*):(?=[/(])")


def of_project(project: Project, root: Path) -> Template:
    """Return the template of a project; several, and none, are one too. Raises Missing, TemplateError, ConfigError."""
    if project.template is not None:
        return read(root / project.template, project.template_formats, project.template_format)
    return Templates({name: _part(root, name, path, project.template_formats) for name, path in project.templates.items()})


@dataclass(frozen=True, slots=True)
class Part:
    """One of several templates: its path in the project, and the template."""

    path: str
    template: Template


class Templates:
    """Several templates, or none, as one; see `sierra.templates.base.Template`."""

    Options: ClassVar[type[Table]] = NoOptions

    def __init__(self, parts: Mapping[str, Part]) -> None:
        self._parts = parts
        self.sha256 = sha256("".join(f"{name}\0{part.path}\0{part.template.sha256}\n" for name, part in parts.items()).encode())

    def reread(self, rendered: Rendered, name: str) -> Templates:
        if isinstance(rendered, bytes) or len(rendered) != len(self._parts):
            raise TemplateError(f"{name}: not the files of {len(self._parts)} templates")
        again = zip(self._parts.items(), rendered, strict=True)
        return Templates(
            {
                key: Part(part.path, part.template.reread(content, f"{name} ({part.path})"))
                for (key, part), (_, content) in again
            }
        )

    def find(self, path: str) -> tuple[str, ...]:
        name, inner = self._split(path, "")
        return self._parts[name].template.find(inner)

    def attributes(self) -> tuple[tuple[str, str], ...]:
        return tuple(
            (f"{name}:{path}", value) for name, part in self._parts.items() for path, value in part.template.attributes()
        )

    def changed(self, changes: Sequence[Change], values: Mapping[str, Value]) -> Documents:
        sorted_changes = self._sorted(changes)
        return Documents(
            self, {name: part.template.changed(sorted_changes[name], values) for name, part in self._parts.items()}
        )

    def per_run(self, documents: Mapping[str, Document], changes: Sequence[Change]) -> Renderer:
        """Return the function that makes a run's files from changed documents."""
        sorted_changes = self._sorted(changes)
        renderers = {name: document.per_run(sorted_changes[name]) for name, document in documents.items()}
        return lambda values: self.files(lambda name: renderers[name](values))

    def files(self, rendered: Callable[[str], Rendered]) -> Files:
        """Return the generated files with their names; `rendered` returns that of one template."""
        return tuple((os.path.normpath(part.path), _content(part.path, rendered(name))) for name, part in self._parts.items())

    def _sorted(self, changes: Sequence[Change]) -> Mapping[str, Sequence[Change]]:
        """Return the changes of each template, with paths in it."""
        found: dict[str, list[Change]] = {name: [] for name in self._parts}
        for change in changes:
            name, path = self._split(change.path, f"{change.why}: " if change.why else "")
            found[name].append(replace(change, path=path))
        return found

    def _split(self, path: str, why: str) -> tuple[str, str]:
        """Return the name of a template, and the path in it. Raises TemplateError."""
        known = ", ".join(f"{name}:" for name in self._parts)
        if not self._parts:
            raise TemplateError(f'{why}there is no template for {one_line(path)!r}; set template, or use "argument"')
        if prefix := _PREFIX.match(path):
            if prefix[1] not in self._parts:
                raise TemplateError(f"{why}{one_line(path)!r} names no template; known are {known}")
            return prefix[1], path[prefix.end() :]
        if len(self._parts) > 1:
            hint = f"begin it with one of {known} as in {next(iter(self._parts))}:/…"
            raise TemplateError(f"{why}{one_line(path)!r} does not say which template it is for; {hint}")
        return next(iter(self._parts)), path


class Documents:
    """Several templates after an experiment's changes; see `sierra.templates.base.Document`."""

    def __init__(self, templates: Templates, documents: Mapping[str, Document]) -> None:
        self._templates = templates
        self._documents = documents

    def render(self) -> Rendered:
        return self._templates.files(lambda name: self._documents[name].render())

    def per_run(self, changes: Sequence[Change]) -> Renderer:
        return self._templates.per_run(self._documents, changes)


def _content(path: str, rendered: Rendered) -> bytes:
    if not isinstance(rendered, bytes):
        raise TemplateError(f"{path}: its format gives {len(rendered)} files; it can only be the one template of a project")
    return rendered


def _part(root: Path, name: str, path: str, tables: Tables) -> Part:
    """Return one template. Raises ConfigError for a link, or for a name that the template uses as a prefix in XML."""
    file = root / path
    if file.resolve() != root.resolve() / os.path.normpath(path):
        raise ConfigError(f"templates.{name}: {path} is a link, or in one; name the file itself")
    template = read(file, tables)
    try:
        text = read_regular(file)
    except OSError as error:
        raise Missing(f"{one_line(str(file))}: {error.strerror}; cannot read the template") from error
    if re.search(rb"xmlns:%s\s*=" % name.encode(), text):
        raise ConfigError(f"templates.{name}: {name}: is also a prefix of names in {few([path], 1)}; use another name")
    return Part(path, template)
