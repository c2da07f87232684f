-- max_deviation = max |xᵢ − mean| / 2, halved so that it never overflows; an intermediate step for sd
greatest(x[n] / 2 - mean / 2, mean / 2 - x[1] / 2) AS _max_deviation
