"""Painting the frames of videos with matplotlib."""

from sierra.deliverables import matplotlib_import

matplotlib_import.prepare()
