"""Figures for a two-column paper."""

from sierra.deliverables import matplotlib_import

matplotlib_import.prepare()
