"""Reproduction packages: written from a project, imported into one, and reproduced without one."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from sierra.api.noun import Noun, observer_for, slots
from sierra.errors import NotFound, UsageError
from sierra.store.store import Store
from sierra.util.lazy_definitions import regex

if TYPE_CHECKING:
    from sierra.deliverables.report.files import Written
    from sierra.execution.observer import Observer
    from sierra.packages.pack import Packed, Preview
    from sierra.packages.parts.metadata import Metadata
    from sierra.packages.reading.differences import PackageDifferences
    from sierra.packages.reading.imports import Imported
    from sierra.packages.reproduction.outcome import Reproduction, Statement
    from sierra.packages.subject import ImageForm

PACKAGED = ".zip"
"""The ending of packages."""
IN_PACKAGE = regex(r"(?:([^=/]+)=)?(.+\.zip)(?::(\w+))?")
"""A batch in a package: an optional label, the path, and an optional prefix of the batch's id."""


class Packages(Noun):
    """Reproduction packages: `project.packages`."""

    def diff(self, before: str, after: str) -> PackageDifferences:
        """Return the differences between two batches of which at least one is in a package.

        Each is a prefix of a batch's id, or the path of a package: with `:HASH` for one of its batches, else its batch with the
        same id as the other one, or its only one. Raises NotFound, Missing, Damaged.

        >>> project.packages.diff(summary.batch, "theirs.zip")
        Traceback (most recent call last):
            ...
        sierra.errors.Missing: theirs.zip: No such file or directory
        """
        from contextlib import ExitStack

        from sierra.packages.reading import differences

        packaged = {word: match for word in (before, after) if (match := IN_PACKAGE.fullmatch(word))}
        own = {word: self._project.records.batch(word) for word in (before, after) if word not in packaged}
        with ExitStack() as opened:
            sides = [
                differences.of_batch(*batch_in_package(match[2], match[3], own.values()))
                if (match := packaged.get(word))
                else differences.of_batch(self._store, own[word])
                for word in (before, after)
            ]
            return differences.compare(*map(opened.enter_context, sides))

    def metadata(self, *, write: bool = False) -> Metadata:
        """Compare CITATION.cff with `[package]`; with `write`, write it if it is not there.

        Raises ConfigError if `[package]` has no title, authors or licence.

        >>> project.packages.metadata()
        Traceback (most recent call last):
            ...
        sierra.errors.ConfigError: [package] in sierra.toml needs title, authors, license
        """
        from sierra.packages.parts import metadata

        return metadata.compare(self._project.config.package, self._project.root, write=write)

    def pack(
        self,
        *batches: str,
        path: str | os.PathLike[str],
        claims: bool = False,
        agree: Callable[[Preview], bool] = lambda preview: True,
        image: ImageForm = "none",
        wheels: bool = False,
        pythons: Sequence[str] = (),
        machines: Sequence[str] = (),
        report: bool = True,
        without: Sequence[str] = (),
        anonymous: bool = False,
        allow: Sequence[str] = (),
    ) -> Packed | None:
        """Write a reproduction package of these batches, if `agree` returns true for the preview: see `sierra.packages.pack`.

        `batches` are prefixes of ids, or names of queries. With `claims`, also those that the claims of `sierra.toml` rest on.
        `anonymous`: for double-blind review, see `sierra.packages.anonymity.anonymous`; `allow`: texts in which names are
        accepted there.

        `image`: the forms in which container images are packed, `oci`, `sif`, `both` or `none`. With `wheels`, Python
        packages are packed for these versions of Python (as `3.12`) and processors (as `x86_64`); by default, for this Python.
        `report`: false to leave out the report, which is made now. `without`: kinds of deliverables that are left out, such as
        `figure`.

        Raises NotFound if such a batch has not been recorded, UsageError if there is no batch or the file exists, ConfigError
        if `[package]` has no title, authors or licence, Missing for a source that no longer exists, Identifying if an anonymous
        package would name people or machines.

        >>> project.packages.pack(summary.batch, path="results.zip")
        Traceback (most recent call last):
            ...
        sierra.errors.ConfigError: [package] in sierra.toml needs title, authors, license
        """
        from sierra.packages import pack
        from sierra.packages.anonymity.anonymous import Anonymity
        from sierra.packages.subject import Options

        options = Options(image, wheels, tuple(pythons), tuple(machines), report, tuple(without))
        if allow and not anonymous:
            raise UsageError("--allow accepts names in anonymous packages; add --anonymous")
        pack.check_needs(self._loaded, Path(path), options, anonymous=anonymous)
        if claims:
            from sierra.deliverables.claims import evaluate

            decide = evaluate.batches(self._loaded, self._store)
            batches = (*batches, *(batch for ids in decide.values() for batch in ids))
        batches = tuple(map(self._project.records.id, batches))
        if not batches:
            raise UsageError("name the batches to be packed")
        anonymity = Anonymity(self._loaded, allow) if anonymous else None
        return pack.pack(self._loaded, self._store, batches, Path(path), agree=agree, options=options, anonymity=anonymity)

    def import_records(self, path: str | os.PathLike[str], *, observer: Observer | None = None) -> Imported:
        """Add the records of a package to the store, and keep where they came from: see `sierra.packages.reading.imports`.

        In batches that were executed here, imported executions do not count. `observer` receives a notice about each session
        that died here and cannot be recorded. Raises Missing, Damaged, UsageError; then nothing changes.

        >>> project.packages.import_records("results.zip")
        Traceback (most recent call last):
            ...
        sierra.errors.Missing: results.zip: No such file or directory
        """
        from sierra.packages.reading import imports

        return imports.import_package(Store.create(self._project.paths.store), Path(path), observer)


def batch_in_package(path: str, prefix: str | None, others: Iterable[str]) -> tuple[Store, str]:
    """Return the store of a package, and its batch with this prefix: else the only one, or one that is among others."""
    store, batches = batches_of_package(path)
    named = [batch for batch in batches if batch.startswith(prefix or "")]
    same = [batch for batch in named if batch in others] if len(named) > 1 else named
    if len(same) != 1:
        known = ", ".join(batch[:10] for batch in batches)
        raise NotFound(f"{path}: name one of its batches, as {Path(path).name}:HASH; it has {known}")
    return store, same[0]


def batches_of_package(path: str) -> tuple[Store, list[str]]:
    """Return the store of a package and the ids of its batches. Raises Missing, Damaged."""
    from sierra.packages.reading import received

    opened = received.open_package(Path(path))
    return opened.store, [batch.batch for batch in opened.manifest.batches]


def reproduce(
    package: str | os.PathLike[str],
    *,
    into: str | os.PathLike[str] | None = None,
    claims: Sequence[str] = (),
    budget: float | None = None,
    jobs: int | None = None,
    engine: str | None = None,
    runner: str = "local",
    agree: Callable[[Statement], None] | None = None,
    observer: Observer | None = None,
    progress: bool | None = None,
) -> Reproduction:
    """Execute the runs of a package again, compare the results, and decide its claims; a package is a zip or a folder.

    The copy of the package and the reports are in the folder `into`, by default in one beside the package. `claims`: the names
    of the claims, by default all. `budget`: time for the runs in seconds, by their recorded durations. `agree` receives what
    would be executed, and where, before anything is; it must raise an error to prevent that. By default, only containers
    without network are accepted. Raises Missing, Damaged for a package that is not safe, UsageError for unsuitable options.

    >>> from sierra.api import reproduce
    >>> reproduce("results.zip")
    Traceback (most recent call last):
    sierra.errors.Missing: results.zip: No such file or directory
    """
    from sierra.packages.reproduction import reproduce as steps

    options = steps.Options(slots(jobs), tuple(claims), budget, engine, runner)
    folder = None if into is None else Path(into)
    return steps.reproduce(Path(package), folder, options, agree or steps.isolated_only, observer or observer_for(progress))


def report_package(
    package: str | os.PathLike[str],
    *,
    to: str | os.PathLike[str] | None = None,
    tell: Callable[[str], None] = lambda text: None,
) -> Written:
    """Write a report of the batches in a package, and execute nothing of it.

    `to` is the file; by default, it is beside the package: `results-report.html` for `results.zip`. The other arguments and the
    errors are those of `project.deliverables.report`; Damaged for a package that is not safe.

    >>> from sierra.api import report_package
    >>> report_package("results.zip")
    Traceback (most recent call last):
    sierra.errors.Missing: results.zip: No such file or directory
    """
    from sierra.packages.reading import received, report

    return report.write(received.open_package(Path(package)), None if to is None else Path(to), tell)
