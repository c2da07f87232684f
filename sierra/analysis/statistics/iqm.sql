-- interquartile mean: the mean of what remains when the ⌊n/4⌋ smallest and the ⌊n/4⌋ largest values are left out
-- (scipy.stats.trim_mean(x, 0.25), as in rliable: Agarwal et al. 2021)
list_avg(x[1 + n // 4:n - n // 4]) AS iqm
