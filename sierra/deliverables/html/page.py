"""The page around sections, with its script, its style, and the policy that allows nothing else."""

from __future__ import annotations

import base64
from collections.abc import Iterable, Mapping
from functools import cache
from hashlib import sha256
from pathlib import Path

from sierra.deliverables.html.escaping import steering
from sierra.util.html_elements import element

ASSETS = Path(__file__).with_name("assets")
ASKS = "; frame-src 'self'; media-src 'self'; connect-src 'self'"
PLAYS = "; media-src data:"
UPLOT = "uplot"
"""The folder of uPlot 1.6.32, which draws the charts, as its package on npm has it: see THIRD-PARTY.md."""


def page(
    title: str,
    sections: Iterable[str],
    metadata: Mapping[str, str] | None = None,
    *,
    extra: str = "",
    asks: bool = False,
    plays: bool = False,
) -> bytes:
    """Return a whole page, as UTF-8. `sections` are elements of HTML; `metadata` are texts by name.

    `extra` are the names of further scripts and styles in `assets`, separated by blanks. With `asks`, scripts may ask the
    server that sent the page, and show its pages and videos. With `plays` instead, the page may have videos, which are in the
    page itself.
    """
    script, style = _script(extra), _style(extra)
    images = "data: 'self'" if asks else "data:"
    policy = (
        f"default-src 'none'; script-src '{_hash(script)}'; style-src '{_hash(style)}'; img-src {images}; "
        f"base-uri 'none'; form-action 'none'{ASKS if asks else PLAYS if plays else ''}"
    )
    lines = (
        "<!DOCTYPE html>",
        '<html lang="en"><head><meta charset="utf-8">',
        f'<meta http-equiv="Content-Security-Policy" content="{policy}">',
        '<meta name="viewport" content="width=device-width, initial-scale=1">',
        '<meta name="color-scheme" content="light dark">',
        *(element("meta", name=name, content=content) for name, content in (metadata or {}).items()),
        *(['<link rel="icon" href="data:,">'] if asks else []),
        element("title", title),
        f"<style>{style}</style></head><body>",
        *sections,
        f"<script>{script}</script></body></html>",
        "",
    )
    return "\n".join(lines).encode()


@cache
def _script(extra: str) -> str:
    """Return the scripts of a page, which show the same characters as escapes as the texts in the page."""
    notice = (ASSETS / UPLOT / "LICENSE").read_text("utf-8")
    parts = f"/*! uPlot\n{notice}*/", (ASSETS / UPLOT / "uPlot.iife.min.js").read_text("utf-8"), _asset("page.js")
    return "\n".join((*parts, *(_asset(f"{name}.js") for name in extra.split()))).replace("[STEERING]", steering())


@cache
def _style(extra: str) -> str:
    parts = (ASSETS / UPLOT / "uPlot.min.css").read_text("utf-8"), _asset("page.css")
    return "\n".join((*parts, *(_asset(f"{name}.css") for name in extra.split())))


def _asset(name: str) -> str:
    return (ASSETS / name).read_text("utf-8")


def _hash(content: str) -> str:
    return f"sha256-{base64.b64encode(sha256(content.encode()).digest()).decode()}"
