-- The relation `latest`: the programs and the rules of each batch's last session, the sessions that were stale in it, and the
-- origin that counts in the batch. One commit's rows have one lamport time, so that ties are ordinary: the largest row is taken
-- as a whole, in whatever order the files are read.
WITH asked AS (
    SELECT batch, session, programs, ingest_rules, ended, lamport FROM sessions WHERE ingest_rules IS NOT NULL
    UNION ALL
    SELECT e.batch, session, programs, ingest_rules, judged_at, place
    FROM all_judgements e LEFT JOIN origins o ON o.batch = e.batch
    WHERE purpose = 'run' AND e.packages IS NOT DISTINCT FROM o.packages
),
latest AS (
    SELECT l.batch AS batch, session, programs, ingest_rules, submitted, lamport, s.stale AS stale, o.packages AS packages
    FROM (
        SELECT batch, unnest(max({'lamport': lamport, 'submitted': submitted, 'session': session, 'programs': programs,
               'ingest_rules': ingest_rules}))
        FROM (
            SELECT batch, session, programs, ingest_rules, max(ended) AS submitted, max(lamport) AS lamport
            FROM asked GROUP BY batch, session, programs, ingest_rules
        ) GROUP BY batch
    ) l
    LEFT JOIN (SELECT session, list(stale) AS stale FROM stale_sessions GROUP BY session) s USING (session)
    LEFT JOIN origins o ON o.batch = l.batch
)
