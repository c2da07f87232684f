"""`sierra explore`: look at batches, draw charts and ask SQL in the browser."""

from __future__ import annotations

import sys
import threading
from typing import Annotated

import typer

from sierra.cli.output import note, print_json
from sierra.errors import UsageError


def explore(
    context: typer.Context,
    port: Annotated[int, typer.Option("--port", min=0, max=65535, help="Port on this machine; 0: a free one.")] = 0,
    write: Annotated[bool, typer.Option("--write", help="Let the page add figures to sierra.toml.")] = False,
    browser: Annotated[
        bool, typer.Option("--browser/--no-browser", help="Open the page in the browser, if this is a terminal.")
    ] = True,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print one JSON object instead of text; the browser is not opened.")
    ] = False,
) -> None:
    """Explore batches in the browser: charts, and SQL over the store.

    The page is served on 127.0.0.1 until Ctrl-C. Its address contains a token, without which nothing is answered. Statements
    can only read the store, and are ended after 30 s. Nothing is loaded from the network.

    \b
    Examples:
      sierra explore
      sierra explore --port 8080 --no-browser
      sierra explore --write
      sierra explore --json
    """
    from sierra.cli.open_project import project
    from sierra.extensions.explorer import explorer
    from sierra.extensions.explorer.server import ADDRESS

    if write and context.obj is not None:
        raise UsageError("a package is never changed; leave out --write")
    server = explorer(project(), port=port, write=write, package=context.obj)
    try:
        if as_json:
            print_json({"address": server.url, "host": ADDRESS, "port": server.port, "token": server.token, "writes": write})
            sys.stdout.flush()
        else:
            print(server.url, flush=True)
            note("Ctrl-C ends the server")
            if browser and sys.stdout.isatty():
                # A browser in the terminal returns only when it is closed, and asks for the page before that.
                threading.Thread(target=_open, args=(server.url,), daemon=True).start()
        server.serve()
    except KeyboardInterrupt:
        note("ended")


def _open(url: str) -> None:
    import webbrowser

    if not webbrowser.open(url):
        note("no browser was found; open the address in one")
