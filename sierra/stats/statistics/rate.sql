-- rate: whether all values of all experiments, and at all times, are 0 or 1; only a step towards the interval. A column that
-- may hold fractions ($whole is false) must have both of them, and times to a threshold are none ($rates is false).
coalesce($rates AND sum(_others) OVER () = 0 AND ($whole OR max(_last) OVER () > min(_first) OVER ()), false) AS _rate
