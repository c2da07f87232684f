-- mean = (x₁ + … + xₙ) / n
list_avg(x) AS mean
