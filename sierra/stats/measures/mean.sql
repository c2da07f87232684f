-- mean of the rows = (v₁ + … + v_k) / k over the run's k finite values: each row has the same weight. If the sum of huge
-- values overflows: v₁ / k + … + v_k / k. The sum is in sorted order, so that the order in which threads deliver rows has no effect.
SELECT
  experiment,
  run,
  greatest(x[1], least(x[k], CASE WHEN greatest(-x[1], x[k]) < 1e300 THEN list_avg(x)
    ELSE list_sum(list_transform(x, lambda v: v / k)) END)) AS value,
  missing,
  infinite,
  false AS never
FROM (
  SELECT
    experiment,
    run,
    list_sort(list(value) FILTER (isfinite(value))) AS x,
    count(*) FILTER (isfinite(value)) AS k,
    count(*) - count(value) FILTER (NOT isnan(value)) AS missing,
    count(*) FILTER (isinf(value)) AS infinite
  FROM samples
  WHERE isfinite(t)
  GROUP BY experiment, run
)
