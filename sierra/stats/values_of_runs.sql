-- one row per run with any value: its value by the measure, whether it never reached the threshold, and the time of its last
-- value, after which a time that is not known must lie.
SELECT experiment, run, value, never, last
FROM observations
JOIN (
  SELECT experiment, run, max(t) FILTER (isfinite(t) AND NOT isnan(value)) AS last
  FROM samples
  GROUP BY experiment, run
) USING (experiment, run)
ORDER BY experiment, run
