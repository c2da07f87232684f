-- whiskers: the most extreme values within [q1 − 1.5 · (q3 − q1), q3 + 1.5 · (q3 − q1)] (Tukey 1977): always observed
-- values
list_min(list_filter(x, lambda v: v >= q1 - 1.5 * (q3 - q1))) AS whisker_low,
list_max(list_filter(x, lambda v: v <= q3 + 1.5 * (q3 - q1))) AS whisker_high
