"""The page of the explorer: forms and places that its script fills with the server's answers."""

from __future__ import annotations

from pathlib import Path

from sierra.deliverables import html
from sierra.util.html_elements import text

BODY = Path(__file__).with_name("explorer.html")


def page(title: str) -> bytes:
    """Return the page, as UTF-8. It contains no data; its script asks for them."""
    body = BODY.read_text("utf-8").replace("TITLE", text(title))
    return html.page(f"{title}: SIERRA", [body], extra="explorer runs", asks=True)
