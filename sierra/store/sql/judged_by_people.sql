-- All judgements; the successful ones of executions whose trial is not valid have the status invalid.
SELECT e.* REPLACE (
    CASE WHEN t.refused AND e.status IN ('ok', 'accepted') THEN 'invalid' ELSE e.status END AS status,
    CASE WHEN t.refused AND e.status IN ('ok', 'accepted') THEN {beginning} || coalesce(': ' || t.said, '')
         ELSE e.reason END AS reason
) FROM ({judgements}) e LEFT JOIN (
    SELECT execution, NOT coalesce(valid, true) AS refused, reason AS said FROM trials
) t ON t.execution = e.execution
