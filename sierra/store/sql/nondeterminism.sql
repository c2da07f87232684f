-- Runs whose output changed between successful executions with the same programs, with the worst verdict of a replay.
WITH several AS (
    SELECT run, programs, count(*) AS executions, count(DISTINCT result) AS results
    FROM executions e ANTI JOIN imported_sessions i ON i.session = e.session
    WHERE status IN ('ok', 'accepted') AND purpose <> 'capture' GROUP BY run, programs HAVING min(result) < max(result)
),
compared AS (
    SELECT e.run, e.programs, max(CASE v.verdict WHEN 'identical' THEN 0 WHEN 'equal' THEN 1 WHEN 'within tolerance' THEN 2
        ELSE 3 END) AS worst
    FROM verdicts v JOIN executions e ON e.execution = v.execution GROUP BY e.run, e.programs
)
SELECT s.*, CASE j.worst WHEN 0 THEN 'identical' WHEN 1 THEN 'equal' WHEN 2 THEN 'within tolerance' WHEN 3 THEN 'different'
    END AS verdict
FROM several s LEFT JOIN compared j USING (run, programs)
