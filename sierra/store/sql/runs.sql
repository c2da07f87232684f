-- Runs, one row each, with their variables ({axes}) and their state.
WITH state AS (
    SELECT run, count(*) AS executions, arg_max(status, lamport) AS last FROM executions WHERE purpose <> 'capture' GROUP BY run
),
counted AS ({counted})
SELECT m.run, {axes}any_value(m.seed) AS seed, min(m.number) AS number, any_value(m.input) AS input, any_value(m.spec) AS spec,
    CASE WHEN any_value(c.outcome) = '{success}' THEN 'ok' WHEN any_value(c.outcome) IS NOT NULL THEN 'accepted'
        WHEN any_value(s.last) IN ('ok', 'accepted') THEN 'stale' ELSE coalesce(any_value(s.last), 'missing') END AS status,
    any_value(c.outcome) AS outcome, any_value(c.execution) AS execution, coalesce(any_value(s.executions), 0) AS executions
FROM batch_runs m JOIN experiments x USING (batch, ordinal) LEFT JOIN batches b USING (batch) LEFT JOIN state s USING (run)
LEFT JOIN counted c USING (run) GROUP BY m.run
