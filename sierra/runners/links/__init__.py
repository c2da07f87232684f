"""Hosts that are reached over SSH: robots, and later clusters."""
