-- backward: the number of runs in whose rows the time goes back within one file
SELECT count(*) AS backward
FROM (
  SELECT experiment, run
  FROM (
    SELECT experiment, run, t < lag(t) OVER (PARTITION BY experiment, run, file ORDER BY place) AS back
    FROM samples
    WHERE isfinite(t) AND place IS NOT NULL
  )
  GROUP BY experiment, run
  HAVING bool_or(back)
)
