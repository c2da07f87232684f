"""The programs that execute runs on a node. They import nothing else of SIERRA, and need only Python 3.8."""
