"""Elements of HTML as values: every text in them is escaped when the element is made, whoever wrote the text.

element("p", "a < b ", element("b", name), class_="note", aria_label=name)
"""

from __future__ import annotations

import html
from collections.abc import Iterable
from typing import TypeAlias

from sierra.util.text import visible


class Markup(str):
    """A text that is HTML already. Only `element`, `joined`, and functions that escape make one."""

    __slots__ = ()


Node: TypeAlias = Markup | str | None
"""Content of an element: a `str` that is not `Markup` is escaped; None is nothing."""
Attribute: TypeAlias = str | int | bool | None
"""The value of an attribute; True for one without a value, False or None for one that is not there."""
VOID = frozenset({"br", "img", "meta"})


def text(content: str) -> str:
    """Return a text for an element or a quoted attribute.

    Characters that control are shown as escapes: see `sierra.util.text.visible`. All others stay as they are, so that names in
    any script, and SQL, can be copied.
    """
    return html.escape(visible(content)).replace("\r", "&#13;")


def element(tag: str, *content: Node, **attributes: Attribute) -> Markup:
    """Return an element. `class_="x"` is the attribute `class`, `aria_label="x"` is `aria-label`."""
    given = "".join(_attribute(name, value) for name, value in attributes.items())
    end = "" if tag in VOID else f"{joined(content)}</{tag}>"
    return Markup(f"<{tag}{given}>{end}")


def joined(content: Iterable[Node], between: str = "") -> Markup:
    """Return nodes after each other, with white space between them."""
    return Markup(between.join(one if isinstance(one, Markup) else text(one) for one in content if one is not None))


def _attribute(name: str, value: Attribute) -> str:
    if value is None or value is False:
        return ""
    called = name.rstrip("_").replace("_", "-")
    return f" {called}" if value is True else f' {called}="{text(str(value))}"'
