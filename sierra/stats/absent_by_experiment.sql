-- absent, per experiment: the number of values that are missing (NULL or NaN), of infinite ones, and (never) of runs that ended
-- before they reached the threshold.
SELECT
  experiment,
  sum(missing)::BIGINT AS missing,
  sum(infinite)::BIGINT AS infinite,
  count(*) FILTER (never) AS never
FROM observations
GROUP BY experiment
