"""Videos: from recorded rows and files over frames to MP4, WebM and GIF."""
