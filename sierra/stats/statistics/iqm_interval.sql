-- iqm_low, iqm_high = iqm ∓ half of the interval, that of the mean for n < 4; that of a rate ends at 0 and 1
greatest(iqm - _iqm_half, CASE WHEN _rate AND n > 1 THEN 0.0 END) AS iqm_low,
least(iqm + _iqm_half, CASE WHEN _rate AND n > 1 THEN 1.0 END) AS iqm_high
