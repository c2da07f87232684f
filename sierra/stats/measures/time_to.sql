-- time to threshold = min { t : v(t) ≥ $threshold }; a run whose values never reach it is censored: its time is unknown,
-- but later than its end. The run is counted as `never`, and has no value in means.
SELECT
  experiment,
  run,
  min(t) FILTER (value >= $threshold AND NOT isnan(value)) AS value,
  count(*) - count(value) FILTER (NOT isnan(value)) AS missing,
  0 AS infinite,
  count(value) FILTER (NOT isnan(value)) > 0 AND count(*) FILTER (value >= $threshold AND NOT isnan(value)) = 0 AS never
FROM samples
WHERE isfinite(t)
GROUP BY experiment, run
