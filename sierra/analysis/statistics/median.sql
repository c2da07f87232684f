-- median = (x₍⌊(n+1)/2⌋₎ + x₍⌊(n+2)/2⌋₎) / 2 of the sorted values
x[(n + 1) // 2] / 2 + x[(n + 2) // 2] / 2 AS median
