"""Videos: from recorded rows and files over frames to MP4, WebM and GIF."""

from sierra.deliverables import matplotlib_import

matplotlib_import.prepare()
