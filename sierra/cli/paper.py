"""`sierra paper`: make everything of a paper that is bound to queries."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from sierra.cli.arguments import AsJson, Jobs
from sierra.cli.figures import from_here
from sierra.cli.output import note, print_json
from sierra.errors import UsageError
from sierra.util.text import counted

if TYPE_CHECKING:
    from sierra.api import Project
    from sierra.execution.plan import Plan


def paper(
    check: Annotated[
        bool, typer.Option("--check", help="Execute and write nothing; check that all files still follow from the store.")
    ] = False,
    dry_run: Annotated[
        bool, typer.Option("-n", "--dry-run", help="Execute and write nothing; show how many runs are missing.")
    ] = False,
    runner: Annotated[
        str | None, typer.Option("--on", metavar="RUNNER", help="Runner that executes missing runs, as for sierra run.")
    ] = None,
    jobs: Jobs = None,
    as_json: AsJson = False,
) -> None:
    """Make all figures, tables and texts of a paper.

    They are those that sierra.toml binds to queries by the key `query`; comparisons are also bound by groups that are
    queries. The missing runs of these queries are executed. Then one folder ([paper] folder, by default paper/sierra) is
    written: figures, their captions, tables, texts and provenance.json. Names of files stay, and files whose content has not
    changed are not touched, so the folder can be committed to git. A file that somebody edited is neither replaced nor removed.

    With --check, exit status 1 means that a file is missing, was edited or shows other data than the last batch of its query,
    or that a query was not run with the present code. Without a store, as in a fresh clone, the files are only compared with
    provenance.json.

    \b
    Examples:
      sierra paper
      sierra paper -n
      sierra paper --check
    """
    from sierra.cli.open_project import project

    opened = project()
    if check and dry_run:
        raise UsageError("--check executes nothing; leave out --dry-run")
    if check:
        _check(opened, as_json=as_json)
        return
    plans = list({(plan.batch.id, plan.target): plan for plan in map(opened.plans.resolve, opened.paper.queries())}.values())
    for plan in plans:
        plan.check_programs()
    if dry_run:
        _preview(opened, plans, as_json=as_json)
        return
    failed = _execute(opened, plans, runner, jobs, quiet=as_json)
    written = opened.paper.write()
    for path in written.edited:
        note(f"{from_here(path)} was edited, and is left as it is; remove it to have it made again")
    if as_json:
        paths = {name: [str(path) for path in getattr(written, name)] for name in ("changed", "removed", "edited")}
        print_json({**paths, "claims": dict(written.claims)})
    else:
        for path in written.changed:
            print(from_here(path))
        for path in written.removed:
            print(f"{from_here(path)} (removed)")
        for name, registered in written.claims.items():
            print(f"claim {name}: {registered}")
        print(f"{counted(len(written.changed), 'file')} written, {written.unchanged} unchanged")
    if failed or written.edited:
        raise typer.Exit(1)


def _execute(project: Project, plans: list[Plan], runner: str | None, jobs: int | None, *, quiet: bool) -> bool:
    """Execute the missing runs of plans. Return whether a run failed; end the command if runs are left to be executed."""
    from sierra.cli import render_summary
    from sierra.cli.progress import watching

    failed = False
    for plan in plans:
        with watching(quiet=quiet) as display:
            summary = project.execute(plan, figures=False, observer=display, runner=runner, jobs=jobs)
        if not quiet:
            text = f"{summary.executed} executed, {summary.reused} reused, {summary.failed} failed"
            print(f"{render_summary.heading(summary.batch, plan.text, plan.target)}: {counted(summary.runs, 'run')}: {text}")
        if summary.interrupted:
            raise typer.Exit(130)
        if summary.detached or summary.missing:
            note(
                f"{counted(summary.missing, 'run')} of {plan.text} are not executed yet; then make the paper with: sierra paper"
            )
            raise typer.Exit(1)
        failed |= bool(summary.failed)
    return failed


def _preview(project: Project, plans: list[Plan], *, as_json: bool) -> None:
    """Print how many runs of each query would be executed."""
    from sierra.cli import render_summary
    from sierra.execution.dry_run import forecast

    rows = []
    for plan in plans:
        preview = forecast(plan, project.stored())
        rows.append(
            {"batch": plan.batch.id, "query": plan.text, "runs": len(preview.states), "to_execute": len(preview.to_execute)}
        )
        if not as_json:
            heading = render_summary.heading(plan.batch.id, plan.text, plan.target)
            print(f"{heading}: {counted(len(preview.states), 'run')}, {len(preview.to_execute)} to execute")
    if as_json:
        print_json(rows)


def _check(project: Project, *, as_json: bool) -> None:
    """Print one line for each fault; end with exit status 1 if there is one."""
    stored = project.stored() is not None
    faults = project.paper.check()
    if not stored:
        note("there is no store here: the files are compared with provenance.json alone")
    if as_json:
        print_json(faults)
    else:
        for fault in faults:
            print(fault)
        if not faults:
            print("all files follow from the store" if stored else "all files are as they were written")
    if faults:
        raise typer.Exit(1)
