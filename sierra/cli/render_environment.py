"""Short printed forms of images, isolation, programs and environments; --json has everything."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from sierra.util.text import few

SHOWN = 12
LONGEST = 100


def print_programs(rows: Sequence[Mapping[str, Any]]) -> None:
    """Print programs, distributions and files, a line each, and libraries together."""
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


def print_image(image: Mapping[str, Any], reach: Sequence[str]) -> None:
    """Print the image in which runs executed, and the host resources that they could access."""
    from sierra.cli.output import fields, readable

    print("\nimage:")
    fields({name: readable(str(value)) for name, value in _image(image, reach) if value not in (None, "")}, "  ")
    lines = (image.get("recipe") or "").splitlines()
    for line in lines[:SHOWN]:
        print(f"    {_cut(readable(line.expandtabs()))}")
    if len(lines) > SHOWN:
        print(f"    … {len(lines) - SHOWN} more lines (--json has them all)")


def _image(image: Mapping[str, Any], reach: Sequence[str]) -> Iterator[tuple[str, Any]]:
    from sierra.cli.output import size

    yield "name", image.get("name", "not recorded")
    yield "id", image["image"]
    yield "host access", ", ".join(reach) or "none"
    if "packages" in image:
        counts = [f"{len(lines)} of {manager}" for manager, lines in image["packages"].items()]
        yield "kind", image["kind"]
        yield "architecture", image["architecture"]
        yield "packages", ", ".join(counts) or "none found by a package manager"
        yield "created", image["created"]
        yield "size", size(image["size"])
        yield "recipe", "" if not image["recipe"] else f"{len(image['recipe'].splitlines())} lines"


MODES = {"run": "one for each run", "worker": "one for all runs of a slot (weaker isolation)"}


def print_isolation(isolation: Mapping[str, Any]) -> None:
    """Print the isolation of executions, with emphasis on requested features that were not available."""
    from sierra.cli.output import fields, readable

    count = isolation.get("executions")
    executions = f" of {count} execution{'s' * (count != 1)}" if count else ""
    print(f"\nisolation {isolation['isolation'][:10]}{executions}:")
    fields({name: readable(str(value)) for name, value in _isolation(isolation) if value}, "  ")


def _isolation(isolation: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    if "engine" not in isolation:
        yield "engine", "not recorded"
        return
    yield "engine", isolation["engine"]
    yield "version", isolation["version"]
    yield "containers", MODES.get(isolation["mode"], isolation["mode"])
    yield "rootless", "yes" if isolation["rootless"] else "no"
    yield "user on the host", isolation["user"]
    yield "network", isolation["network"].upper() if isolation["network"] == "not isolated" else isolation["network"]
    yield "devices", ", ".join(isolation["devices"])
    yield "mounts", ", ".join(f"{target} from {source}" for target, source in isolation["mounts"].items())
    yield "limits enforced", _limits(isolation["limits_enforced"]) or "none"
    yield "limits monitored", _limits(isolation["limits_watched"])
    yield "LIMITS IGNORED", _limits(isolation["limits_ignored"])


def _limits(limits: Mapping[str, float]) -> str:
    from sierra.cli.output import size

    return ", ".join(f"{name} {size(int(value)) if name == 'memory' else f'{value:g}'}" for name, value in limits.items())


def print_environment(around: Mapping[str, Any]) -> None:
    """Print a line for each known fact of an environment."""
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
