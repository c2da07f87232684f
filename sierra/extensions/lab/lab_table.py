"""The table of a lab in `sierra.toml`, and the lists of hosts in it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, NamedTuple, Self

from pydantic import Field, StringConstraints, model_validator

from sierra.config import find_project
from sierra.config.cluster_table import ClusterTable
from sierra.config.field_types import Line
from sierra.errors import ConfigError
from sierra.util.lazy_definitions import regex

OF_CLUSTERS = (
    *("array_tasks", "cpus", "memory", "wall", "partition", "account", "qos", "constraint", "gpus", "modules", "directives"),
    "cancelled",
)
"""Keys of other clusters that a lab does not have."""
SLOTS_BEFORE = regex(r"(\d+)/(.+)")
SLOTS_AFTER = regex(r"([^:@]+):(\d+)")
HOST = regex(r"[A-Za-z0-9_.%:@\[\]-]+")


class Host(NamedTuple):
    """A host as it is listed."""

    name: str
    """A name of the user's OpenSSH configuration, or `user@host:port`."""
    slots: int | None
    """The number of runs at a time; None: one for each core."""


class LabTable(ClusterTable):
    """A lab: hosts that are reached over SSH, without a scheduler and without a shared file system."""

    hosts: tuple[Line, ...] = Field(
        (),
        description="the hosts, as in `ssh NAME`, each with its number of runs at a time: `pc1` (one for each core), "
        "`pc2:8`, or `8/user@pc2:22`",
        examples=[["pc1", "pc2:8"]],
    )
    hosts_file: Line | None = Field(
        None,
        description="a file with more hosts, one a line, as GNU parallel reads it (`--sshloginfile`); it is read again when it "
        "changes; a relative path begins in the project",
        examples=["hosts.txt"],
    )
    link: Line = Field("openssh", description="the link to all hosts: `openssh` or `fabric`")
    link_options: Mapping[str, Any] = Field(
        default_factory=dict, description="options of the link, before those in `[links]`", examples=[{"connect": 10.0}]
    )
    folder: Annotated[str, StringConstraints(pattern=r"^(~/)?[A-Za-z0-9/._+@-]+$")] = Field(
        ".cache/sierra-lab", description="folder on each host: absolute, or within the home folder there"
    )
    lease: Annotated[float, Field(ge=10, le=86400)] = Field(
        300.0,
        description="time in seconds for which a host goes on without a connection; after it, its runs are ended there, and "
        "executed elsewhere",
    )

    @model_validator(mode="after")
    def _is_lab(self) -> Self:
        if other := [key for key in OF_CLUSTERS if getattr(self, key) != type(self).model_fields[key].default]:
            raise ValueError(f"{other[0]}: a lab has no such setting; hosts say how many runs they execute at a time")
        if not self.hosts and self.hosts_file is None:
            raise ValueError('a lab needs hosts = ["pc1", …], or hosts_file')
        for text in self.hosts:
            host_of(text)
        return self

    def listed(self) -> dict[str, Host]:
        """Return the hosts by name. Raises ConfigError for a line that names no host, or for two lines for one host."""
        hosts: dict[str, Host] = {}
        for host in (*map(host_of, self.hosts), *self._in_file()):
            if host.name in hosts:
                raise ConfigError(f"host {host.name!r} is listed twice; list it once, with its number of runs at a time")
            hosts[host.name] = host
        return hosts

    @property
    def file(self) -> Path | None:
        """The path of the file with hosts."""
        if self.hosts_file is None:
            return None
        path = Path(self.hosts_file).expanduser()
        return path if path.is_absolute() else find_project.find_store(Path()).root / path

    def _in_file(self) -> Iterator[Host]:
        if self.file is None:
            return
        try:
            lines = self.file.read_text("utf-8").splitlines()
        except (OSError, UnicodeDecodeError) as error:
            reason = error.strerror if isinstance(error, OSError) else "it is no text in UTF-8"
            raise ConfigError(f"hosts_file: {self.file} cannot be read: {reason}") from error
        for number, line in enumerate(lines, 1):
            if (text := line.partition("#")[0].strip()) != "":
                try:
                    yield host_of(text)
                except ValueError as error:
                    raise ConfigError(f"{self.file}, line {number}: {error}") from error


def host_of(text: str) -> Host:
    """Return the host in a text such as `pc1`, `pc2:8` or `8/user@pc2:22`. Raises ValueError."""
    name, slots = text.strip(), None
    if match := SLOTS_BEFORE.fullmatch(name):
        slots, name = int(match[1]), match[2]
    elif match := SLOTS_AFTER.fullmatch(name):
        name, slots = match[1], int(match[2])
    if slots == 0:
        raise ValueError(f"{text!r} has 0 runs at a time; remove the host to use it no more")
    if name == ":" or name.startswith("@") or not HOST.fullmatch(name) or name.startswith("-"):
        raise ValueError(
            f"{text!r} names no host; write NAME, NAME:RUNS or RUNS/USER@NAME:PORT (use --on local for this machine)"
        )
    return Host(name, slots)


def sizes(durations: Sequence[float], slots: int) -> Sequence[int]:
    """Return the numbers of runs of the shares into which runs of these durations are divided, in this order.

    A share has a part of the time that is left: 1 / (2 * slots). This is guided self-scheduling (Polychronopoulos and Kuck,
    1987) with shares of half the size. A slot takes a share whenever it is free, so faster hosts take more of them, and the
    last shares are single runs, so that all slots end at about the same time.
    """
    shares: list[int] = []
    left, taken, count = sum(durations), 0.0, 0
    for duration in durations:
        taken, count = taken + duration, count + 1
        if taken * 2 * slots >= left * (1 - 1e-9):
            shares.append(count)
            left, taken, count = left - taken, 0.0, 0
    return [*shares, count] if count else shares
