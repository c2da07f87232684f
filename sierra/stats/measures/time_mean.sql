-- mean over time = (1/T) ∫ v dt over the run's finite values at t₁ < … < t_k, with T = t_k − t₁: by trapezoids,
-- Σ (vᵢ + vᵢ₊₁) / 2 · (tᵢ₊₁ − tᵢ) / T, or with $steps, where each value holds until the next, Σ vᵢ · (tᵢ₊₁ − tᵢ) / T. If there
-- is a single value, it is the mean. Missing values are left out: trapezoids and steps go on to the next value. The sum is in
-- the order of time, so that the order in which threads deliver rows has no effect.
SELECT
  experiment,
  run,
  CASE WHEN k < 2 THEN x[1]
    ELSE greatest(list_min(x), least(list_max(x), list_sum(list_transform(range(1, k), lambda i:
      CASE WHEN $steps THEN x[i] ELSE x[i] / 2 + x[i + 1] / 2 END * ((times[i + 1] - times[i]) / (times[k] - times[1]))
    )))) END AS value,
  missing,
  infinite,
  false AS never
FROM (
  SELECT
    experiment,
    run,
    list(value ORDER BY t) FILTER (isfinite(value)) AS x,
    list(t ORDER BY t) FILTER (isfinite(value)) AS times,
    count(*) FILTER (isfinite(value)) AS k,
    count(*) - count(value) FILTER (NOT isnan(value)) AS missing,
    count(*) FILTER (isinf(value)) AS infinite
  FROM samples
  WHERE isfinite(t)
  GROUP BY experiment, run
)
