-- The last judgement of each execution.
SELECT execution, l.judgement AS judgement, l.status AS status, l.reason AS reason, l.ingest_rules AS ingest_rules
FROM (
    SELECT e.execution, arg_max({'judgement': e.judgement, 'status': e.status, 'reason': e.reason,
           'ingest_rules': e.ingest_rules}, (e.place, e.judgement)) AS l
    FROM all_judgements e GROUP BY e.execution
)
