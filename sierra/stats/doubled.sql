-- doubled: the number of runs with two rows at the same time
SELECT count(*) AS doubled
FROM (SELECT count(DISTINCT t) AS times, count(t) AS timed FROM samples WHERE isfinite(t) GROUP BY experiment, run)
WHERE times < timed
