"""Robots that cannot take part in the same run, although each of them works."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import combinations

from sierra.errors import Missing
from sierra.runners.robots.agent_messages import Record


def check_addresses(addresses: Mapping[str, str | None]) -> None:
    """Raise Missing if two robots have one address, at which programs would reach only one of them.

    `addresses` are those of the robots of a run, by name; None if one is unknown. Two virtual machines behind forwarded ports,
    for example, may have the same address, each in a network of its own.
    """
    for (one, address), (other, same) in combinations(addresses.items(), 2):
        if address is not None and address == same:
            raise Missing(
                f"{one} and {other} have the same address {address}; give each an address by which the other robots reach it: "
                f'{other} = {{ host = …, address = "…" }} in [runners.robots.fleet]'
            )


def check_time_zones(hellos: Mapping[str, Record]) -> None:
    """Raise Missing if local time differs between two robots, unless both have a TZ of their own.

    `hellos` are the answers of the robots of a run, by name.
    """
    for (one, first), (other, second) in combinations(hellos.items(), 2):
        zones = {_zone(first), _zone(second)}
        if first["utc_offset"] != second["utc_offset"] and not (len(zones) == 2 and None not in zones):
            raise Missing(
                f"{one} ({_shown(first)}) and {other} ({_shown(second)}) have different time zones, and local times on them "
                'differ; declare variables = { TZ = "UTC" } in [runners.robots]'
            )


def _zone(hello: Record) -> str | None:
    """Return the time zone that `variables` or the setup line have set; None without one."""
    zone: str | None = hello["variables"].get("TZ")
    return zone


def _shown(hello: Record) -> str:
    minutes = abs(hello["utc_offset"]) // 60
    sign = "-" if hello["utc_offset"] < 0 else "+"
    return f"{_zone(hello) or hello['facts']['timezone']}, UTC{sign}{minutes // 60:02d}:{minutes % 60:02d}"
