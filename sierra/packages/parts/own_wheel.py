"""The part `environment/sierra/` of a package: SIERRA's own wheel, and the requirements with which it is installed.

The wheel is made from the installed files, also of an editable installation, so that the package has the SIERRA that wrote it.
The same files give the same bytes, whatever the versions of zlib and of Python are: nothing in it is compressed, and all times
are fixed. The zip of the package compresses it. The requirements are those of SIERRA's lock, which is in its metadata, with the
SHA-256 of each file of each of them. A package never comes with them unasked to whoever reads it: only pip installs them.
"""

from __future__ import annotations

import base64
import csv
import hashlib
import io
import json
import re
import zipfile
from collections.abc import Iterable, Iterator, Mapping
from importlib import metadata
from pathlib import Path
from typing import NamedTuple

from sierra.errors import Missing
from sierra.packages.archive import info
from sierra.packages.layout import OWN_REQUIREMENTS, SIERRA
from sierra.packages.parts.python_packages import DRAWING, READING
from sierra.packages.subject import Member, PartResult, Subject
from sierra.provenance.dependency_model import normalized
from sierra.provenance.pythons import OWN
from sierra.util.hashing import sha256_file
from sierra.util.lazy_definitions import regex

TAG = "py3-none-any"
LOCK = "extra_metadata/requirements.lock"
"""The lock in SIERRA's metadata, with all extras."""
KEPT = ("METADATA", "entry_points.txt", "licenses/", "extra_metadata/")
"""The files of SIERRA's metadata that belong to the wheel. The others are written by the program that installed it."""
LEFT_OUT = regex(r"__pycache__|.*\.py[co]|\.(?!gitignore$).*|.*~|.*\.(orig|rej)")
"""Files and folders that programs, editors and merges leave among the code of an editable installation."""
ENTRY = regex(r"(?m)^(?=[A-Za-z0-9])")
VIA = regex(r"(?m)^ +# +(?:via +)?([A-Za-z0-9][\w.-]*)")


class Locked(NamedTuple):
    """A package in the lock."""

    name: str
    requirement: str
    """Its lines: version, marker and hashes."""
    via: frozenset[str]
    """The names of the packages that need it."""


def members(subject: Subject, packed: Mapping[str, Member]) -> PartResult:
    """Return SIERRA's wheel and its requirements, or a fact if it cannot be made of this installation."""
    try:
        own = metadata.distribution(OWN)
        path = wheel(own, subject.folder / "sierra")
    except (metadata.PackageNotFoundError, Missing):
        return PartResult((), facts=("SIERRA itself is not packed: pip or a like program has not installed it here",))
    name = SIERRA + path.name
    listed = f"./{name} \\\n    --hash=sha256:{sha256_file(path)}\n" + "".join(package.requirement for package in needed(own))
    facts = ["SIERRA's wheel is made from an editable installation, and is not searched for names"]
    facts = facts if subject.redacted and is_editable(own) else []
    facts += [] if own.read_text(LOCK) else ["the Python packages that SIERRA needs are not locked: it has no lock here"]
    return PartResult(
        [
            Member(name, path, "SIERRA, which wrote this package; pip installs it"),
            Member(
                OWN_REQUIREMENTS, listed.encode(), "versions and SHA-256 of SIERRA and of the Python packages that it needs"
            ),
        ],
        facts=tuple(facts),
    )


def is_editable(own: metadata.Distribution) -> bool:
    """Return True if a distribution is a link to a folder."""
    direct = json.loads(own.read_text("direct_url.json") or "{}")
    return bool(direct.get("dir_info", {}).get("editable"))


def wheel(own: metadata.Distribution, folder: Path) -> Path:
    """Write SIERRA's wheel into a folder, unless it is there; return it. Raises Missing if its files are not listed here."""
    name = re.sub(r"[-_.]+", "_", own.name)
    path, described = folder / f"{name}-{own.version}-{TAG}.whl", f"{name}-{own.version}.dist-info"
    if path.exists():
        return path
    if own.files is None:
        raise Missing(f"the wheel of SIERRA cannot be made: {OWN} is installed here without a list of its files (RECORD)")
    folder.mkdir(exist_ok=True)
    about = f"Wheel-Version: 1.0\nGenerator: sierra {own.version}\nRoot-Is-Purelib: true\nTag: {TAG}\n"
    files = {**_code(), **_metadata(own, described), f"{described}/WHEEL": about.encode()}
    files[f"{described}/RECORD"] = _record(files, f"{described}/RECORD")
    with zipfile.ZipFile(path, "w") as file:
        for name, content in files.items():
            file.writestr(info(name, zipfile.ZIP_STORED), content)
    return path


def _code() -> dict[str, bytes]:
    """Return the files of SIERRA by their names in a wheel, in order."""
    folder = Path(__file__).parents[2]
    return {f"sierra/{path.relative_to(folder).as_posix()}": path.read_bytes() for path in sorted(_files(folder))}


def _files(folder: Path) -> Iterator[Path]:
    """Yield the regular files below a folder that belong to SIERRA."""
    for path in folder.iterdir():
        if path.is_symlink() or LEFT_OUT.fullmatch(path.name):
            continue
        if path.is_dir():
            yield from _files(path)
        elif path.is_file():
            yield path


def _metadata(own: metadata.Distribution, described: str) -> dict[str, bytes]:
    """Return the files of SIERRA's metadata by their names in a wheel, in order."""
    listed = (path for path in own.files or () if path.parts[0].endswith(".dist-info"))
    inside = {"/".join(path.parts[1:]): Path(str(own.locate_file(path))) for path in listed}
    return {f"{described}/{name}": path.read_bytes() for name, path in sorted(inside.items()) if name.startswith(KEPT)}


def _record(files: Mapping[str, bytes], own_name: str) -> bytes:
    """Return the list of the files of a wheel, with their hashes and sizes."""
    text = io.StringIO()
    lines = csv.writer(text, lineterminator="\n")
    for name, content in files.items():
        digest = base64.urlsafe_b64encode(hashlib.sha256(content).digest()).decode().rstrip("=")
        lines.writerow((name, f"sha256={digest}", len(content)))
    lines.writerow((own_name, "", ""))
    return text.getvalue().encode()


def needed(own: metadata.Distribution) -> list[Locked]:
    """Return the packages of the lock that SIERRA needs for reading, drawing and executing, in order; none without a lock."""
    every = {package.name: package for package in locked(own.read_text(LOCK) or "")}
    wanted = set(_required(own))
    while more := {package.name for package in every.values() if package.via & wanted} - wanted:
        wanted |= more
    return [every[name] for name in sorted(wanted & every.keys())]


def _required(own: metadata.Distribution) -> Iterator[str]:
    """Yield the names of the packages that SIERRA requires itself, with the extras for reading and drawing."""
    from packaging.requirements import Requirement

    for spec in map(Requirement, own.requires or ()):
        if spec.marker is None or any(spec.marker.evaluate({"extra": extra}) for extra in ("", *DRAWING, *READING.values())):
            yield normalized(spec.name)


def locked(text: str) -> Iterable[Locked]:
    """Yield the packages in a lock as `uv pip compile` writes it."""
    for entry in ENTRY.split(text):
        if name := re.match(r"[A-Za-z0-9][\w.-]*", entry):
            lines = [line for line in entry.splitlines() if line.strip() and not line.lstrip().startswith("#")]
            via = frozenset(map(normalized, VIA.findall(entry)))
            yield Locked(normalized(name[0]), "".join(f"{line}\n" for line in lines), via)
