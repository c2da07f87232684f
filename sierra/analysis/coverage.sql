-- coverage, per experiment: how many runs there are, the most and the fewest rows of one, the span of their times,
-- how many rows have no finite time (left out of everything), and how many runs have two rows at one time.
-- The last are looked for at a run's first and last time, where a table with several rows per time shows at once.
SELECT
  experiment,
  count(*) AS runs,
  sum(rows)::BIGINT AS rows,
  max(rows) AS most,
  min(rows) AS fewest,
  min(first[1]) AS first,
  max(last[1]) AS last,
  sum(untimed)::BIGINT AS untimed,
  count(*) FILTER (first[1] = first[2] OR last[1] = last[2]) AS doubled
FROM (
  SELECT
    experiment,
    run,
    count(*) AS rows,
    count(*) FILTER (NOT coalesce(isfinite(t), false)) AS untimed,
    min(t, 2) FILTER (isfinite(t)) AS first,
    max(t, 2) FILTER (isfinite(t)) AS last
  FROM samples
  GROUP BY experiment, run
)
GROUP BY experiment
ORDER BY experiment
