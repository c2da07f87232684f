-- ranges, per experiment: the number of finite values of its runs, one per run, the smallest and the largest (+ 0.0 makes −0 a 0).
-- Also counted: values that are neither 0 nor 1, values that are not numbers or infinite, and (never) runs that ended before they
-- reached the threshold.
SELECT
  experiment,
  min(value) FILTER (isfinite(value)) + 0.0 AS _first,
  max(value) FILTER (isfinite(value)) + 0.0 AS _last,
  count(*) FILTER (isfinite(value) AND value NOT IN (0, 1)) AS _others,
  sum(missing)::BIGINT AS missing,
  sum(infinite)::BIGINT AS infinite,
  count(*) FILTER (never) AS never,
  count(*) FILTER (isfinite(value)) AS _n
FROM observations
GROUP BY experiment
