"""The programs that run where SIERRA is not installed. They import nothing else of SIERRA, and need only Python 3.8."""
