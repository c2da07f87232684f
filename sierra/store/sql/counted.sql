-- Each run's effective execution and its judgement, in the batch that was submitted last.
SELECT run, c.execution AS execution, c.judgement AS judgement, c.outcome AS outcome
FROM (
    SELECT run, arg_max({'execution': execution, 'judgement': judgement, 'outcome': outcome}, lamport) AS c
    FROM effective GROUP BY run
)
