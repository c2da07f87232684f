"""Robots that cannot take part in the same run, although each of them works."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import combinations

from sierra.errors import Missing


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
