"""Ingest: results that workers report become segments of the store, after checks.

`success` decides if an execution was successful: by its exit status, and by the outputs and the marker that the project
requires. `match_outputs` decides which of its files become tables, and `read_into_segment` reads them with the readers of
`read`. If the store has other runs of the same experiment, `consistency` compares them. Different row counts, different
columns, or a table that only one run has or lacks become *findings*. `suspicious_tables` lists properties that are allowed
but probably not intended. When the rules of the project change, `rejudge` applies them to recorded executions.

Recording can be repeated: records that are already in the store are not recorded again. So a session that died is
finished by reading its journal once more.
"""
