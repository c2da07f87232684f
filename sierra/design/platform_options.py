"""Options of the platform that controllers and scenarios set, merged over `[platforms.NAME]`.

They are no part of an identity themselves: only what the platform makes of them is, in the inputs and in the command. One
platform drives all runs of a batch, so the controllers and scenarios of one axis must have the same options.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from sierra.config import group_names
from sierra.config.change_tables import Group
from sierra.config.field_types import RawTable
from sierra.config.plugin_registry import PLATFORMS
from sierra.config.project_file import Project
from sierra.errors import ConfigError, QueryError
from sierra.model import Listed, Query

KINDS = ("controller", "scenario")


def merged(project: Project, query: Query) -> Project:
    """Return the project with the options that the controller and the scenario of a query set.

    Raises ConfigError for an invalid option of any of them, QueryError if those of one axis differ.
    """
    for kind in KINDS:
        _check(project, kind)
    options = project.platforms.get(project.platform, {})
    for kind in KINDS:
        several = [_of_group(project, kind, name) for name in _chosen(project, query, kind)]
        for name, chosen in zip(_chosen(project, query, kind), several, strict=True):
            if chosen != several[0]:
                first = _chosen(project, query, kind)[0]
                raise QueryError(
                    f"{kind}s {first!r} and {name!r} have different options of the platform {project.platform!r}, "
                    f"which are the same for all runs of a batch; use one of them per query, with --{kind}"
                )
        options = {**options, **(several[0] if several else {})}
    if options == project.platforms.get(project.platform, {}):
        return project
    return project.model_copy(update={"platforms": {**project.platforms, project.platform: options}})


def _chosen(project: Project, query: Query, kind: str) -> list[str]:
    """Return the names of the controllers or scenarios of a query."""
    for criterion in query.criteria:
        if criterion.name == kind:
            return [str(value) for value in criterion.scale.values] if isinstance(criterion.scale, Listed) else []
    name = getattr(query, kind) or getattr(project, kind)
    return [name] if name else []


def _groups(project: Project, kind: str) -> Mapping[str, Group]:
    return project.controllers if kind == "controller" else project.scenarios


def _of_group(project: Project, kind: str, name: str) -> RawTable:
    """Return the options of a controller or scenario, with those of its categories."""
    groups = _groups(project, kind)
    found = group_names.resolve(name, groups)
    declared = found[0].declared if len(found) == 1 else ()
    return {key: value for one in declared for key, value in groups[one].platform.items()}


def _check(project: Project, kind: str) -> None:
    """Check the options of each controller or scenario, also of those that the query does not use."""
    for name, own in _with_options(project, kind):
        try:
            PLATFORMS.options(project.platform, {**project.platforms.get(project.platform, {}), **own})
        except ConfigError as error:
            raise ConfigError(f"{kind} {name!r}: {error}") from error


def _with_options(project: Project, kind: str) -> Iterator[tuple[str, RawTable]]:
    for name, group in _groups(project, kind).items():
        if group.platform:
            yield name, _of_group(project, kind, name) or group.platform
