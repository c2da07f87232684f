-- coverage, per experiment: the number of runs, the largest number of rows of a run, the first and the last time, the number
-- of rows without a finite time (no statistic uses them), and whether the rows of each run follow each other, in ascending order
-- of their times, as they were read. If they do, no run has two rows at the same time, and `doubled.sql` is not needed.
SELECT
  experiment,
  count(*) AS runs,
  sum(rows)::BIGINT AS rows,
  max(rows) AS most,
  min(first) AS first,
  max(last) AS last,
  sum(untimed)::BIGINT AS untimed,
  bool_and(parts = 1 AND ascending) AS ascending
FROM (
  SELECT
    experiment,
    run,
    count(*) AS rows,
    count(*) FILTER (NOT coalesce(isfinite(t), false)) AS untimed,
    min(t) FILTER (isfinite(t)) AS first,
    max(t) FILTER (isfinite(t)) AS last,
    count(*) FILTER (begins) AS parts,
    bool_and(begins OR coalesce(t > before, false)) AS ascending
  FROM (
    SELECT
      experiment,
      run,
      t,
      lag(t) OVER () AS before,
      experiment IS DISTINCT FROM lag(experiment) OVER () OR run IS DISTINCT FROM lag(run) OVER () AS begins
    FROM samples
  )
  GROUP BY experiment, run
)
GROUP BY experiment
ORDER BY experiment
