-- kurtosis = n · Σ (xᵢ − m)⁴ / (Σ (xᵢ − mean)²)², where m is the mean without the ⌊n / (2 √(n − 4))⌋ smallest and largest values; an
-- intermediate step for the interval of sd. As in sd, deviations are scaled so that the largest is 1.
CASE WHEN n > 4 AND _max_deviation > 0 THEN list_avg(list_transform(
  x[1 + floor(n / (2 * sqrt(n - 4)))::INTEGER:n - floor(n / (2 * sqrt(n - 4)))::INTEGER], lambda v: (v / 2 - mean / 2) / _max_deviation)) END AS _trimmed,
CASE WHEN n > 4 AND _max_deviation > 0 THEN n * list_sum(list_transform(x, lambda v: ((v / 2 - mean / 2) / _max_deviation - _trimmed) ** 4))
  / list_sum(list_transform(x, lambda v: ((v / 2 - mean / 2) / _max_deviation) ** 2)) ** 2 END AS _kurtosis
