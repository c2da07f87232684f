-- reach = max |xᵢ − mean| / 2, half of it so that it never overflows; only a step towards sd
greatest(x[n] / 2 - mean / 2, mean / 2 - x[1] / 2) AS _reach
