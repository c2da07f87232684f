"""Files that runs wrote, but not into their working directory, so that they are not recorded.

The worker lists those in a run's own folder: beside its input (`{run}/…`) and in its HOME (`{run}/home/…`). All others are only
known if the run was observed. Runs that were not observed are compared with those that were: see `find_siblings`.
"""

from __future__ import annotations

import fnmatch
from collections.abc import Collection, Iterator, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import PurePosixPath
from typing import NamedTuple

from sierra.config.output_tables import Output
from sierra.ingest import open_names
from sierra.ingest.recording_context import Context
from sierra.model import IN_PROJECT, Result, Status
from sierra.store.layout import RUN_HOME, SessionPaths
from sierra.store.row_types import FindingRow
from sierra.store.store import Store
from sierra.util.lazy_definitions import regex
from sierra.util.text import few

NAMED = 3
RUN = "{run}/"
HOME = f"{RUN}{RUN_HOME}/"
NO_RESULTS = regex(r"/(?:tmp|var|run|dev)/.*|.*/\..*")
"""Temporary files, those of services, and hidden ones: a run that writes nothing else has perhaps only printed its results."""
LEFT_NOTHING = "left no file in its working directory, but wrote "


def failure(result: Result, outputs: Mapping[str, Output]) -> str | None:
    """Return why a run has failed of which all files are elsewhere; None if it has left some, or has written none."""
    places = [path for path in result.elsewhere if not NO_RESULTS.fullmatch(path)]
    if outputs or result.outputs or not places:
        return None
    return f"{LEFT_NOTHING}{few(places, NAMED)}"


def lacking(name: str, output: Output, places: Sequence[str], files: Collection[str] = ()) -> str:
    """Return the reason why a run without a required output has failed. `files`: the files in its working directory."""
    if output.is_stdout:
        return f"printed nothing on standard output (output {name!r})"
    reason = f"did not write {output.file!r} (output {name!r})"
    if pattern := open_names.patterns([[output.file], files]).get(output.file):
        other = next(file for file in files if fnmatch.fnmatchcase(file, pattern))
        return f"{reason}, but {other!r} ({open_names.advice([pattern], name)})"
    own = [path for path in places if _is_of(output, path)]
    return f"{reason} in its working directory, but {few(own, NAMED)}" if own else reason


def _is_of(output: Output, path: str) -> bool:
    """Return whether a file would belong to an output if it were in the working directory."""
    inside = path.removeprefix(HOME).removeprefix(RUN)
    return output.matches(inside) or output.matches(PurePosixPath(path).name)


def notes(places: Collection[str]) -> Iterator[str]:
    """Yield warnings about files that runs wrote elsewhere, each with what would keep them."""
    inputs = sorted(path for path in places if path.startswith(RUN) and not path.startswith(HOME))
    homes = sorted(path for path in places if path.startswith(HOME))
    inside = sorted(path for path in places if path.startswith(IN_PROJECT))
    others = sorted(path for path in places if not path.startswith((RUN, IN_PROJECT)))
    if inputs:
        cure = f"call it output/{inputs[0].removeprefix(RUN)} in the template, or pass {{output}} to the program in command"
        yield _note("beside their input", inputs, cure)
    if homes:
        yield _note("into HOME", homes, 'set command = "env HOME={output} …", or pass {output} to the program in command')
    if inside:
        cure = "pass {output} to the program in command"
        yield f"{_note('into the project', inside, cure)}; one that git does not ignore belongs to the source from now on"
    if others:
        yield _note("elsewhere", others, "pass {output} to the program in command")


def _note(where: str, places: Sequence[str], cure: str) -> str:
    kept = "only files in {output}, the working directory, are recorded"
    return f"runs wrote files {where}: {few(places, NAMED)} ({kept}; to keep such a file, {cure}; see the table files_written)"


class _Sibling(NamedTuple):
    execution: str
    run: str
    reason: str


SIBLINGS = """
WITH astray AS (
    SELECT any_value(e.reason) AS reason FROM executions e SEMI JOIN observations USING (execution)
    WHERE e.batch = $batch AND e.purpose = 'run' AND starts_with(e.reason, $nothing)
)
SELECT e.execution, e.run, a.reason FROM executions e JOIN astray a ON a.reason IS NOT NULL
WHERE e.batch = $batch AND e.purpose = 'run' AND e.status = 'ok' AND e.ingest_rules = $ingest_rules
AND e.execution NOT IN (SELECT execution FROM observations WHERE method <> 'none')
AND e.execution NOT IN (SELECT execution FROM all_artifacts WHERE kind <> 'log')
ORDER BY e.execution
"""


def find_siblings(store: Store, session: SessionPaths, context: Context) -> set[str]:
    """Find executions that left no file and were not observed, if an observed one wrote all its files elsewhere.

    They have the same command, and so most likely did the same. Records findings, and returns their runs.
    """
    parameters = {"batch": context.batch, "nothing": LEFT_NOTHING, "ingest_rules": context.ingest_rules}
    with store.snapshot() as snapshot:
        if not snapshot.holds("observations"):
            return set()
        snapshot.views.make(("executions", "observations", "all_artifacts"))
        siblings = snapshot.select(_Sibling, SIBLINGS, **parameters)
    if not siblings:
        return set()
    now, lamport = datetime.now(UTC), context.lamport()
    writer = store.writer(session.segment, context.batch)
    reason = f"left no file in its working directory; an observed run with the same command {siblings[0].reason}"
    writer.records(FindingRow(sibling.execution, now, Status.FAILED, reason, lamport) for sibling in siblings)
    store.publish(writer)
    return {sibling.run for sibling in siblings}
