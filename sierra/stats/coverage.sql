-- coverage, per experiment: the number of runs, the largest number of rows of a run, the first and the last time, the time
-- at which the first run ends (earliest), the number of rows without a finite time (no statistic uses them), and whether the
-- times of each run ascend. To know that, nothing is sorted: the rows are cut, as they are read, into pieces that have rows of one run; in each piece, times must ascend, and the pieces of a run must
-- not overlap. If so, no run has two rows at the same time, and no time goes back; if not, `doubled.sql` and `backward.sql`
-- have to count.
SELECT
  experiment,
  count(*) AS runs,
  sum(rows)::BIGINT AS rows,
  max(rows) AS most,
  min(first) AS first,
  max(last) AS last,
  min(last) AS earliest,
  sum(untimed)::BIGINT AS untimed,
  bool_and(ascending) AS ascending
FROM (
  SELECT
    experiment,
    run,
    sum(rows)::BIGINT AS rows,
    sum(untimed)::BIGINT AS untimed,
    min(first) AS first,
    max(last) AS last,
    bool_and(ascending AND coalesce(first > before, true)) AS ascending
  FROM (
    SELECT *, lag(last) OVER (PARTITION BY experiment, run ORDER BY first) AS before
    FROM (
      SELECT
        experiment,
        run,
        count(*) AS rows,
        count(*) FILTER (NOT coalesce(isfinite(t), false)) AS untimed,
        min(t) FILTER (isfinite(t)) AS first,
        max(t) FILTER (isfinite(t)) AS last,
        count(*) FILTER (begins) = 1 AND bool_and(begins OR coalesce(t > before, false)) AS ascending
      FROM (
        SELECT *, count(*) FILTER (begins) OVER (ROWS UNBOUNDED PRECEDING) AS piece
        FROM (
          SELECT
            experiment,
            run,
            t,
            lag(t) OVER () AS before,
            experiment IS DISTINCT FROM lag(experiment) OVER () OR run IS DISTINCT FROM lag(run) OVER () AS begins
          FROM samples
        )
      )
      GROUP BY experiment, run, piece
    )
  )
  GROUP BY experiment, run
)
GROUP BY experiment
ORDER BY experiment
