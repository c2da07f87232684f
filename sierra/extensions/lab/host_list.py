"""The hosts of the labs of a project, for `sierra doctor --hosts`."""

from __future__ import annotations

from sierra.config.project_file import Project
from sierra.extensions.hosts.host_checks import HostToCheck
from sierra.extensions.lab.lab_table import LabTable
from sierra.runners import schedulers


def of_labs(project: Project, link: str | None) -> dict[str, HostToCheck]:
    """Return the hosts of all labs by name; `link` is the link to use, by default that of each lab."""
    hosts: dict[str, HostToCheck] = {}
    for name, settings in project.runners.items():
        if settings.get("scheduler", name) != "lab":
            continue
        table = schedulers.table("lab", settings, name)
        assert isinstance(table, LabTable)  # noqa: S101 - it is validated by `Lab.Options`
        chosen = link or table.link
        options = {**project.links.get(chosen, {}), **(table.link_options if chosen == table.link else {})}
        for host in table.listed():
            hosts[host] = HostToCheck(host, host, chosen, options, python=table.python, folder=table.folder)
    return hosts
