-- sd = √(Σ (xᵢ − mean)² / (n − 1)), the sample standard deviation; NULL for n = 1. It is computed from the deviations
-- from the mean, scaled so that the largest is 1: it neither over- nor underflows, and a large mean costs no digits.
CASE WHEN _max_deviation > 0 THEN _max_deviation * list_stddev_samp(list_transform(x, lambda v: (v / 2 - mean / 2) / _max_deviation)) * 2
  WHEN n > 1 THEN 0.0 END AS sd
