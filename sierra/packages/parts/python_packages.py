"""The Python packages that SIERRA and a project need on a given Python and processor, from the metadata of the installed ones.

pip evaluates markers for the Python that executes it and not for another one that is requested. So the needed packages are
computed here, and pip gets names and versions only.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from importlib import metadata
from typing import TYPE_CHECKING, NamedTuple

from sierra.errors import UsageError
from sierra.provenance.dependency_model import normalized
from sierra.provenance.pythons import OWN

if TYPE_CHECKING:
    from packaging.requirements import Requirement

DRAWING = ("figures", "embedding")
"""SIERRA's extras with libraries that draw."""
READING = {"hdf5": "hdf5", "netcdf": "netcdf", "bag": "bags"}
"""SIERRA's extras that read outputs, by the format of these."""
GLIBC = (*range(28, 4, -1), *range(29, 42))
"""Minor versions of glibc 2 that wheels may need, the preferred ones first: most systems have 2.28."""
OLD = ("manylinux2014", "manylinux2010", "manylinux1", "linux")


class Target(NamedTuple):
    """A version of Python, as 3.12, and a processor by the kernel's name, as x86_64."""

    python: str
    machine: str

    def __str__(self) -> str:
        return f"Python {self.python} on {self.machine}"

    @property
    def marker(self) -> str:
        """The marker of this target in a list of requirements (PEP 508)."""
        return f'(python_version == "{self.python}" and platform_machine == "{self.machine}")'

    def options(self) -> Iterator[str]:
        """Yield the options with which pip chooses wheels for it."""
        yield from ("--only-binary", ":all:", "--implementation", "cp", "--python-version", self.python)
        for minor in GLIBC:
            yield from ("--platform", f"manylinux_2_{minor}_{self.machine}")
        for name in OLD:
            yield from ("--platform", f"{name}_{self.machine}")


def target(python: str, machine: str) -> Target:
    """Return a target. Raises UsageError for texts that are no version and no processor."""
    if not re.fullmatch(r"3\.\d{1,2}", python):
        raise UsageError(f"--python: {python!r} is not a version of Python such as 3.12")
    if not re.fullmatch(r"[a-z0-9_]{2,20}", machine):
        raise UsageError(f"--arch: {machine!r} is not a processor such as x86_64 or aarch64")
    return Target(python, machine)


def needed(requires: Iterable[str], target: Target, recorded: Mapping[str, str], extras: Iterable[str] = ()) -> dict[str, str]:
    """Return the needed packages as pip takes them, by normalized name: SIERRA, `requires`, and all that they require.

    `extras` are SIERRA's own that are needed, too. Versions are those in `recorded`, else the installed ones. A package
    that is not installed here has no version, only what is required of it.
    """
    from packaging.requirements import Requirement

    lines: dict[str, str] = {}
    waiting = [Requirement(f"{OWN}[{','.join(sorted(extras))}]"), *_that_apply(requires, "", target)]
    seen: set[tuple[str, str]] = set()
    while waiting:
        requirement = waiting.pop()
        name = normalized(requirement.name)
        installed = _installed(name)
        if installed is None:
            lines.setdefault(name, f"{name}{requirement.specifier}")
            continue
        lines[name] = f"{name}=={_version(installed, recorded)}"
        for extra in {"", *requirement.extras} - {of for of_name, of in seen if of_name == name}:
            seen.add((name, extra))
            waiting += _that_apply(installed.requires or (), extra, target)
    return dict(sorted(lines.items()))


def _version(installed: metadata.Distribution, recorded: Mapping[str, str]) -> str:
    name = normalized(installed.name)
    return installed.version if name == OWN else recorded.get(name, installed.version)


def _installed(name: str) -> metadata.Distribution | None:
    try:
        return metadata.distribution(name)
    except metadata.PackageNotFoundError:
        return None


def _that_apply(texts: Iterable[str], extra: str, target: Target) -> Iterator[Requirement]:
    """Yield the requirements whose markers are true for a target and an extra."""
    from packaging.requirements import Requirement

    environment = {
        "python_version": target.python,
        "python_full_version": f"{target.python}.0",
        "implementation_version": f"{target.python}.0",
        "platform_machine": target.machine,
    }
    for requirement in map(Requirement, texts):
        if requirement.marker is None or requirement.marker.evaluate({**environment, "extra": extra}):
            yield requirement


def extras(libraries: Iterable[str], formats: Iterable[str]) -> set[str]:
    """Return SIERRA's extras with any of these libraries that draw, and those that read outputs of these formats."""
    from packaging.requirements import Requirement

    wanted = {normalized(name) for name in libraries}
    requirements = [Requirement(text) for text in metadata.distribution(OWN).requires or ()]
    drawing = {
        extra
        for extra in DRAWING
        for requirement in requirements
        if requirement.marker and f'extra == "{extra}"' in str(requirement.marker) and normalized(requirement.name) in wanted
    }
    return drawing | {READING[format] for format in formats if format in READING}
