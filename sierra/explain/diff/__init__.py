"""Differences between two recorded batches, experiments, runs or executions, or between a batch and a plan."""
