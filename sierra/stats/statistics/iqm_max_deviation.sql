-- iqm_max_deviation = max |wᵢ − iqm| / 2 of the winsorized values: the g = ⌊n/4⌋ smallest values are raised to the next
-- value, and the g largest are lowered; an intermediate step
x[1 + n // 4] AS _lowest,
x[n - n // 4] AS _highest,
greatest(x[n - n // 4] / 2 - iqm / 2, iqm / 2 - x[1 + n // 4] / 2) AS _iqm_max_deviation
