-- x, per experiment and time: the finite values of all runs, sorted, so that no statistic depends on the order in which
-- threads deliver rows. What is not a number or infinite is not in x; it is counted.
SELECT
  experiment,
  t,
  coalesce(list_sort(list(value) FILTER (isfinite(value))), []) AS x,
  count(*) - count(value) FILTER (NOT isnan(value)) AS missing,
  count(*) FILTER (isinf(value)) AS infinite
FROM observations
WHERE isfinite(t)
GROUP BY experiment, t
