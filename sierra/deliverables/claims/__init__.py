"""Claims of a paper: which runs decide them, and whether they hold."""
