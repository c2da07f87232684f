-- x, per experiment and time: the finite values of all runs, sorted, so that no statistic depends on the order in which
-- threads deliver rows; and the number of values that are neither 0 nor 1. Values that are not numbers or infinite are only counted.
SELECT
  experiment,
  t,
  coalesce(list_sort(list(value) FILTER (isfinite(value))), []) AS x,
  count(*) FILTER (isfinite(value) AND value NOT IN (0, 1)) AS _others,
  count(*) - count(value) FILTER (NOT isnan(value)) AS missing,
  count(*) FILTER (isinf(value)) AS infinite
FROM observations
WHERE isfinite(t)
GROUP BY experiment, t
