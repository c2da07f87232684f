"""Additions to the summary of an execution: figures, and a description of new outputs."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from sierra.errors import Missing

if TYPE_CHECKING:
    from sierra.api.project import Project
    from sierra.execution.outputs_taken import TakenOutputs
    from sierra.execution.summary import Summary


def described(project: Project, summary: Summary) -> Summary:
    """Return the summary with a description of the outputs, if its sessions are the first with such tables or files."""
    if summary.interrupted or not summary.sessions:
        return summary
    from sierra.execution import outputs_taken

    if not any(outputs_taken.is_new(project.store, session) for session in summary.sessions):
        return summary
    return replace(summary, outputs=taken(project, summary.batch, inside=False))


def taken(project: Project, batch: str, *, inside: bool) -> TakenOutputs:
    """Return how a batch's outputs were read; with `inside`, also by a look into its files."""
    from sierra.execution import outputs_taken, targets

    declared = targets.of_batch(project.loaded, project.store, batch).config.outputs
    outputs = outputs_taken.taken(project.store, batch, declared, inside=inside)
    return replace(outputs, target=targets.recorded(project.store, batch)) if project.targets else outputs


def drawn(project: Project, summary: Summary) -> Summary:
    """Return the summary with figures, if there is something to draw."""
    if summary.interrupted or summary.detached or summary.missing + summary.failed == summary.runs:
        return summary
    from sierra.deliverables import render

    try:
        files, notes = render.figures(project.loaded, project.store, summary.batch, again=False)
    except Missing as error:
        return replace(summary, figure_error=str(error))
    return replace(summary, figures=tuple(map(str, files)), notes=(*summary.notes, *notes))
