"""Reproduction packages: one file with everything that results rest on, which proves itself."""
