"""Execution: from a query to recorded results."""
