-- Runs with their variables; a row for each value of a variable that differs between the experiments of a run.
WITH seen AS (
    SELECT DISTINCT m.run, m.number{values} FROM batch_runs m JOIN experiments x USING (batch, ordinal)
    LEFT JOIN batches b USING (batch)
),
alike AS (SELECT run, {alike} AS alike FROM seen GROUP BY run)
SELECT run, min(number) AS number{merged} FROM seen JOIN alike USING (run) WHERE alike GROUP BY run UNION ALL
SELECT run, min(number) AS number{axes} FROM seen JOIN alike USING (run) WHERE NOT alike GROUP BY ALL
