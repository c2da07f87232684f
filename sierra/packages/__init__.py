"""Reproduction packages: batches, all that they need and all that they produced, in one file; see `sierra.packages.pack`."""
