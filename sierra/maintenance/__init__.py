"""Keeping the store sound: checking all that is in it, repairing, tidying up, and removing what is not wanted any more."""
