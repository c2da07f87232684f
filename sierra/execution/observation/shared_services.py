"""Services that the runs of a batch share: whether it is known which files they have used.

If they were observed, their files belong to the sets of files of the observed runs, and a change of one of them is noticed.
"""

from __future__ import annotations

from sierra.execution.plan import Plan
from sierra.store.store import Store
from sierra.util.text import few
from sierra.worker.shared_services import UNOBSERVED

UNKNOWN = """
SELECT count(DISTINCT e.session) FROM effective f JOIN executions e USING (execution)
WHERE f.batch = $batch AND e.session NOT IN (
    SELECT s.session FROM observations o JOIN executions s USING (execution)
    WHERE o.method = 'strace' AND NOT contains(coalesce(o.reason, ''), $unobserved)
)
"""


def note(plan: Plan, store: Store) -> tuple[str, ...]:
    """Return a note if runs of the plan are reused that shared services whose files are not known; else nothing."""
    names = [one.name for one in plan.batch.spec.around.services if one.shared]
    if not names or not any(store.values(int, UNKNOWN, batch=plan.batch.id, unobserved=UNOBSERVED)):
        return ()
    named = few([repr(name) for name in names], 3)
    return (
        f"runs are reused that shared {named}, of which it was not observed what files it reads: "
        "a change of a file that only this service reads is not noticed",
    )
