-- interquartile mean: the mean of the values without the ⌊n/4⌋ smallest and the ⌊n/4⌋ largest
-- (scipy.stats.trim_mean(x, 0.25), as in rliable: Agarwal et al. 2021); like the mean, it stays within these values
greatest(x[1 + n // 4], least(x[n - n // 4], CASE WHEN greatest(-x[1], x[n]) < 1e300 THEN list_avg(x[1 + n // 4:n - n // 4])
  ELSE list_sum(list_transform(x[1 + n // 4:n - n // 4], lambda v: v / (n - 2 * (n // 4)))) END)) AS iqm
