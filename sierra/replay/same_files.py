"""Are the files that the recorded executions used the same now, in the restored source and outside it?

An execution that was completely observed answers for itself. For the others, those of their session answer as far as they can:
they may have used other files.
"""

from __future__ import annotations

import os
from collections.abc import Collection, Iterator

from sierra.containers.container_setup import GPU as GPU_DEVICE
from sierra.execution.observation import file_sets
from sierra.execution.observation.current_files import GPU, Current, located
from sierra.execution.observation.file_sets import UsedFile
from sierra.execution.observation.unchanged_files import FOUND_ELSEWHERE, changes, with_other_programs
from sierra.provenance import tracer
from sierra.store.store import Store
from sierra.util.lazy_definitions import dataclass
from sierra.util.text import few

SHOWN = 5


@dataclass(frozen=True, slots=True)
class UsedFiles:
    """The files that executions used, compared with those that are here."""

    executions: int
    observed: int
    """Number of executions that were observed from their beginning to their end."""
    compared: int
    """Number of compared files; 0 if no execution of their sessions was observed."""
    changed: tuple[str, ...]
    found: bool
    """True if programs and libraries are found where they were, and folders outside the project have the same names."""

    @property
    def same(self) -> bool | None:
        """True if all used files are the same, False if not; None if not all of them are known."""
        return False if self.changed else True if self.observed == self.executions and self.found else None

    @property
    def notes(self) -> Iterator[str]:
        """Yield a line that names the files that differ."""
        if self.changed:
            yield f"different files: these were used by the recorded executions and are not the same now: {self._shown}"

    @property
    def _shown(self) -> str:
        return few(self.changed, SHOWN)

    @property
    def words(self) -> str:
        """Return what is known about the files, as the end of a sentence about what is the same."""
        if self.same:
            return "and all files that the runs used, are the same"
        if not self.compared:
            remedy = "observe in sierra.toml records it" if tracer.usable() else "that needs strace, which does not work here"
            return f"and the programs, are the same; what was loaded was not recorded ({remedy})"
        if self.observed == self.executions:
            return "and the files that runs read, are the same; but programs, libraries or other files may be found elsewhere"
        rest = (
            f"only {self.observed} of {self.executions} runs {'was' if self.observed == 1 else 'were'} observed"
            if self.observed
            else "these runs were not observed"
        )
        return f"and the files that observed runs used, are the same; {rest}: what else was loaded was not recorded"


NOT_COMPARED = ("listed", FOUND_ELSEWHERE)
OWN = """
SELECT count(DISTINCT execution) FROM observations WHERE reason IS NULL AND list_contains($e, execution)
"""
SETS = """
WITH mine AS (SELECT execution, session FROM executions WHERE list_contains($e, execution)),
complete AS (
    SELECT o.execution, e.session, o.files FROM observations o JOIN executions e USING (execution)
    WHERE o.reason IS NULL AND e.purpose = 'run'
),
sets AS (
    SELECT files FROM complete SEMI JOIN mine USING (execution)
    UNION SELECT files FROM complete
    WHERE session IN (SELECT session FROM mine WHERE execution NOT IN (SELECT execution FROM complete))
)
SELECT DISTINCT files FROM sets
"""
"""The sets of these executions; for those without one, the sets of their sessions."""
WITH_GPU = "SELECT count(*) FROM files_read WHERE path = $gpu AND list_contains($files, files)"
CONTAINED_WITH_GPU = """
SELECT count(*) FROM executions e JOIN isolations i USING (isolation)
WHERE list_contains($e, e.execution) AND list_contains(i.devices, $gpu)
"""
GPU_ADVICE = (
    "the recorded runs used a GPU: parallel atomic additions round otherwise each time; in PyTorch, call "
    "torch.use_deterministic_algorithms(True), and set CUBLAS_WORKSPACE_CONFIG=:4096:8 in [environment]"
)
WRITTEN = """
SELECT DISTINCT w.path FROM files_written w JOIN executions e USING (execution)
WHERE e.session IN (SELECT session FROM executions WHERE list_contains($e, execution))
"""


def compare(store: Store, executions: Collection[str], current: Current, known: Collection[str]) -> UsedFiles:
    """Return the comparison of the files that executions used with the current ones.

    `known` are paths that are compared elsewhere. What the executions have written themselves is no input.
    """
    asked = sorted(set(executions))
    with store.snapshot() as snapshot:
        [observed] = snapshot.values(int, OWN, e=asked)
        sets = file_sets.load(snapshot, snapshot.values(str, SETS, e=asked))
        written, elsewhere = set(snapshot.values(str, WRITTEN, e=asked)), {os.path.realpath(path) for path in known}
        differing = {file for files in changes(sets, current).values() for file in files}
        inputs = (file for file in differing if file.use not in NOT_COMPARED and file.path not in written)
        changed = sorted({file.path for file in inputs if not _is_among(file, elsewhere, current)})
        unchanged = bool(sets.files) and not differing and not with_other_programs(sets, current)
    return UsedFiles(len(asked), observed, len(sets.files), tuple(changed), unchanged)


def used_gpu(store: Store, executions: Collection[str]) -> bool:
    """Return True if executions were recorded to use a GPU: as observed, or by the access of their container."""
    asked = sorted(set(executions))
    with store.snapshot() as snapshot:
        observed = snapshot.values(int, WITH_GPU, gpu=GPU, files=snapshot.values(str, SETS, e=asked))
        return observed != [0] or snapshot.values(int, CONTAINED_WITH_GPU, gpu=GPU_DEVICE, e=asked) != [0]


def _is_among(file: UsedFile, paths: Collection[str], current: Current) -> bool:
    here = located(file.path, current.folders)
    return here is not None and os.path.realpath(here) in paths
