"""Supervised trials: runs that a person prepares, watches and judges, one after the other."""
