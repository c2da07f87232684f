-- The same as counted.sql in a store with imported sessions: first the batches that were executed here, then those that were
-- imported first. So an import does not change what counts for runs that the store has.
WITH imported AS (SELECT packages, min(lamport) AS imported FROM imported_sessions GROUP BY packages)
SELECT run, c.execution AS execution, c.judgement AS judgement, c.outcome AS outcome
FROM (
    SELECT run, arg_max({'execution': execution, 'judgement': judgement, 'outcome': outcome},
           (o.packages IS NULL, -coalesce(i.imported, 0), -coalesce(len(o.packages), 0), f.lamport)) AS c
    FROM effective f LEFT JOIN origins o USING (batch) LEFT JOIN imported i ON i.packages = o.packages GROUP BY run
)
