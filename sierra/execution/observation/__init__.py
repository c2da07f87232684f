"""Observation: which runs are observed, and what follows from the files that they used."""
