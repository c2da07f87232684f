-- final = v(t_max): the value at the run's largest time. A missing value is not replaced by an earlier one.
SELECT
  experiment,
  run,
  value,
  (value IS NULL OR isnan(value))::INTEGER AS missing,
  coalesce(isinf(value), false)::INTEGER AS infinite,
  false AS never
FROM (SELECT experiment, run, arg_max_null(value, t) AS value FROM samples WHERE isfinite(t) GROUP BY experiment, run)
