"""Comparisons of groups of runs: tests, effect sizes, intervals, and the conclusions that they allow."""
