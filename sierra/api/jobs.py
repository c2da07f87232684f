"""Jobs on clusters."""

from __future__ import annotations

from typing import TYPE_CHECKING

from sierra.api.noun import Noun
from sierra.api.options import observer_for

if TYPE_CHECKING:
    from sierra.execution.cluster_status import ClusterSession
    from sierra.execution.observer import Observer
    from sierra.execution.summary import Summary
    from sierra.execution.takeover import Cancelled


class Jobs(Noun):
    """Jobs on clusters: `project.jobs`."""

    def status(self, prefix: str | None = None, *, observer: Observer | None = None) -> list[ClusterSession]:
        """Return the state of cluster jobs, of all batches or of one. Record the runs that have finished there first.

        >>> project.jobs.status()
        []
        """
        from sierra.execution import sessions, unrecorded

        store = self._project.stored()
        if store is not None and observer is not None:
            for session in unrecorded.found(store.paths):
                observer.notice(str(session))
        if store is None or (prefix is None and not sessions.submitted(store.paths)):
            return []
        from sierra.execution import cluster_status

        return cluster_status.standing(store, prefix, observer)

    def left(self, summary: Summary) -> list[ClusterSession]:
        """Return the state of the cluster jobs that the summary's session left running.

        >>> project.jobs.left(summary)
        []
        """
        if not summary.detached:
            return []
        from sierra.execution import cluster_status

        sessions = (cluster_status.submitted(self._store.paths.session(session)) for session in summary.detached)
        return [session for session in sessions if session is not None]

    def attach(
        self,
        prefix: str,
        *,
        figures: bool = True,
        observer: Observer | None = None,
        progress: bool | None = None,
    ) -> Summary:
        """Reattach to a detached batch and wait for it. Raises NotFound if the batch has no jobs on a cluster.

        >>> project.jobs.attach(summary.batch)
        Traceback (most recent call last):
        sierra.errors.NotFound: ...
        """
        from sierra.api.summaries import described, drawn
        from sierra.execution import takeover

        batch = self._project.records.id(prefix)
        summary = described(self._project, takeover.follow(self._store, batch, observer or observer_for(progress)))
        return drawn(self._project, summary) if figures else summary

    def cancel(self, prefix: str, *, observer: Observer | None = None) -> list[Cancelled]:
        """Cancel a batch's jobs on a cluster, and keep finished runs. Raises NotFound if the batch has no jobs there.

        >>> project.jobs.cancel(summary.batch)
        Traceback (most recent call last):
        sierra.errors.NotFound: ...
        """
        from sierra.execution import takeover
        from sierra.execution.observer import Observer

        return takeover.cancel(self._store, self._project.records.id(prefix), observer or Observer())
