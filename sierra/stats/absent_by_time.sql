-- absent, per experiment and time: the number of values that are missing (NULL or NaN), and of infinite ones; no row if there are none.
SELECT
  experiment,
  t,
  count(*) FILTER (value IS NULL OR isnan(value)) AS missing,
  count(*) FILTER (isinf(value)) AS infinite
FROM observations
WHERE t BETWEEN -1.7976931348623157e308 AND 1.7976931348623157e308
  AND (value IS NULL OR abs(value) > 1.7976931348623157e308)
GROUP BY experiment, t
