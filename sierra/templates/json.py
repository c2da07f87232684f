"""The template format `json`."""

from __future__ import annotations

from typing import ClassVar

from sierra.templates.json_notation import JsonNotation
from sierra.templates.notation import Notation
from sierra.templates.tree import TreeTemplate


class JsonTemplate(TreeTemplate):
    """The template format `json`."""

    notation: ClassVar[Notation] = JsonNotation()
