-- The origin that counts in each batch with imported sessions: this store, else the first import, its own sessions first.
WITH asked AS (
    SELECT batch, session FROM all_sessions UNION SELECT batch, session FROM all_judgements WHERE purpose = 'run'
)
SELECT a.batch AS batch,
       arg_min({'packages': i.packages}, (i.lamport IS NOT NULL, i.lamport, len(i.packages))).packages AS packages
FROM asked a LEFT JOIN imported_sessions i ON i.session = a.session GROUP BY a.batch HAVING count(i.session) > 0
