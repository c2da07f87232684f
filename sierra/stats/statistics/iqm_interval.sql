-- iqm_low, iqm_high = iqm ∓ half of the interval (for n < 4, the interval of the mean); for a rate, limited to 0 … 1
greatest(iqm - _iqm_half, CASE WHEN _is_rate AND n > 1 THEN 0.0 END) AS iqm_low,
least(iqm + _iqm_half, CASE WHEN _is_rate AND n > 1 THEN 1.0 END) AS iqm_high
