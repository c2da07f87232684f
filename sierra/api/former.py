"""Former names of methods of `Project`; they work for one version, and warn."""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sierra.api.project import Project


MOVED = {
    "plans": "plans=of_targets resolve build write_inputs proposal=estimate runner_of=runner check_attended",
    "studies": "study=run planned_study=planned runs_needed runs_for_power",
    "jobs": "status left attach cancel",
    "records": "batch record_id=id show files outputs declare_outputs why diff removal remove",
    "deliverables": "figures draw draw_batches draw_together=draw_targets "
    "check_figures=check deliverable=find report model_errors",
    "comparisons": "compare=make compare_declared=declared groups_of=groups draw_comparison=draw paper_comparison=text",
    "claims": "claims=evaluate register_claims=register claims_against=against set_baseline",
    "paper": "paper=write check_paper=check paper_queries=queries paper_table=table",
    "packages": "package=pack import_package=import_records diff_packages=diff metadata",
    "images": "images=known image=contents image_name=name pin pin_all "
    "build_image=build import_image=import_archive export_image=export",
    "sources": "push_sources=push fetch_sources=fetch",
    "maintenance": "fsck repair collection collect",
}
"""The methods of each noun that `Project` had: with the same name, or as `former=new`."""
FORMER = {
    former: f"{noun}.{new or former}"
    for noun, words in MOVED.items()
    for former, _, new in (word.partition("=") for word in words.split())
}
"""The new name of each method, as `noun.method`. The former names go in version 0.2."""


def method(project: Project, name: str) -> Any:
    """Return the method of a project that has this former name; warn the caller's caller."""
    noun, _, new = FORMER[name].partition(".")
    text = f"project.{name} is now project.{noun}.{new}; the former name goes in version 0.2"
    warnings.warn(text, DeprecationWarning, stacklevel=3)
    return getattr(getattr(project, noun), new)
