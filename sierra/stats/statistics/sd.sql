-- sd = √(Σ (xᵢ − mean)² / (n − 1)), the sample standard deviation; NULL for n = 1. It is computed from the deviations
-- from the mean, scaled so that the largest is 1: it neither over- nor underflows, and a large mean costs no digits.
CASE WHEN _reach > 0 THEN _reach * list_stddev_samp(list_transform(x, lambda v: (v / 2 - mean / 2) / _reach)) * 2
  WHEN n > 1 THEN 0.0 END AS sd
