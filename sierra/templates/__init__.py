"""Template formats: one template becomes the input files of all runs."""

from __future__ import annotations

from sierra.templates.base import Template, read
from sierra.templates.several import of_project

__all__ = ["Template", "of_project", "read"]
