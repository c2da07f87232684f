-- value(g) of each run at each time g of $grid, from its samples (t₁, v₁), (t₂, v₂), … where tᵢ ≤ g < tᵢ₊₁:
--   vᵢ, the last observation carried forward, or, with $linear, vᵢ + (vᵢ₊₁ − vᵢ) · (g − tᵢ) / (tᵢ₊₁ − tᵢ).
-- A run has no value before its first time or after its last; a missing value stays missing until the run's next value.
SELECT
  points.experiment,
  points.run,
  points.number,
  points.t,
  CASE WHEN $linear AND points.t > pieces.t
    THEN pieces.value + (pieces.next_value - pieces.value) * ((points.t - pieces.t) / (pieces.next_t - pieces.t))
    ELSE pieces.value
  END AS value
FROM (
  SELECT experiment, run, number, last, unnest($grid::DOUBLE[]) AS t
  FROM (SELECT experiment, run, number, max(shared_t) AS last FROM samples WHERE isfinite(t) GROUP BY experiment, run, number)
) AS points
ASOF JOIN (
  SELECT experiment, run, shared_t AS t, value, lead(shared_t) OVER following AS next_t, lead(value) OVER following AS next_value
  FROM samples
  WHERE isfinite(t)
  WINDOW following AS (PARTITION BY experiment, run ORDER BY shared_t)
) AS pieces ON points.experiment = pieces.experiment AND points.run = pieces.run AND points.t >= pieces.t
WHERE points.t <= points.last
