"""Supervised trials: runs that a person prepares, watches and judges, one after the other.

`supervised_by` and `mark_trial` are the functions for Python.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from sierra.api import Project
    from sierra.extensions.trials.supervisor import Supervisor
    from sierra.store.row_types import TrialRow


@contextlib.contextmanager
def supervised_by(supervisor: Supervisor) -> Iterator[None]:
    """Let a supervisor start, watch and judge the trials that are executed in this block."""
    from sierra.config.extensions import giving
    from sierra.extensions.trials.session import Supervision

    with giving(Supervision(lambda trials: supervisor)):
        yield


def mark_trial(
    project: Project,
    prefix: str,
    *,
    valid: bool | None = None,
    reason: str | None = None,
    note: str | None = None,
    operator: str | None = None,
) -> TrialRow:
    """Record a remark on an execution, or on the effective execution of a run; what is None stays as it was.

    If it is not `valid`, it does not count any more, and the next request of its batch executes the run again. Nothing is
    deleted. Raises NotFound for an unknown id, UsageError if it becomes invalid without a reason.
    """
    from sierra.extensions.trials import marks

    return marks.mark(project.store, prefix, valid=valid, reason=reason, note=note, operator=operator)
