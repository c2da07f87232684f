-- coverage, per experiment: the number of runs, the largest number of rows of a run, the first and the last time, the number
-- of rows without a finite time (no statistic uses them), and the number of runs with two rows at the same time.
SELECT
  experiment,
  count(*) AS runs,
  sum(rows)::BIGINT AS rows,
  max(rows) AS most,
  min(first) AS first,
  max(last) AS last,
  sum(untimed)::BIGINT AS untimed,
  count(*) FILTER (times + untimed < rows) AS doubled
FROM (
  SELECT
    experiment,
    run,
    count(*) AS rows,
    count(*) FILTER (NOT coalesce(isfinite(t), false)) AS untimed,
    count(DISTINCT t) FILTER (isfinite(t)) AS times,
    min(t) FILTER (isfinite(t)) AS first,
    max(t) FILTER (isfinite(t)) AS last
  FROM samples
  GROUP BY experiment, run
)
GROUP BY experiment
ORDER BY experiment
