"""The part `environment/wheels/` of a package: wheels of the Python packages of SIERRA and of the project, for use offline.

pip downloads the wheels for each requested Python and processor, in the recorded versions, from the index that the user has
configured; no address of it is kept. `environment/requirements.lock` has the SHA-256 of each wheel. For this Python, pip then
resolves the lock from the wheels alone, as an offline installation will. pip's own wheel is there for a Python without pip.
SIERRA's own wheel is in the lock, too, but in the folder of `sierra.packages.parts.own_wheel`.
"""

from __future__ import annotations

import json
import os
import platform
import re
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from importlib import metadata
from pathlib import Path
from typing import NamedTuple

from sierra.errors import Missing
from sierra.ingest.recording_context import rules_of
from sierra.packages.layout import REQUIREMENTS, WHEELS
from sierra.packages.parts import own_wheel
from sierra.packages.parts.python_packages import Target, extras, needed, target
from sierra.packages.subject import Member, Options, PartResult, Subject
from sierra.provenance.dependency_model import normalized, versions
from sierra.provenance.pythons import OWN
from sierra.store import deliverable_records
from sierra.util.hashing import sha256_file

PIP = "pip"
HERE = Target(f"{sys.version_info[0]}.{sys.version_info[1]}", platform.machine())
RECORDED = """
SELECT e.distributions FROM sessions s JOIN environments e USING (environment)
WHERE e.distributions <> '' ORDER BY s.lamport DESC LIMIT 1
"""
"""SQL: the Python distributions of the newest session."""


DECLARED = "SELECT DISTINCT declared FROM ingest_rules"


class Wheel(NamedTuple):
    """A wheel: normalized name, version, SHA-256 and file."""

    name: str
    version: str
    sha256: str
    path: Path


def members(subject: Subject, packed: Mapping[str, Member]) -> PartResult:
    """Return the requested wheels and their lock. Raises Missing if pip does not find one, UsageError for a wrong target."""
    if not subject.options.wheels:
        return PartResult(())
    targets = _targets(subject.options)
    recorded = versions("".join(subject.store.values(str, RECORDED)))
    own = own_wheel.wheel(metadata.distribution(OWN), subject.folder / "sierra")
    used = extras(_libraries(subject), _formats(subject))
    wheels = {}
    for machine in targets:
        wanted = needed(subject.project.config.requires, machine, recorded, used)
        wheels[machine] = _download(subject.folder / f"wheels-{machine.python}-{machine.machine}", machine, wanted, own)
    if HERE in wheels:
        _resolve(subject.folder, wheels[HERE])
    files = {wheel.path.name: wheel.path for ones in wheels.values() for wheel in ones if wheel.path != own}
    collected = [Member(WHEELS + name, path, "Python package") for name, path in sorted(files.items())]
    return PartResult([*collected, Member(REQUIREMENTS, lock(wheels).encode(), "versions and SHA-256 of the Python packages")])


def _libraries(subject: Subject) -> Iterator[str]:
    """Yield the libraries that draw the declared figures, and those that have drawn deliverables of the packed batches."""
    from sierra.deliverables.figures.base import made_by

    for figure in subject.project.config.figures.values():
        yield from (text.partition("==")[0] for text in made_by(figure.kind))
    for batch in subject.batches:
        for row in deliverable_records.latest(subject.store, batch):
            yield from (text.partition("==")[0] for text in row.made_by)


def _formats(subject: Subject) -> Iterator[str]:
    """Yield the formats of the outputs that are declared now, or were when runs were recorded."""
    yield from (output.kind or "" for output in subject.project.config.outputs.values())
    for declared in subject.store.values(str, DECLARED):
        outputs, _, _ = rules_of(json.loads(declared))
        yield from (output.kind or "" for output in outputs.values())


def check(options: Options) -> None:
    """Raise UsageError for a wrong target, Missing if there is no pip here."""
    _targets(options)
    pip_version()


def _targets(options: Options) -> list[Target]:
    pythons, machines = options.pythons or (HERE.python,), options.machines or (HERE.machine,)
    return list(dict.fromkeys(target(python, machine) for python in pythons for machine in machines))


def lock(wheels: Mapping[Target, Sequence[Wheel]]) -> str:
    """Return requirements with hashes. Packages that not all targets need have markers. pip itself is not among them."""
    pinned: dict[tuple[str, str], dict[Target, str]] = {}
    for machine, of_target in wheels.items():
        for wheel in of_target:
            pinned.setdefault((wheel.name, wheel.version), {})[machine] = wheel.sha256
    lines = []
    for (name, version), hashes in sorted(pinned.items()):
        marker = "" if len(hashes) == len(wheels) else " ; " + " or ".join(machine.marker for machine in sorted(hashes))
        named = [f"--hash=sha256:{digest}" for digest in sorted(set(hashes.values()))]
        lines += [" \\\n    ".join([f"{name}=={version}{marker}", *named])] if name != PIP else []
    return "".join(f"{line}\n" for line in lines)


def _download(folder: Path, one: Target, wanted: Mapping[str, str], own: Path) -> list[Wheel]:
    """Download the wheels for a target; return all of it, with SIERRA's own wheel."""
    texts = [text for name, text in wanted.items() if name != OWN]
    folder.mkdir()
    _pip(str(one), "download", "--no-deps", *one.options(), "--dest", str(folder), *texts, f"{PIP}=={pip_version()}")
    return sorted(_wheels([*folder.iterdir(), own]))


def pip_version() -> str:
    """Return the version of pip here. Raises Missing if there is none."""
    try:
        return metadata.version(PIP)
    except metadata.PackageNotFoundError as error:
        raise Missing(f"wheels need pip, which {sys.executable} does not have; run: {sys.executable} -m ensurepip") from error


def _wheels(paths: Sequence[Path]) -> Iterator[Wheel]:
    from packaging.utils import parse_wheel_filename

    for path in paths:
        name, version, _, _ = parse_wheel_filename(path.name)
        yield Wheel(normalized(name), str(version), sha256_file(path), path)


def _resolve(folder: Path, wheels: Sequence[Wheel]) -> None:
    """Let pip resolve the lock with nothing but the wheels. Raises Missing for a package that is lacking."""
    requirements = folder / "requirements.lock"
    requirements.write_text(lock({HERE: wheels}), "utf-8")
    places = [word for path in sorted({str(wheel.path.parent) for wheel in wheels}) for word in ("--find-links", path)]
    words = ["--only-binary", ":all:", "--no-index", *places, "--require-hashes", "--requirement", str(requirements)]
    _pip(str(HERE), "download", *words, "--dest", str(folder / "resolved"), isolated=True)


def _pip(what: str, *words: str, isolated: bool = False) -> None:
    """Run pip. `isolated`: without the user's settings. Raises Missing with pip's reason, without addresses."""
    command = [
        sys.executable,
        "-P",
        "-m",
        "pip",
        *(("--isolated",) if isolated else ()),
        "--no-input",
        "--disable-pip-version-check",
    ]
    environment = {**os.environ, "PIP_NO_COLOR": "1", "LC_ALL": "C.UTF-8"}
    done = subprocess.run([*command, *words], env=environment, capture_output=True, text=True, errors="replace", check=False)
    if done.returncode:
        lines = done.stderr.strip().splitlines() or ["it printed no error"]
        reason = next((line for line in reversed(lines) if line.startswith("ERROR: ")), lines[-1]).removeprefix("ERROR: ")
        raise Missing(f"no wheels for {what}: {re.sub(r'[a-z+]+://[^ ]+', '(address)', reason)}")
