-- sd = √(Σ (xᵢ − mean)² / (n − 1)), the sample standard deviation; NULL for n = 1. It is that of the deviations from the
-- mean, of which the largest is made 1: so it neither over- nor underflows, and a large mean takes no digits from it.
CASE WHEN _reach > 0 THEN _reach * list_stddev_samp(list_transform(x, lambda v: (v / 2 - mean / 2) / _reach)) * 2
  WHEN n > 1 THEN 0.0 END AS sd
