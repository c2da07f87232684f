-- time to threshold = min { t : v(t) ≥ $threshold }; a run with values of which none reaches it is censored: its time is
-- unknown, later than its end. It is counted as `never`, and has no value that could be averaged.
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
