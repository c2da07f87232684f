-- iqm_half = t · √(W / (h · (h − 1))), half the 95 % interval of the interquartile mean; g = ⌊n/4⌋, h = n − 2g, W = the
-- sum of squared deviations of the winsorized values, and t has h − 1 degrees of freedom (Tukey and McLaughlin 1963); an
-- intermediate step. As in sd, deviations are scaled so that the largest is 1.
sqrt((n - 1) / nullif((n - 2 * (n // 4)) * (n - 2 * (n // 4) - 1), 0)) * $t[n - 2 * (n // 4) - 1] * CASE
  WHEN _iqm_max_deviation > 0 THEN _iqm_max_deviation
    * list_stddev_samp(list_transform(x, lambda v: (least(greatest(v, _lowest), _highest) / 2 - iqm / 2) / _iqm_max_deviation)) * 2
  WHEN n > 1 THEN 0.0 END AS _iqm_half
