"""`sierra source`: share the recorded code with other clones."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from sierra.cli import lazy_parameters
from sierra.cli.output import print_json
from sierra.util.text import counted

if TYPE_CHECKING:
    from sierra.provenance.source.share_refs import Shared

app = typer.Typer(
    cls=lazy_parameters.Group,
    name="source",
    no_args_is_help=True,
    rich_markup_mode=None,
    help="Share the recorded code with other clones, through git.",
    context_settings={"help_option_names": ["-h", "--help"]},
)

Remote = Annotated[
    str | None,
    typer.Argument(metavar="REMOTE", help="A remote's name or URL (default: the branch's upstream, or origin)."),
]
AsJson = Annotated[bool, typer.Option("--json", help="Print JSON instead of text.")]


@app.command(cls=lazy_parameters.Command)
def push(remote: Remote = None, as_json: AsJson = False) -> None:
    """Push the recorded code to a git remote.

    Then other clones can replay the runs. Uncommitted code is recorded in git under refs/sierra/, which git push does not
    include. Submodules are pushed to their own remotes. No branch or tag changes.

    \b
    Examples:
      sierra source push
      sierra source push origin
    """
    from sierra.cli.open_project import project

    _tell(project().sources.push(remote), "pushed to", as_json=as_json)


@app.command(cls=lazy_parameters.Command)
def fetch(remote: Remote = None, as_json: AsJson = False) -> None:
    """Fetch the recorded code that others pushed with sierra source push.

    Files, branches and tags stay as they are.

    \b
    Examples:
      sierra source fetch
      sierra source fetch origin
    """
    from sierra.cli.open_project import project

    _tell(project().sources.fetch(remote), "fetched from", as_json=as_json)


def _tell(shared: list[Shared], what: str, *, as_json: bool) -> None:
    if as_json:
        print_json(shared)
        return
    for one in shared:
        print(f"{one.repository}: {counted(one.sources, 'source')} {what} {one.remote}, {one.new} of them new")
