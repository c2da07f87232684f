"""The file CITATION.cff (Citation File Format 1.2.0), made from `[package]` in `sierra.toml`.

A project may have such a file of its own. It is packed as it is, after `differences` has compared it with `[package]`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from sierra.config.package_table import DOI, Package
from sierra.errors import ConfigError
from sierra.packages.subject import Member, PartResult, Subject
from sierra.store.segments import disk_errors
from sierra.util.fs import write_whole
from sierra.util.lazy_definitions import dataclass
from sierra.util.regular_files import read_regular

CITATION = "CITATION.cff"
NEEDED = ("title", "authors", "license")
"""The keys that are necessary to cite or use a package."""
LARGEST = 1 << 20
"""The largest number of bytes of a project's own metadata file."""
DATED = 10
"""The number of characters of a date without its time."""


def lacking(package: Package) -> list[str]:
    """Return the keys of `[package]` that every package needs, and that are not there."""
    return [name for name in NEEDED if not getattr(package, name)]


@dataclass(frozen=True, slots=True)
class Metadata:
    """The metadata file in a project's folder, compared with `[package]`: its name is in the list that says how it is."""

    written: tuple[str, ...]
    equal: tuple[str, ...]
    absent: tuple[str, ...]
    differences: tuple[str, ...]
    """One line for each value that is not that of `[package]`."""


def compare(package: Package, root: Path, *, write: bool) -> Metadata:
    """Compare the files in a project's folder with `[package]`; with `write`, write those that do not exist.

    Raises ConfigError if `[package]` lacks what every package needs, Missing if a file cannot be written.
    """
    generated, existing = files(package), own(root)
    absent = tuple(name for name in generated if name not in existing)
    for name in absent if write else ():
        with disk_errors(root):
            write_whole(root / name, generated[name])
    wrong = {name: differences(package, {name: content}) for name, content in existing.items()}
    return Metadata(
        written=absent if write else (),
        equal=tuple(name for name, lines in wrong.items() if not lines),
        absent=() if write else absent,
        differences=tuple(line for lines in wrong.values() for line in lines),
    )


def files(package: Package, date: str = "") -> dict[str, bytes]:
    """Return the content of all metadata files, by name. `date`: in ISO 8601, used unless `[package]` has one.

    Raises ConfigError if `[package]` lacks what every package needs.
    """
    if names := lacking(package):
        raise ConfigError(f"[package] in sierra.toml needs {', '.join(names)}")
    return {CITATION: citation(package, package.date or date)}


def members(subject: Subject, packed: Mapping[str, Member]) -> PartResult:
    """Return the metadata files of a package: the project's own ones, or those made from `[package]`."""
    package = subject.project.config.package
    theirs = {} if subject.redacted else own(subject.project.root)
    contents = {**files(package, subject.date), **theirs}
    parts = [Member(name, content, "metadata for archives and citations") for name, content in contents.items()]
    return PartResult(parts, notes=tuple(differences(package, theirs)))


def citation(package: Package, date: str) -> bytes:
    """Return the content of CITATION.cff."""
    import yaml

    identifiers = [
        {"type": "doi" if DOI.fullmatch(work.identifier) else "url", "value": work.identifier, "description": work.relation}
        for work in package.related
    ]
    fields: dict[str, Any] = {
        "cff-version": "1.2.0",
        "message": "If you use this package, please cite it as below.",
        "type": "dataset",
        "title": package.title,
        "abstract": package.description.strip(),
        "authors": [
            _present(
                {
                    "family-names": author.family,
                    "given-names": author.given,
                    "orcid": author.orcid and f"https://orcid.org/{author.orcid}",
                    "affiliation": author.affiliation,
                }
            )
            for author in package.authors
        ],
        "license": package.license,
        "keywords": list(package.keywords),
        "version": package.version,
        "date-released": date[:DATED],
        "doi": package.doi,
        "repository-code": package.repository,
        "identifiers": identifiers,
    }
    text: str = yaml.safe_dump(_present(fields), sort_keys=False, allow_unicode=True, width=100)
    return text.encode()


def own(root: Path) -> dict[str, bytes]:
    """Return the metadata files that a project has itself, by name. Raises ConfigError for a file that is too large."""
    path = root / CITATION
    if not path.is_file():
        return {}
    if path.stat().st_size > LARGEST:
        raise ConfigError(f"{path} is too large for a metadata file")
    return {CITATION: read_regular(path)}


def differences(package: Package, files: Mapping[str, bytes]) -> list[str]:
    """Return one line for each value of a project's own metadata files that is not that of `[package]`."""
    return [line for name, content in files.items() for line in _differences(package, name, content)]


def _differences(package: Package, name: str, content: bytes) -> Iterator[str]:
    try:
        existing = _parsed(content)
    except ValueError as error:
        yield f"{name} cannot be read: {str(error).splitlines()[0]}"
        return
    generated = _parsed(citation(package, package.date or ""))
    for key in ("title", "license", "version", "doi", "keywords"):
        if key in generated and key in existing and _plain(existing[key]) != _plain(generated[key]):
            yield f"{name} has {key} {existing[key]!r}, but [package] says {generated[key]!r}"
    if (others := _names(existing.get("authors"))) != (ours := _names(generated["authors"])):
        yield f"{name} names the authors {', '.join(others) or 'nobody'}, but [package] {', '.join(ours)}"


def _parsed(content: bytes) -> dict[str, Any]:
    """Return the object in a metadata file. Raises ValueError."""
    import yaml

    try:
        fields = yaml.safe_load(content)
    except (yaml.YAMLError, RecursionError) as error:
        raise ValueError(f"it is no YAML: {error}") from error
    if not isinstance(fields, dict):
        raise ValueError("it is no object")
    return fields


def _names(people: object) -> list[str]:
    """Return the names of people or organizations, as `family, given`."""
    listed = people if isinstance(people, list) else [people]
    names = []
    for person in listed:
        if not isinstance(person, dict):
            continue
        family, given = person.get("family-names"), person.get("given-names")
        names.append(", ".join(filter(None, (family, given))) if family else str(person.get("name", "")))
    return names


def _plain(value: object) -> object:
    """Return a value without differences of spelling that mean nothing: case, resolvers, order."""
    if isinstance(value, list):
        return sorted(map(str, value))
    return str(value).lower().removeprefix("https://spdx.org/licenses/").removeprefix("https://doi.org/").strip()


def _present(fields: Mapping[str, Any]) -> dict[str, Any]:
    """Return the fields that have a value."""
    return {name: value for name, value in fields.items() if value}
