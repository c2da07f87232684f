"""The store: immutable segments of records, read with SQL."""
