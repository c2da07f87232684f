-- coverage, per experiment: how many runs there are, the most rows of one, the span of their times,
-- how many rows have no finite time (left out of everything), and how many runs have two rows at one time.
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
