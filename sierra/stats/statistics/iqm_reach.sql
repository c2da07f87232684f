-- iqm_reach = max |wᵢ − iqm| / 2 of the winsorized values, the g = ⌊n/4⌋ smallest of which are raised to the next and the g
-- largest lowered; only a step towards the interval
x[1 + n // 4] AS _lowest,
x[n - n // 4] AS _highest,
greatest(x[n - n // 4] / 2 - iqm / 2, iqm / 2 - x[1 + n // 4] / 2) AS _iqm_reach
