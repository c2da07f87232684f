-- q1, q3: linear interpolation in the sorted values at position 1 + (n − 1) · p for p = ¼, ¾
-- (type 7 of Hyndman and Fan 1996, numpy's default)
x[1 + (n - 1) // 4] + CASE WHEN isfinite(x[n] - x[1]) THEN (n - 1) % 4 / 4.0 * (x[least(n, 2 + (n - 1) // 4)] - x[1 + (n - 1) // 4])
  ELSE (n - 1) % 4 / 4.0 * x[least(n, 2 + (n - 1) // 4)] - (n - 1) % 4 / 4.0 * x[1 + (n - 1) // 4] END AS q1,
x[1 + 3 * (n - 1) // 4] + CASE WHEN isfinite(x[n] - x[1])
  THEN 3 * (n - 1) % 4 / 4.0 * (x[least(n, 2 + 3 * (n - 1) // 4)] - x[1 + 3 * (n - 1) // 4])
  ELSE 3 * (n - 1) % 4 / 4.0 * x[least(n, 2 + 3 * (n - 1) // 4)] - 3 * (n - 1) % 4 / 4.0 * x[1 + 3 * (n - 1) // 4] END AS q3
