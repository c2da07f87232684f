-- ranges, per experiment and time: the number of finite values of all runs, the smallest and the largest (+ 0.0 makes −0 a 0), and
-- the number of values that are neither 0 nor 1. Values that are not numbers or infinite are only counted.
SELECT
  experiment,
  t,
  min(value) FILTER (isfinite(value)) + 0.0 AS _first,
  max(value) FILTER (isfinite(value)) + 0.0 AS _last,
  count(*) FILTER (isfinite(value) AND value NOT IN (0, 1)) AS _others,
  count(*) - count(value) FILTER (NOT isnan(value)) AS missing,
  count(*) FILTER (isinf(value)) AS infinite,
  count(*) FILTER (isfinite(value)) AS _n
FROM observations
WHERE isfinite(t)
GROUP BY experiment, t
