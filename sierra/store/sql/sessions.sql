-- The sessions that do not stand beside others: of each batch, those of the origin that counts in it.
SELECT s.* FROM all_sessions s LEFT JOIN imported_sessions i ON i.session = s.session LEFT JOIN origins o ON o.batch = s.batch
WHERE i.packages IS NOT DISTINCT FROM o.packages
