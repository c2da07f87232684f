"""How programs and environments are printed for people: what they are at a glance; --json has all of it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from sierra.wording import few

SHOWN = 12
LONGEST = 100


def print_programs(rows: Sequence[Mapping[str, Any]]) -> None:
    """Programs, distributions and files, a line each; libraries together."""
    from sierra.cli.output import readable, table

    loaded = [row for row in rows if row["kind"] == "library"]
    others = [row for row in rows if row["kind"] != "library"]
    print("\nprograms:")
    table(
        ("name", "version", "sha256", "path"),
        [(readable(row["name"]), _version(row), row["sha256"][:10], readable(row["path"])) for row in others],
    )
    if loaded:
        print(f"libraries: {few([row['name'] for row in loaded], SHOWN)}")


def _version(row: Mapping[str, Any]) -> str:
    from sierra.cli.output import readable

    lines = (row["version"] or "").splitlines()
    return f"{len(lines)} distributions" if lines[1:] else readable("".join(lines))[:LONGEST]


def print_environment(around: Mapping[str, Any]) -> None:
    """A line for each fact that there is."""
    from sierra.cli.output import fields

    print("\nenvironment:")
    fields({name: value for name, value in _facts(around) if value not in (None, "", [])}, "  ")


def _facts(around: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    from sierra.cli.output import readable

    for name, value in around.items():
        match name, value:
            case "memory", int():
                yield name, f"{value / 2**30:.1f} GiB"
            case "limits", dict():
                yield name, ", ".join(f"{limit} {soft}" for limit, (soft, _) in value.items() if soft is not None)
            case "variables", dict():
                yield from ((key, _cut(readable(text))) for key, text in value.items())
            case "distributions", list():
                yield name, len(value)
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
