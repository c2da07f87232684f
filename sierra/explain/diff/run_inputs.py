"""Differences of the input files of paired runs, in terms of the template, summarized over the runs."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

from sierra.errors import Damaged
from sierra.explain.diff.load_sides import ComparedRuns, chosen_executions
from sierra.explain.diff.model import ARROW, Difference, Note, shown
from sierra.model import Value
from sierra.store.recorded_files import INPUT_FOLDER, ChosenExecution, Recorded, contents, recorded
from sierra.store.store import Snapshot
from sierra.templates.input_diff import Spot, differing
from sierra.util.lazy_definitions import dataclass
from sierra.util.text import counted

LOOKED_AT = 40
"""Number of pairs of runs whose files are read: the first pair of each experiment, then the second, and so on."""
READ = 64 << 20
"""Maximum number of bytes that are read."""

SAMPLE = """
SELECT ordinal, number, now_ordinal, now_number, was_seed, now_seed
FROM (SELECT *, row_number() OVER (PARTITION BY ordinal ORDER BY number) AS place FROM both_sides WHERE other_input)
ORDER BY place, ordinal LIMIT $most
"""


@dataclass(frozen=True, slots=True)
class _Pair:
    """Pair of runs, and their files by name."""

    seeds: tuple[int, int]
    values: tuple[Mapping[str, Value], Mapping[str, Value]]
    files: tuple[Mapping[str, Recorded], Mapping[str, Recorded]]


def inputs(snapshot: Snapshot, before: ComparedRuns, after: ComparedRuns, notes: list[Note]) -> Iterator[Difference]:
    """Yield the differences of input files; `notes` receives what could not be compared."""
    [(others, runs)] = snapshot.run("SELECT count(*) FILTER (other_input), count(*) FROM both_sides")
    if not others:
        return
    pairs = _sample(snapshot, before, after)
    content = _read(snapshot, [file for pair in pairs for files in pair.files for file in files.values()], notes)
    looked = [pair for pair in pairs if all(file.sha256 in content for files in pair.files for file in files.values())]
    by_spot: dict[tuple[str, str], list[tuple[_Pair, Spot]]] = {}
    for pair in looked:
        for name in dict.fromkeys((*pair.files[0], *pair.files[1])):
            for spot in _spots(name, pair, content):
                by_spot.setdefault((name, spot.path), []).append((pair, spot))
    read = counted(len(looked), "run") if len(looked) == others else f"{counted(len(looked), 'run')} that could be read"
    several = any(len(files) > 1 for pair in pairs for files in pair.files)
    for (name, _), occurrences in by_spot.items():
        yield _difference(f"{name}: " if several else "", occurrences, len(looked), read, before, after)
    if len(looked) < others:
        text = f"inputs differ in {others} of {counted(runs, 'compared run')}; read: {len(looked)} of them"
        notes.append(Note(text, "inputs"))


def _sample(snapshot: Snapshot, before: ComparedRuns, after: ComparedRuns) -> list[_Pair]:
    rows = snapshot.run(SAMPLE, {"most": LOOKED_AT})
    old_files = _files(snapshot, chosen_executions(snapshot, before, [(row[0], row[1]) for row in rows]))
    new_files = _files(snapshot, chosen_executions(snapshot, after, [(row[2], row[3]) for row in rows]))
    return [
        _Pair((row[4], row[5]), (before.cells[row[0]], after.cells[row[2]]), (old, new))
        for row, old, new in zip(rows, old_files, new_files, strict=True)
    ]


def _files(snapshot: Snapshot, runs: Sequence[ChosenExecution]) -> list[dict[str, Recorded]]:
    """Return the input files of each run, by name."""
    found: dict[int, dict[str, Recorded]] = {id(run): {} for run in runs}
    for file in recorded(snapshot, runs):
        if file.kind == "input":
            found[id(file.taken)][file.path.removeprefix(INPUT_FOLDER)] = file
    return [found[id(run)] for run in runs]


def _read(snapshot: Snapshot, files: Sequence[Recorded], notes: list[Note]) -> dict[str | None, bytes]:
    """Return the content of these files by SHA-256, at most `READ` bytes; `notes` reports files that are lost."""
    wanted, size = {}, 0
    for file in files:
        if file.sha256 not in wanted and size + (file.bytes or 0) <= READ:
            wanted[file.sha256] = file
            size += file.bytes or 0
    contents_by_hash: dict[str | None, bytes] = {}
    lost: list[str] = []
    for content in contents(snapshot, list(wanted.values())):
        try:
            contents_by_hash[content.file.sha256] = b"".join(content.pieces)
        except Damaged as error:
            lost.append(f"{content.file.path} of run {content.file.taken.run[:10]}: {error}")
    if lost:
        notes.append(Note(f"{lost[0]}{f'; and {len(lost) - 1} more input files' * (len(lost) > 1)}", "inputs"))
    return contents_by_hash


def _spots(name: str, pair: _Pair, content: Mapping[str | None, bytes]) -> Iterator[Spot]:
    old, new = (files.get(name) for files in pair.files)
    if old is None or new is None:
        yield Spot(
            name, "added" if old is None else "removed", now=name if old is None else None, was=name if new is None else None
        )
    else:
        yield from differing(name, content[old.sha256], content[new.sha256])


def _difference(
    name: str, occurrences: Sequence[tuple[_Pair, Spot]], looked: int, read: str, before: ComparedRuns, after: ComparedRuns
) -> Difference:
    """Return the difference at one place of the input, in all pairs of runs in which it differs."""
    first = occurrences[0][1]
    values = {(spot.what, spot.was, spot.now) for _, spot in occurrences}
    where = "" if before.is_one else f" (in {'all' if len(occurrences) == looked else f'{len(occurrences)} of'} {read})"
    varying = f", and {len(values) - 1} different pairs of values" if len(values) > 1 else ""
    line = f"{name}{_line(first)}{varying}{where}"
    if all(_is_seed(pair, spot) for pair, spot in occurrences):
        return Difference("inputs", "the seed", f"input, the seed: {line}", first.was, first.now)
    requested = all(_is_requested(pair, spot, before, after) for pair, spot in occurrences)
    kind = "as asked" if requested else first.path
    return Difference(
        "inputs", kind, f"input{', as requested' if requested else ''}: {line}", first.was, first.now, first.lines
    )


def _line(spot: Spot) -> str:
    match spot.what:
        case "changed":
            return f"{spot.path}: {shown(spot.was)} {ARROW} {shown(spot.now)}"
        case "added":
            return f"{spot.path} was added: {shown(spot.now)}"
        case "removed":
            return f"{spot.path} was removed: it was {shown(spot.was)}"
        case "order":
            return f"{spot.path}: the content is in a different order"
        case "writing":
            return f"{spot.path}: only white space, order of attributes or comments differ"
        case _:
            return f"{spot.path}: {spot.was} {ARROW} {spot.now}"


def _is_seed(pair: _Pair, spot: Spot) -> bool:
    return pair.seeds[0] != pair.seeds[1] and (spot.was, spot.now) == tuple(map(str, pair.seeds))


def _is_requested(pair: _Pair, spot: Spot, before: ComparedRuns, after: ComparedRuns) -> bool:
    """Check whether a difference follows from the values of the two experiments, or from a --set that only one side has."""
    was, now = pair.values
    for name in was.keys() & now.keys():
        if was[name] != now[name] and (spot.was, spot.now) == (str(was[name]), str(now[name])):
            return True
    old, new = before.batch.overrides, after.batch.overrides
    values = {text.rpartition("=")[2]: text in new for text in (*old, *new) if (text in old) != (text in new)}
    return any(value == (spot.now if later else spot.was) for value, later in values.items())
