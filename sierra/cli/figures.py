"""`sierra figures`: draw a batch's figures again."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sierra.cli import complete
from sierra.cli.output import note, print_json, readable
from sierra.errors import UsageError
from sierra.util.lazy_definitions import regex

if TYPE_CHECKING:
    from sierra.api import Project
    from sierra.deliverables.check import Checked


PREFIX = regex(r"[0-9a-f]{1,64}")
"""A prefix of a batch's id, which the name of a default figure is not."""


def figures(
    words: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="HASH|NAME",
            autocompletion=complete.batches_and_figures,
            help="Batch id or prefix (default: the last batch); several, also as LABEL=HASH or the name of a query, are drawn "
            "together. Then names of figures or tables (default: all that show this batch).",
        ),
    ] = None,
    target: Annotated[
        str | None,
        typer.Option(
            "--target",
            metavar="NAME[,NAME...]",
            autocompletion=complete.targets,
            help="The last batch of this target instead; several targets are drawn together.",
        ),
    ] = None,
    formats: Annotated[
        str | None,
        typer.Option(
            "--format",
            metavar="NAME[,NAME...]",
            help="Formats of the files: png, pdf, svg, html, pgf, txt, tex (default: those that sierra.toml declares, or "
            "png,pdf,svg,txt,tex).",
        ),
    ] = None,
    check: Annotated[
        bool, typer.Option("--check", help="Draw nothing; check that drawn figures still follow from the store.")
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print a JSON list of files instead of text.")] = False,
) -> None:
    """Draw the figures and tables of a batch again.

    They are drawn from recorded results; nothing is executed. Several batches are drawn together, in the order given: figures
    have a line for each batch, and tables have them side by side. With several targets, the last batches of one query are drawn
    together, with a line for each target: those of the query of HASH, or of the last query for any of these targets. Their runs
    must be pairs, with the same values and seeds. A figure or table with `query` in sierra.toml shows the last batch of this
    query, and is drawn with it, or if it is named. With --check, nothing is drawn: exit status 1
    means that a file was changed or removed since it was drawn, or that the store has other data now.

    \b
    Examples:
      sierra figures
      sierra figures 722b00
      sierra figures --target robots
      sierra figures --target sim,robots
      sierra figures 722b00 swarm_coverage_summary
      sierra figures coverage heat
      sierra figures --format pdf,html
      sierra figures calm=722b00 noisy=518b72
      sierra figures 722b00 --check
    """
    from sierra.cli.open_project import project

    opened = project()
    wanted = [format.strip() for format in formats.split(",")] if formats is not None else ()
    if check and formats is not None:
        raise UsageError("--check checks the files of all formats; leave out --format")
    batches, names = _split(opened, words or [])
    prefix = batches[0] if batches else None
    if check:
        if names or len(batches) > 1:
            raise UsageError("--check checks all figures of one batch; leave out anything else")
        _check(opened.deliverables.check(opened.records.batch(prefix, target=target)), as_json=as_json)
        return
    if len(batches) > 1 and target is not None:
        raise UsageError("--target chooses batches; leave it out, or the batches")
    paths, notes = list[Path](), list[str]()
    for name in names or (None,):
        if len(batches) > 1:
            drawn = opened.deliverables.draw_batches(*batches, name=name, formats=wanted)
        elif target is not None and "," in target:
            drawn = opened.deliverables.draw_targets(target.split(","), prefix, name, formats=wanted)
        else:
            batch = opened.records.batch(prefix, target=target) if prefix is not None or target is not None else None
            drawn = opened.deliverables.draw(batch, name, formats=wanted)
        paths += drawn[0]
        notes += (text for text in drawn[1] if text not in notes)
    print_files(paths, notes, as_json=as_json)


def print_files(paths: Iterable[Path], notes: Iterable[str], *, as_json: bool) -> None:
    """Print the paths of files that were made, and notes on what could not be made."""
    for text in notes:
        note(text)
    if as_json:
        print_json([str(path) for path in paths])
    else:
        for path in paths:
            print(from_here(path))


def _split(opened: Project, words: Sequence[str]) -> tuple[list[str], list[str]]:
    """Return the words that are batches, and the names after them.

    The first word is a batch, unless it is declared; a later one if it is one's prefix or a query's name, maybe with a label.
    """
    declared = {*opened.config.figures, *opened.config.paper_tables}
    for index, word in enumerate(words):
        is_batch = "=" in word or word in opened.config.queries or PREFIX.fullmatch(word) is not None
        if word in declared or (index and not is_batch):
            return list(words[:index]), list(words[index:])
    return list(words), []


def _check(checked: Sequence[Checked], *, as_json: bool) -> None:
    """Print the state of each figure; end with exit status 1 if one does not follow from the store."""
    if as_json:
        print_json([asdict(figure) for figure in checked])
    else:
        names = Counter(figure.name for figure in checked)
        for figure in checked:
            formats = ", ".join(dict.fromkeys(Path(file).suffix[1:] for file in figure.files)) if names[figure.name] > 1 else ""
            print(f"{figure.name}{formats and f' ({formats})'}: {readable(figure.problem or 'follows from the store')}")
        if not checked:
            note("no figure of this batch has been drawn; draw them with: sierra figures")
    if any(figure.problem for figure in checked):
        raise typer.Exit(1)


def from_here(path: str | os.PathLike[str]) -> str:
    """Return a path in its shortest form: relative to the working directory, or as it is."""
    whole = os.fspath(path)
    return min(os.path.relpath(whole), whole, key=len)
