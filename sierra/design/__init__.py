"""From a query to experiments and runs: axes, seeds, input files."""
