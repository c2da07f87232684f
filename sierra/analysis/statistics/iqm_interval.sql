-- iqm_low, iqm_high = iqm ∓ t · √(W / (h · (h − 1))), the 95 % interval of the interquartile mean, where g = ⌊n/4⌋,
-- h = n − 2g, W = the sum of squared deviations of the winsorized values (the g smallest raised to the next, the g largest
-- lowered), and t has h − 1 degrees of freedom (Tukey and McLaughlin 1963); the interval of the mean for n < 4
iqm - $t[n - 2 * (n // 4) - 1] * sqrt((n - 1) * list_var_samp(list_transform(x, lambda v: least(greatest(v, x[1 + n // 4]), x[n - n // 4])))
  / nullif((n - 2 * (n // 4)) * (n - 2 * (n // 4) - 1), 0)) AS iqm_low,
2 * iqm - iqm_low AS iqm_high
