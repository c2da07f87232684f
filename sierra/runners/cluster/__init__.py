"""The cluster runner: array jobs whose elements execute many runs each."""
