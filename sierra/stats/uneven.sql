-- uneven: the number of runs whose largest step of time is more than 1 % greater than the smallest one
SELECT count(*) AS uneven
FROM (
  SELECT experiment, run
  FROM (SELECT experiment, run, t - lag(t) OVER (PARTITION BY experiment, run ORDER BY t) AS step FROM samples WHERE isfinite(t))
  GROUP BY experiment, run
  HAVING max(step) > 1.01 * min(step)
)
