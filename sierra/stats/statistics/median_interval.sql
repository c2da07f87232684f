-- median_low, median_high = x₍l₎, x₍n+1−l₎, the interval of the median by order statistics with a confidence of at least 95 %;
-- l is $median_rank[n] (see sierra/stats/order_statistics.py); NULL for n < 6
x[CAST($median_rank AS INTEGER[])[n]] AS median_low,
x[n + 1 - CAST($median_rank AS INTEGER[])[n]] AS median_high
