-- All judgements of executions, by the run that they may count for: their own run, and each run for which a session reused them.
SELECT NULL::VARCHAR AS reusing, * FROM all_judgements UNION ALL BY NAME
SELECT r.session AS reusing, e.* REPLACE (r.run AS run) FROM reused_executions r JOIN all_judgements e USING (execution)
