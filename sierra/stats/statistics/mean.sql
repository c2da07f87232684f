-- mean = (x₁ + … + xₙ) / n, rounded to stay within the values. If the sum of huge values overflows: x₁ / n + … + xₙ / n
greatest(x[1], least(x[n], CASE WHEN greatest(-x[1], x[n]) < 1e300 THEN list_avg(x)
  ELSE list_sum(list_transform(x, lambda v: v / n)) END)) AS mean
