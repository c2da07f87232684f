-- is_rate: true if the column is one of flags, or declared as a rate ($rate), and all values of all experiments and times
-- are 0 or 1; an intermediate step. A column of numbers that happen to be 0 or 1 may count something, so it is not a rate.
coalesce($rate AND sum(_others) OVER () = 0, false) AS _is_rate
