"""`sierra fsck`, `sierra gc`, `sierra rm`: keeping the store sound."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sierra.cli import complete

if TYPE_CHECKING:
    from sierra.maintenance.fsck import Report
    from sierra.maintenance.gc import Collection
    from sierra.maintenance.remove import Removal

SHOWN = 20


def fsck(
    repair: Annotated[bool, typer.Option("--repair", help="Make again what can be, and put aside what is damaged.")] = False,
    dry_run: Annotated[bool, typer.Option("--dry-run", "-n", help="With --repair: only say what would be done.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object instead.")] = False,
) -> None:
    """Check all that is recorded, and name what is damaged.

    Every byte is checked against what vouches for it; every id is made again from its record; all that records refer to must
    be there; the recorded sources must still be in git. The exit code is 1 if anything of that is not so.

    A repair deletes nothing: damaged segments are moved to .sierra/damaged, and what is sound in them is kept. What was lost is
    executed again by sierra run.

    \b
    Examples:
      sierra fsck
      sierra fsck --json
      sierra fsck --repair --dry-run
    """
    from sierra.cli import open_project
    from sierra.cli.output import print_json

    project, tell = open_project.project(), _telling(quiet=as_json)
    done: tuple[str, ...] = ()
    if repair or dry_run:
        repaired = project.repair(dry_run=dry_run, tell=tell)
        report, done = repaired.report, repaired.done
    else:
        report = project.fsck(tell=tell)
    if as_json:
        print_json({"repaired": list(done), **_report(report)})
    else:
        for line in done:
            print(("would repair: " if dry_run else "repaired: ") + line)
        _print(report)
        if not done and any(one.kind.repairable for one in report.findings):
            print("sierra fsck --repair puts aside what is damaged, and keeps the rest; sierra run makes again what is lost")
    if not report.sound:
        raise typer.Exit(1)


def _report(report: Report) -> dict[str, Any]:
    told = {name: getattr(report, name) for name in ("sound", "segments", "files", "bytes", "objects", "executions", "seconds")}
    findings = [
        {"kind": one.kind, "path": one.path, "what": one.what, **asdict(one.affected), "damage": not one.kind.fine}
        for one in report.findings
    ]
    return {**told, "findings": findings}


def _print(report: Report) -> None:
    from sierra.cli.output import readable

    for finding in report.findings[:SHOWN]:
        print(readable(str(finding)))
    if len(report.findings) > SHOWN:
        print(f"and {len(report.findings) - SHOWN} more (--json has them all)")
    wrong = sum(not finding.kind.fine for finding in report.findings)
    print(
        f"{'sound' if report.sound else f'{wrong} wrong'}: {report.segments} segments, {report.files} files, "
        f"{size(report.bytes)}, {report.objects} objects, {report.executions} executions checked in {report.seconds:.1f} s"
    )


def gc(
    yes: Annotated[bool, typer.Option("--yes", "-y", help="Do not ask.")] = False,
    dry_run: Annotated[bool, typer.Option("--dry-run", "-n", help="Only say what would be done.")] = False,
    damaged: Annotated[bool, typer.Option("--damaged", help="Also the segments that sierra fsck --repair put aside.")] = False,
    raw: Annotated[
        bool, typer.Option("--raw", help="Also the bytes of files that became tables; the rows of the tables stay.")
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object instead.")] = False,
) -> None:
    """Remove what nothing needs, and merge small files.

    Nothing that was recorded is lost, but with --raw, which says what is. Git's refs/sierra/ stay, because other projects may
    share the repository. Where there is no terminal to ask on, --yes is needed.

    \b
    Examples:
      sierra gc --dry-run
      sierra gc --yes
      sierra gc --raw --dry-run
    """
    from sierra.cli import open_project
    from sierra.cli.output import print_json
    from sierra.maintenance.gc import text

    project = open_project.project()
    if dry_run:
        found: Collection | None = project.collection(damaged=damaged, raw=raw)
    else:
        found = project.collect(
            damaged=damaged, raw=raw, agree=lambda found: _agreed(text(found), yes, as_json, "to be tidied up")
        )
    if found is None:
        print("nothing was done")
        raise typer.Exit(1)
    if as_json:
        print_json({"done": not dry_run, **asdict(found)})
        return
    print("\n".join(text(found)) or "nothing: there is only what is needed")
    if found.recovered:
        print(f"{found.recovered} executions that had finished are recorded now")
    if found.left:
        print(f"{found.left} old segments are still being read; the next sierra gc removes them")


def rm(
    prefixes: Annotated[
        list[str],
        typer.Argument(
            metavar="HASH...",
            autocompletion=complete.ids,
            help="Batches, experiments, runs or executions, by the beginning of their ids.",
        ),
    ],
    yes: Annotated[bool, typer.Option("--yes", "-y", help="Do not ask.")] = False,
    dry_run: Annotated[bool, typer.Option("--dry-run", "-n", help="Only say what would be deleted.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object instead.")] = False,
) -> None:
    """Delete recorded batches, experiments, runs or executions.

    What goes, and what stays because others have it, is said first.

    A batch goes whole; of an experiment or a run, what was executed goes, and is executed again when it is asked for. Runs of a
    batch or an experiment that others have too keep their executions. Where there is no terminal to ask on, --yes is needed.

    \b
    Examples:
      sierra rm 774d --dry-run
      sierra rm 774d 03ab --yes
    """
    from sierra.cli import open_project
    from sierra.cli.output import print_json

    def agree(found: Removal) -> bool:
        return found.nothing or _agreed(_lines(found), yes, as_json, "to be deleted, for good")

    project = open_project.project()
    if dry_run:
        removal: Removal | None = project.removal(*prefixes)
    else:
        removal = project.remove(*prefixes, agree=agree)
    if removal is None:
        print("nothing was deleted")
        raise typer.Exit(1)
    if as_json:
        print_json({"done": not dry_run, **asdict(removal)})
        return
    if dry_run:
        print("\n".join(_lines(removal)))
    else:
        print(f"deleted: {len(removal.batches)} batches, {removal.executions} executions")
        if removal.left:
            print(f"{removal.left} old files are still being read; sierra gc removes them")


def _lines(removal: Removal) -> list[str]:
    from sierra.maintenance.remove import text

    found = [*text(removal), *([f"{size(removal.bytes)} that these wrote"] if removal.bytes else [])]
    return found if not removal.nothing else ["nothing: there is no execution of it", *found]


def _agreed(lines: list[str], yes: bool, quiet: bool, what: str) -> bool:
    """Whether to go on: by --yes, or by an answer on a terminal. Raises UsageError where there is neither."""
    import sys

    from sierra.errors import UsageError

    if not yes and not (sys.stdin.isatty() and sys.stdout.isatty()):
        raise UsageError(f"{what}: {'; '.join(lines)}; there is no terminal to ask on, so say --yes")
    if not quiet:
        print(f"{what}:\n" + "\n".join(f"  {line}" for line in lines))
    return yes or typer.confirm("go on?", default=False)


def size(count: int) -> str:
    """Bytes as people read them."""
    amount, unit = float(count), "bytes"
    for larger in ("kB", "MB", "GB", "TB"):
        if amount < 1000:
            break
        amount, unit = amount / 1000, larger
    return f"{amount:.3g} {unit}" if unit != "bytes" else f"{count} bytes"


def _telling(*, quiet: bool) -> Any:
    """Says on standard error how far it has come, now and then."""
    import sys
    import time

    said = time.monotonic()

    def tell(text: str) -> None:
        nonlocal said
        if not quiet and time.monotonic() - said > 5:
            said = time.monotonic()
            print(text, file=sys.stderr, flush=True)

    return tell
