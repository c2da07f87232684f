"""Deliverables: what is made from the store for people to look at."""
