"""The section about reproduction: how to cite a batch, how to replay it, and the replays that are recorded."""

from __future__ import annotations

import shlex
from collections.abc import Iterator

from sierra.config.package_table import DOI, Package
from sierra.deliverables.report.batch_state import BatchState
from sierra.deliverables.report.parts import Place, Section, code, note, table
from sierra.util.hashing import short
from sierra.util.html_elements import Markup, element, joined
from sierra.util.lazy_definitions import dataclass
from sierra.util.version import __version__


@dataclass(frozen=True, slots=True)
class Received:
    """The package that a report is about."""

    package: Package
    """Its description, with the date that it states."""
    name: str = ""
    """The name of its file; "" if the report becomes a part of it."""
    id: str = ""
    """Its id; "" if the report becomes a part of it, because the id follows from all parts."""
    notes: tuple[str, ...] = ()


def section(state: BatchState, received: Received | None, headings: Place) -> Section:
    """Return the section about how to cite and to repeat a batch."""
    return Section("reproduce", "Cite and reproduce", joined(_lines(state, received, headings)))


def _lines(state: BatchState, received: Received | None, headings: Place) -> Iterator[Markup]:
    package = received.package if received else state.project.config.package
    yield element(headings.inner, "Cite")
    yield code(citation(package, state.id, received), "the citation")
    if not (package.title and package.authors):
        yield note("[package] in sierra.toml gives a citation its title and authors: see sierra package --cite.")
    yield element(headings.inner, "Reproduce")
    yield code("\n".join(_commands(state, received)), "the commands")
    yield note("The id names the question, the code, the inputs and the seeds. It is the same on every machine.")
    yield from _replays(state, headings)


def citation(package: Package, batch: str, received: Received | None) -> str:
    """Return how to cite a batch, in one line."""
    names = "; ".join(author.name for author in package.authors)
    year = f"({package.date[:4]})" if package.date else ""
    about = ". ".join(filter(None, (" ".join(filter(None, (names, year))), package.title)))
    version = f"version {package.version}" if package.version else ""
    doi = package.doi and (f"https://doi.org/{package.doi}" if DOI.fullmatch(package.doi) else package.doi)
    own = f"SIERRA package {received.id}" if received and received.id else ""
    parts = (about, version, doi or package.repository, own, f"SIERRA batch {batch}")
    return f"{'. '.join(filter(None, parts))}. Made with SIERRA {__version__}."


def _commands(state: BatchState, received: Received | None) -> Iterator[str]:
    if received and not received.name:
        yield "python3 reproduce.py   # in the folder of the extracted package: check all files"
        yield "sierra reproduce .     # execute the runs again, and compare"
        return
    if received:
        name = shlex.quote(received.name)
        yield f"sierra reproduce {name}   # execute its runs again, and compare"
        yield f"sierra open {name}        # list what it has, and execute nothing"
        return
    yield f"sierra replay {state.short}                   # execute the runs again from the record, and compare"
    yield f"sierra figures {state.short} --check          # check that the drawn figures follow from the store"
    yield f"sierra package {state.short} -o results.zip   # write all that a stranger needs to one file"


def _replays(state: BatchState, headings: Place) -> Iterator[Markup]:
    if not state.shown.replays:
        return
    yield element(headings.inner, "Recorded replays")
    rows = [(short(replay.replay), replay.kind, replay.runs, replay.verdict) for replay in state.shown.replays]
    yield table(("replay", "replayed", "runs", "verdict"), rows, "Replays of this batch, or of a part of it", numbers=(2,))
