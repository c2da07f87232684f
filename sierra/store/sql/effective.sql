-- The effective execution of each run in each batch: of all candidates that count, the last judgement of the last execution.
{latest}
SELECT m.batch, m.ordinal, m.run, e.execution, e.judgement, l.submitted, l.lamport, {outcome} AS outcome
FROM batch_runs m
JOIN latest l ON m.batch = l.batch
JOIN all_candidates e ON e.run = m.run AND {counts}
QUALIFY row_number() OVER (PARTITION BY m.batch, m.ordinal, m.run ORDER BY {last_first}) = 1
