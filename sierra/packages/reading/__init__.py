"""Received packages: opening, comparing and importing them, without executing anything."""
