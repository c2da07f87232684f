"""Short printed forms of images, isolation, programs and environments; --json has everything."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING

from sierra.cli.output import fields, readable, table
from sierra.util.text import counted, few, size

if TYPE_CHECKING:
    from sierra.execution.row_queries import RecordedProgram
    from sierra.execution.shown_records import ShownEnvironment, ShownImage, ShownIsolation

SHOWN = 12
LONGEST = 100


def print_programs(programs: Sequence[RecordedProgram]) -> None:
    """Print programs, distributions and files, a line each, and libraries together."""

    libraries = [program.name for program in programs if program.kind == "library"]
    others = [program for program in programs if program.kind != "library"]
    print("\nprograms:")
    table(
        ("name", "version", "sha256", "path"),
        [(readable(row.name), readable(row.short_version)[:LONGEST], row.sha256[:10], readable(row.path)) for row in others],
    )
    if libraries:
        print(f"libraries: {few(libraries, SHOWN)}")


def print_image(image: ShownImage, reach: Sequence[str]) -> None:
    """Print the image in which runs executed, and the host resources that they could access."""

    print("\nimage:")
    fields({name: readable(value) for name, value in image.facts(reach).items() if value}, "  ")
    lines = ((image.row and image.row.recipe) or "").splitlines()
    for line in lines[:SHOWN]:
        print(f"    {_cut(readable(line.expandtabs()))}")
    if len(lines) > SHOWN:
        print(f"    … {len(lines) - SHOWN} more lines (--json has them all)")


MODES = {"run": "one for each run", "worker": "one for all runs of a slot (weaker isolation)"}


def print_isolation(isolation: ShownIsolation) -> None:
    """Print the isolation of executions, with emphasis on requested features that were not available."""

    executions = f" of {counted(isolation.executions, 'execution')}" if isolation.executions else ""
    print(f"\nisolation {isolation.isolation[:10]}{executions}:")
    fields({name: readable(value) for name, value in _isolation(isolation) if value}, "  ")


def _isolation(isolation: ShownIsolation) -> Iterator[tuple[str, str]]:
    row, limits = isolation.row, isolation.limits
    if row is None:
        yield "engine", "not recorded"
        return
    yield "engine", row.engine
    yield "version", row.version or ""
    yield "containers", MODES.get(row.mode, row.mode)
    yield "rootless", "yes" if row.rootless else "no"
    yield "user on the host", row.user or ""
    yield "network", row.network.upper() if row.network == "not isolated" else row.network
    yield "devices", ", ".join(row.devices)
    yield "mounts", ", ".join(f"{target} from {source}" for target, source in isolation.mounts.items())
    yield "limits enforced", _limits(limits["limits_enforced"]) or "none"
    yield "limits monitored", _limits(limits["limits_watched"])
    yield "LIMITS IGNORED", _limits(limits["limits_ignored"])


def _limits(limits: Mapping[str, float]) -> str:
    return ", ".join(f"{name} {size(int(value)) if name == 'memory' else f'{value:g}'}" for name, value in limits.items())


def print_environment(environment: ShownEnvironment) -> None:
    """Print a line for each known fact of an environment."""

    print("\nenvironment:")
    fields({name: value for name, value in _facts(environment.as_dict()) if value not in (None, "", [])}, "  ")


def _facts(environment: Mapping[str, object]) -> Iterator[tuple[str, object]]:
    for name, value in environment.items():
        match name, value:
            case "memory", int():
                yield name, f"{value / 2**30:.1f} GiB"
            case "limits", dict():
                yield name, ", ".join(f"{limit} {soft}" for limit, (soft, _) in value.items() if soft is not None)
            case "variables", dict():
                yield from ((key, _cut(readable(text))) for key, text in value.items())
            case "distributions", list():
                yield name, len(value)
            case "packages", str():
                yield name, len(value.splitlines())
            case (("environment" | "lock"), str()):
                yield name, value[:10]
            case _, list():
                yield name, few(value, SHOWN)
            case _, str():
                yield name, readable(value)
            case _:
                yield name, value


def _cut(text: str) -> str:
    return text if len(text) <= LONGEST else text[: LONGEST - 1] + "…"
