"""`sierra fsck`, `sierra gc`, `sierra rm`: keeping the store sound."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from sierra.keeping.checking import Report

SHOWN = 20


def fsck(
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object instead.")] = False,
) -> None:
    """Hash all that is recorded, and name what is damaged and what that concerns.

    Every byte is checked against what vouches for it; every id is made again from its record; all that records refer to must
    be there; the recorded sources must still be in git. The exit code is 1 if anything of that is not so.

    \b
    Examples:
      sierra fsck
      sierra fsck --json
    """
    from sierra.cli import opened
    from sierra.cli.output import print_json

    report = opened.project().fsck(tell=_telling(quiet=as_json))
    if as_json:
        print_json(_report(report))
    else:
        _print(report)
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
        f"{'sound' if report.sound else f'{wrong} found'}: {report.segments} segments, {report.files} files, "
        f"{size(report.bytes)}, {report.objects} objects, {report.executions} executions checked in {report.seconds:.1f} s"
    )


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
