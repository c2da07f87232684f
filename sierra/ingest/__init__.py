"""Ingest: what workers report becomes segments of the store, checked on the way.

`success` decides whether an execution was successful: by its exit status, and by the outputs and the marker that the
project asks for. `match_outputs` decides which of its files become tables, and `tables` reads them with the readers of
`read`. When other runs of the same experiment are there, `consistency` compares them: other row counts, other columns,
or a table that one run alone has or lacks become *findings*. `warnings` lists what is allowed but probably not intended.
When the rules of the project change, `rejudge` applies them to what is recorded.

Recording can be repeated: what is in the store already is not recorded again. So a session that died is finished by
reading its journal once more.
"""
