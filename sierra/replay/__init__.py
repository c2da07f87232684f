"""Replay: execute recorded runs again, and compare the outcome with the record."""
