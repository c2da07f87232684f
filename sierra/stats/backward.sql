-- backward: the number of runs in whose rows the time goes back within one file, or whose files overlap in time
SELECT count(DISTINCT (experiment, run)) AS backward
FROM (
  SELECT experiment, run
  FROM (
    SELECT experiment, run, t < lag(t) OVER (PARTITION BY experiment, run, file ORDER BY place) AS back
    FROM samples
    WHERE isfinite(t) AND place IS NOT NULL
  )
  WHERE back
  UNION ALL
  SELECT experiment, run
  FROM (
    SELECT experiment, run, first < lag(last) OVER (PARTITION BY experiment, run ORDER BY first, last) AS back
    FROM (
      SELECT experiment, run, file, min(t) AS first, max(t) AS last
      FROM samples
      WHERE isfinite(t) AND place IS NOT NULL
      GROUP BY experiment, run, file
    )
  )
  WHERE back
)
