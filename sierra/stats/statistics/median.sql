-- median = (x₍⌊(n+1)/2⌋₎ + x₍⌊(n+2)/2⌋₎) / 2 of the sorted values; values are halved before the sum if it may overflow
CASE WHEN greatest(-x[1], x[n]) < 1 THEN (x[(n + 1) // 2] + x[(n + 2) // 2]) / 2
  ELSE x[(n + 1) // 2] / 2 + x[(n + 2) // 2] / 2 END AS median
