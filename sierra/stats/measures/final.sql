-- final = v(t_max): the value at the run's largest time. If it is missing there, it is missing: no earlier one replaces it.
SELECT
  experiment,
  run,
  value,
  (value IS NULL OR isnan(value))::INTEGER AS missing,
  coalesce(isinf(value), false)::INTEGER AS infinite,
  false AS never
FROM (SELECT experiment, run, arg_max_null(value, t) AS value FROM samples WHERE isfinite(t) GROUP BY experiment, run)
