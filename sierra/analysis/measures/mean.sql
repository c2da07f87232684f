-- mean over time = (v₁ + … + v_k) / k over the run's k finite values: each row has the same weight.
-- Summed in sorted order, so that it does not depend on the order in which threads deliver rows.
SELECT
  experiment,
  run,
  list_avg(list_sort(list(value) FILTER (isfinite(value)))) AS value,
  count(*) - count(value) FILTER (NOT isnan(value)) AS missing,
  count(*) FILTER (isinf(value)) AS infinite,
  false AS never
FROM samples
WHERE isfinite(t)
GROUP BY experiment, run
