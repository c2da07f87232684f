"""Maintenance of the store: checking, repairing, collecting garbage and removing records."""
