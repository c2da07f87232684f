"""The programs that execute runs on a node; they import nothing of SIERRA, and need Python 3.8 alone."""
