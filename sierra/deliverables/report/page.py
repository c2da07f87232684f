"""The page of a report: its header with the state of the batches, the table of contents, and the sections."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from sierra.deliverables import html
from sierra.deliverables.claims.model import Verdict
from sierra.deliverables.report import question
from sierra.deliverables.report.batch_state import BatchState
from sierra.deliverables.report.claims import KINDS, Claims
from sierra.deliverables.report.parts import Place, Section, auto, section
from sierra.deliverables.report.reproduce import Received
from sierra.util.hashing import short
from sierra.util.html_elements import Markup, element, joined
from sierra.util.lazy_definitions import dataclass
from sierra.util.text import counted
from sierra.util.version import __version__

GENERATOR = "SIERRA report"
"""The beginning of the name of the program in the page, by which a report is recognized."""
ORIGIN = "sierra"
"""The name of the text in the page that will name its batches and the hash of its data."""
ASSETS = "report"
TILES = {Verdict.holds: "claims hold", Verdict.does_not_hold: "claims do not hold", Verdict.cannot_tell: "claims can't be told"}


@dataclass(frozen=True, slots=True)
class Chapter:
    """The part of a report about one batch."""

    state: BatchState
    sections: Sequence[Section]

    @property
    def place(self) -> Place:
        return Place(f"b{self.state.short}-", 3)

    def element(self) -> Markup:
        """Return the part as an article, for a report with several batches."""
        name = f"b{self.state.short}"
        return element(
            "article",
            element("p", "Batch ", element("code", self.state.short), id=f"{name}-batch", class_="kicker"),
            auto(question.title(self.state), "h2", id=f"{name}-title"),
            standing(self.state),
            *(section(part, self.place) for part in self.sections),
            id=name,
            aria_labelledby=f"{name}-title",
            class_="chapter",
        )


def of_batch(state: BatchState, sections: Sequence[Section], claims: Claims, received: Received | None) -> bytes:
    """Return the report of one batch."""
    kicker = joined(("Report of batch ", element("code", state.short)))
    title = question.title(state)
    opening = (standing(state), _tiles([state], claims))
    contents = [(part.name, part.title) for part in sections]
    return _page(title, kicker, opening, contents, [section(part, Place()) for part in sections], [state], received)


def of_batches(
    title: str, sections: Sequence[Section], chapters: Sequence[Chapter], claims: Claims, received: Received | None
) -> bytes:
    """Return the report of several batches: sections about all of them, and a chapter for each."""
    contents = [(part.name, part.title) for part in sections]
    contents += [(f"b{chapter.state.short}", f"{chapter.state.short}: {question.title(chapter.state)}") for chapter in chapters]
    states = [chapter.state for chapter in chapters]
    parts = [*(section(part, Place()) for part in sections), *(chapter.element() for chapter in chapters)]
    opening = (_tiles(states, claims),) if states else ()
    return _page(title, Markup("Report"), opening, contents, parts, states, received)


def _page(
    title: str,
    kicker: Markup,
    opening: Sequence[Markup],
    contents: Sequence[tuple[str, str]],
    parts: Sequence[Markup],
    states: Sequence[BatchState],
    received: Received | None,
) -> bytes:
    links = (element("li", element("a", text, href=f"#{name}", dir="auto")) for name, text in contents)
    header = element(
        "header", element("p", kicker, class_="kicker"), auto(title, "h1"), *_package(received), *opening, class_="title"
    )
    body = (
        element("a", "Skip to the content", href="#content", class_="skip"),
        header,
        element("nav", element("p", "Contents", class_="kicker"), element("ul", joined(links)), aria_label="Contents"),
        element("main", *parts, id="content", tabindex=-1),
        element("footer", *_footer(states)),
    )
    metadata = {"generator": f"{GENERATOR} {__version__}", "description": title, ORIGIN: ""}
    return html.page(f"{title} – SIERRA report", body, metadata, extra=ASSETS, plays=True)


def standing(state: BatchState) -> Markup:
    """Return what is to be known first: whether the batch is complete, still executing, or has failures."""
    row = state.shown.row
    done = f"{state.succeeded:,} of {counted(row.runs, 'run')} succeeded"
    done += f", {state.accepted:,} ended otherwise as accepted" if state.accepted else ""
    failed = f", {state.unsuccessful:,} did not" if state.unsuccessful else ""
    if state.executing or state.shown.clusters:
        waiting = f", {state.unexecuted:,} are not finished"
        return _banner("running", "Still running", f"{done}{failed}{waiting}. All numbers are of the finished runs only.")
    if state.unexecuted:
        text = f"{done}{failed}, {state.unexecuted:,} have no result. All numbers are of the others only."
        return _banner("partial", "Incomplete", text)
    if state.unsuccessful:
        return _banner("partial", "Complete, with failures", f"{done}{failed}. No number includes failed runs.")
    return _banner("complete", "Complete", f"{done}.")


def _banner(kind: str, word: str, text: str) -> Markup:
    return element("p", element("strong", f"{word}. "), text, class_=f"banner {kind}", role="status")


def _tiles(states: Sequence[BatchState], claims: Claims) -> Markup:
    """Return the numbers of the report, large."""
    rows = [state.shown.row for state in states]
    sizes = {"experiment": sum(row.experiments for row in rows), "run": sum(row.runs for row in rows)}
    always = {counted(number, noun).partition(" ")[2]: number for noun, number in sizes.items()}
    always["succeeded"] = sum(state.succeeded for state in states)
    perhaps = {"accepted ends": sum(state.accepted for state in states)}
    perhaps["failed or cut off"] = sum(state.unsuccessful for state in states)
    perhaps["not executed"] = sum(state.unexecuted for state in states)
    numbers = {**always, **{name: number for name, number in perhaps.items() if number}}
    tiles = [element("div", element("dt", name), element("dd", f"{number:,}")) for name, number in numbers.items()]
    tiles += [
        element("div", element("dt", TILES[verdict]), element("dd", f"{count}"), class_=KINDS[verdict])
        for verdict, count in claims.counts.items()
    ]
    return element("dl", *tiles, class_="tiles")


def _package(received: Received | None) -> Iterator[Markup]:
    if received:
        about = f"From package {short(received.id)} ({received.name})." if received.name else "Part of a reproduction package."
        yield element("p", f"{about} Nothing of it was executed to make this page.", class_="note", dir="auto")
        yield from (element("p", text, class_="note", dir="auto") for text in received.notes)


def _footer(states: Sequence[BatchState]) -> Iterator[Markup]:
    ended = [session.ended for state in states for session in state.shown.sessions]
    last = f" The last session that it shows ended {max(ended):%Y-%m-%d %H:%M} UTC." if ended else ""
    yield element("p", f"Made by SIERRA {__version__} from recorded results.{last} This page loads nothing from elsewhere.")
