-- x, per experiment: the finite values of its runs, one per run, sorted, so that no statistic depends on the order in which
-- threads deliver rows. Also counted: values that are neither 0 nor 1, values that are not numbers or infinite, and (never)
-- runs that ended before they reached the threshold.
SELECT
  experiment,
  coalesce(list_sort(list(value) FILTER (isfinite(value))), []) AS x,
  count(*) FILTER (isfinite(value) AND value NOT IN (0, 1)) AS _others,
  sum(missing)::BIGINT AS missing,
  sum(infinite)::BIGINT AS infinite,
  count(*) FILTER (never) AS never
FROM observations
GROUP BY experiment
