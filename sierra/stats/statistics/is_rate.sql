-- is_rate: true if all values of all experiments and times are 0 or 1; an intermediate step. A column that may contain
-- fractions ($whole is false) must have both values. Times to a threshold are not rates ($rates is false).
coalesce($rates AND sum(_others) OVER () = 0 AND ($whole OR max(_last) OVER () > min(_first) OVER ()), false) AS _is_rate
