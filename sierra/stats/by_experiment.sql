-- x, per experiment: the finite values that its runs were reduced to, sorted, so that no statistic depends on the order in
-- which threads deliver rows; how many of them are neither 0 nor 1; how many values were not numbers, or infinite, or (never) are not known because the run
-- ended before its time came.
SELECT
  experiment,
  coalesce(list_sort(list(value) FILTER (isfinite(value))), []) AS x,
  count(*) FILTER (isfinite(value) AND value NOT IN (0, 1)) AS _others,
  sum(missing)::BIGINT AS missing,
  sum(infinite)::BIGINT AS infinite,
  count(*) FILTER (never) AS never
FROM observations
GROUP BY experiment
