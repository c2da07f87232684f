"""Explanations: why runs were executed, and how two recorded things differ."""
