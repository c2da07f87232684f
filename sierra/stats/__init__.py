"""Statistics over runs, in SQL."""
