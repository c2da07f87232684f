"""Template formats: one template becomes the input files of all runs."""

from __future__ import annotations

from sierra.templates.base import Template, read

__all__ = ["Template", "read"]
