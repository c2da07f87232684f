"""The programs around a run's command that `sierra.toml` declares: services, and commands before and after it.

`{services.NAME.port}` stands for the port of a service, in every command and in the variables of `[environment] set`. In the
service's own command and its `ready`, `{port}` is the same. Ports are chosen when a run is executed, and so they are no part of
an identity.
"""

from __future__ import annotations

import shlex
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from sierra.config.change_tables import OWN_PLACEHOLDERS, WORKER_NAMES
from sierra.config.execution_tables import ServiceTable
from sierra.config.project_file import Project
from sierra.design.run_values import Declared
from sierra.errors import ConfigError
from sierra.execution import commands
from sierra.model import Around, RunSpec, Service
from sierra.util.lazy_definitions import regex

KNOWN = tuple(name for name in OWN_PLACEHOLDERS if name != "arguments")
OF_ONE_RUN = ("input", "seed")
OWN_PORT = regex(r"(?<!\{)\{port\}")
PORT_LIKE = regex(r"(?<!\{)\{services\.[^{}]*\}")


def declared(config: Project, root: Path, values: Declared, *, contained: bool = False, produced: Sequence[str] = ()) -> Around:
    """Return what is executed around the command, in the form that is part of a run's identity.

    `values` and `produced`: see `commands.command`. Raises ConfigError for an unknown placeholder, service or path, and
    QueryError for a variable that the query does not vary.
    """

    of_run = (*KNOWN, *WORKER_NAMES, *values.names)

    def words(name: str, argv: Iterable[str], known: Sequence[str] = of_run) -> tuple[str, ...]:
        return commands.checked(
            argv, root, name, known, contained=contained, produced=produced, declared=values, project=config
        )

    def service(name: str, table: ServiceTable) -> Service:
        here, shared = f"[services.{name}]", table.scope == "batch"
        known = (*((placeholder for placeholder in KNOWN if placeholder not in OF_ONE_RUN) if shared else of_run), "port")
        texts = (*table.command, *table.ready.words)
        if shared and any(name in (*OF_ONE_RUN, *values.names) for text in texts for _, name in commands.NAMED.findall(text)):
            raise ConfigError(f'{here}: scope = "batch" excludes the input, the seed and values, which differ between runs')
        if shared and contained:
            raise ConfigError(f'{here}: scope = "batch" is not possible in containers, because each run has its own; remove it')
        kind, test = table.ready.kind, table.ready.words
        if kind in ("file", "command"):
            test = words(f"{here} ready", test, known)
        return Service(name, words(f"{here} command", table.command, known), (kind, *test), shared)

    return Around(
        tuple(words("before", argv) for argv in config.before),
        tuple(words("after", argv) for argv in config.after),
        tuple(service(name, table) for name, table in config.services.items()),
    )


def check_ports(config: Project, command: Sequence[str], around: Around) -> None:
    """Check that each port that a text names is that of a service, and that a service learns its port. Raises ConfigError."""
    texts = {"command": " ".join(command), "[environment] set": " ".join(config.environment.set.values())}
    texts |= {"before": _joined(around.before), "after": _joined(around.after)}
    texts |= {f"[services.{service.name}]": " ".join((*service.command, *service.ready[1:])) for service in around.services}
    names = {service.name for service in around.services}
    for where, text in texts.items():
        for placeholder in PORT_LIKE.findall(text):
            known = commands.PORT.fullmatch(placeholder)
            if known is None:
                raise ConfigError(f"{where}: unknown placeholder {placeholder}; known is {{services.NAME.port}}")
            if known[1] not in names:
                raise ConfigError(f"{where}: {placeholder} names no service; {_listed(names)}")
    for service in around.services:
        _check_own_port(service, config.environment.set, texts)


def _check_own_port(service: Service, variables: Mapping[str, str], texts: Mapping[str, str]) -> None:
    """Check that a service whose port is awaited, or used elsewhere, is told this port."""
    named = f"{{services.{service.name}.port}}"
    told = any(OWN_PORT.search(word) or named in word for word in service.command) or any(
        named in value for value in variables.values()
    )
    used = any(OWN_PORT.search(word) for word in service.ready[1:]) or any(named in text for text in texts.values())
    if used and not told:
        raise ConfigError(
            f"[services.{service.name}]: nothing tells the service its port; write {{port}} in its command, "
            f"or {named} in a variable of [environment] set"
        )


def described(spec: RunSpec) -> Mapping[str, str]:
    """Return lines for people, by name: `before`, `after`, `service NAME`, and `robots GROUP` for the commands of robots."""
    around = spec.around
    several = {"before": around.before, "after": around.after}
    lines = {name: "; ".join(map(shlex.join, argvs)) for name, argvs in several.items() if argvs}
    for service in around.services:
        kind, *test = service.ready
        scope = ", scope: batch" if service.shared else ""
        lines[f"service {service.name}"] = f"{shlex.join(service.command)}, ready: {kind} {shlex.join(test)}{scope}"
    return lines | {f"robots {group}": shlex.join(argv) for group, argv in (spec.robots or {}).items()}


def _joined(several: Iterable[Sequence[str]]) -> str:
    return " ".join(word for words in several for word in words)


def _listed(names: Iterable[str]) -> str:
    return f"known are {', '.join(sorted(names))}" if names else "there is no [services.NAME]"
