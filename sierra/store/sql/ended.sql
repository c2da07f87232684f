-- The execution of each run in each batch that a replay repeats: one with a result or, if there is none, one whose program has
-- ended with an error.
{latest}
SELECT m.batch, m.ordinal, m.run, e.execution, e.judgement, e.status
FROM batch_runs m
JOIN latest l ON m.batch = l.batch
JOIN all_candidates e ON e.run = m.run AND ({result} OR {by_itself}) AND {fits}
QUALIFY row_number() OVER (
    PARTITION BY m.batch, m.ordinal, m.run ORDER BY {result} DESC, {last_first}
) = 1
