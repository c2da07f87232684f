"""`sierra fsck`: check the store, and repair it."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated

import typer

from sierra.cli.arguments import AsJson
from sierra.cli.output import print_json, readable
from sierra.util.text import counted, size

if TYPE_CHECKING:
    from sierra.maintenance.fsck import Report

SHOWN = 20


def fsck(
    repair: Annotated[bool, typer.Option("--repair", help="Repair what can be repaired; move damaged segments aside.")] = False,
    dry_run: Annotated[bool, typer.Option("--dry-run", "-n", help="With --repair: only show what would be done.")] = False,
    as_json: AsJson = False,
) -> None:
    """Check the whole store, and report all damage.

    Checks every byte against recorded hashes, computes every id again from its record, checks that everything that records
    refer to exists, and that git still has the recorded sources. The exit code is 1 if any check fails, and 3 if something
    cannot be checked because this user may not read it, or because memory or open files are lacking.

    A repair deletes nothing: it moves damaged segments to .sierra/damaged, and keeps their intact content. sierra run executes
    lost runs again.

    \b
    Examples:
      sierra fsck
      sierra fsck --json
      sierra fsck --repair --dry-run
    """
    from sierra.cli import open_project
    from sierra.cli.progress import telling

    project = open_project.project()
    done: tuple[str, ...] = ()
    with telling(quiet=as_json) as tell:
        if repair or dry_run:
            repaired = project.maintenance.repair(dry_run=dry_run, tell=tell)
            report, done = repaired.report, repaired.done
        else:
            report = project.maintenance.fsck(tell=tell)
    if as_json:
        print_json({"repaired": list(done), **_report(report)})
    else:
        for line in done:
            print(("would repair: " if dry_run else "repaired: ") + line)
        _print(report)
        if not done and any(finding.kind.repairable for finding in report.findings):
            print("sierra fsck --repair moves damaged segments aside and keeps the rest; sierra run executes lost runs again")
    if not report.sound:
        raise typer.Exit(1 if report.wrong else 3)


def _report(report: Report) -> dict[str, object]:
    facts = {
        name: getattr(report, name)
        for name in ("sound", "unchecked", "segments", "files", "bytes", "objects", "executions", "seconds")
    }
    findings = [
        {"kind": one.kind, "path": one.path, "what": one.what, **asdict(one.affected), "damage": one.kind.wrong}
        for one in report.findings
    ]
    return {**facts, "findings": findings}


def _print(report: Report) -> None:
    for finding in report.findings[:SHOWN]:
        print(readable(str(finding)))
    if len(report.findings) > SHOWN:
        print(f"and {len(report.findings) - SHOWN} more (--json has them all)")
    result = "sound" if report.sound else f"{report.unchecked} not checked"
    print(
        f"{counted(report.wrong, 'problem') if report.wrong else result}: {counted(report.segments, 'segment')}, "
        f"{counted(report.files, 'file')}, {size(report.bytes)}, {counted(report.objects, 'object')}, "
        f"{counted(report.executions, 'execution')} checked in {report.seconds:.1f} s"
    )
