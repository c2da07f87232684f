-- time = min { t : v(t) ≥ $threshold }, or the time of the last known value if the run never reached the threshold (`reached` is
-- false): then its time is censored, which means that it is unknown, but later. Runs without any value are left out.
SELECT
  experiment,
  run,
  coalesce(min(t) FILTER (value >= $threshold AND NOT isnan(value)), max(t) FILTER (NOT isnan(value))) AS time,
  count(*) FILTER (value >= $threshold AND NOT isnan(value)) > 0 AS reached
FROM samples
WHERE isfinite(t)
GROUP BY experiment, run
HAVING count(value) FILTER (NOT isnan(value)) > 0
ORDER BY experiment, time, reached DESC, run
