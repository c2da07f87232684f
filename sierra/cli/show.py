"""`sierra show`: show a batch, an experiment, a run or an execution."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated, Any

import typer

from sierra.cli import complete

SHOWN_REASONS = 10
MORE = 4
"""The largest number of column names that are printed if the columns do not fit the terminal."""
AT_MOST = {"attempts": 20, "nondeterminism": 10, "verdicts": 20}
"""The largest number of shown rows, for tables that may be as long as a batch."""


def show(
    prefix: Annotated[
        str,
        typer.Argument(
            metavar="HASH", autocompletion=complete.anything, help="Id, as `sierra ls` prints it; a prefix is enough."
        ),
    ],
    long: Annotated[bool, typer.Option("--long", help="Show full ids, and do not shorten text to fit the terminal.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object instead of text.")] = False,
) -> None:
    """Show a batch, experiment, run, execution or session.

    For a batch and a session, this includes the path of the log file, which lists the events while runs executed.

    \b
    Examples:
      sierra show 3f9a1c
      sierra show 3f9a1c --long
    """
    from sierra.cli.open_project import project
    from sierra.cli.output import print_json
    from sierra.cli.render_environment import print_environment, print_image, print_isolation, print_programs

    shown = project().show(prefix)
    if as_json:
        print_json(shown)
        return
    if shown["kind"] == "session":
        _print(shown, long=long)
        return
    failures, used, around = shown.pop("failures", []), shown.pop("programs", []), shown.pop("environment", None)
    image, reach, isolations = _contained(shown)
    commit = shown.pop("history", None)
    _print(shown, long=long)
    if commit:
        _print_commit(commit)
    if image:
        print_image(image, reach)
        for one in isolations:
            print_isolation(one)
        if not isolations and shown["kind"] == "execution":
            print("\nisolation: none, executed directly on the host")
    if used:
        print_programs(used)
    if around:
        print_environment(around)
    _print_failures(failures)
    if shown["kind"] in ("run", "execution"):
        print(f"\nsierra files {shown[shown['kind']][:10]} PATH prints a recorded file; --to FOLDER writes all files")


def _print_commit(known: Mapping[str, Any]) -> None:
    """Print the recorded commit as the repository has it now."""
    from sierra.cli.output import fields

    commit = known["commit"]
    print("\ncommit, as in the repository now:")
    told = {
        "subject": commit["subject"],
        "author": f"{commit['author']}, {commit['date']:%Y-%m-%d}",
        "described": known["described"],
        "branches/tags": ", ".join(known["branches"]) or "none",
        "remote": known["remote"] or "none",
    }
    fields(told, "  ")


def _contained(shown: dict[str, Any]) -> tuple[dict[str, Any] | None, list[str], list[dict[str, Any]]]:
    """Remove and return the image, the host access and the isolation of a batch or an execution."""
    if shown["kind"] == "batch":
        spec, isolations = shown["spec"], shown.pop("isolations")
        del spec["image"]
        return shown.pop("image"), spec.pop("host_access") or [], isolations
    if shown["kind"] == "execution":
        isolation = shown.pop("isolation", None)
        return shown.pop("image"), shown.pop("host_access"), [isolation] if isolation else []
    return None, [], []


def _print_failures(failures: Sequence[Mapping[str, Any]]) -> None:
    """Print the reasons why runs failed, a line each."""
    from sierra.cli.output import cell, readable

    if failures:
        print("\nfailures:")
    for failure in failures[:SHOWN_REASONS]:
        values = "".join(f"{name}={cell(value)}, " for name, value in failure["values"].items())
        runs = "1 run" if failure["runs"] == 1 else f"{failure['runs']} runs"
        example = f"run {failure['run'][:10]} ({values}number {failure['number']})"
        print(f"  {runs}: {readable(failure['reason'])}, e.g. {example}")
    if len(failures) > SHOWN_REASONS:
        runs = sum(failure["runs"] for failure in failures[SHOWN_REASONS:])
        print(f"  and {len(failures) - SHOWN_REASONS} more reasons, {runs} runs (--json has them all)")


def _print(shown: dict[str, Any], *, long: bool) -> None:
    """Print plain values first, then tables and logs. Ids are short unless `long`, except the id of the shown record."""
    from sierra.cli.output import fields, fitting, short_id, table
    from sierra.util.text import few

    def told(value: Any) -> Any:
        return value if long else short_id(value)

    plain = {name: value for name, value in shown.items() if not isinstance(value, dict | list) and name != "log_tail"}
    fields({name: value if name == shown["kind"] else told(value) for name, value in plain.items()})
    for name, value in shown.items():
        if isinstance(value, dict):
            print(f"\n{name}:")
            fields({inner: told(one) for inner, one in value.items()}, "  ")
        elif isinstance(value, list) and value:
            print(f"\n{name}:")
            if isinstance(value[0], dict):
                columns = list(dict.fromkeys(key for row in value for key in row if key != "log_tail"))
                most = AT_MOST.get(name, len(value))
                rows = [[told(row.get(column)) for column in columns] for row in value[:most]]
                wide = len(columns) if long else fitting(columns, rows)
                table(columns[:wide], [row[:wide] for row in rows], width=0 if long else None)
                if wide < len(columns):
                    print(f"(and {few(columns[wide:], MORE)}, in --json)")
                if len(value) > most:
                    print(f"and {len(value) - most} more (--json has them all)")
            else:
                print("  " + ", ".join(map(str, value)))
    if shown.get("log_tail"):
        print("\nlog:\n" + shown["log_tail"])
