-- counted, per group: the number of finite values, the smallest and the largest (+ 0.0 makes −0 a 0), Σ kᵢ and Σ kᵢ², where kᵢ = xᵢ / unit,
-- rounded to a whole number. Sums of whole numbers are exact, so neither the order of rows nor the number of threads changes them.
SELECT {keys}, count(*) AS _n, min(value) + 0.0 AS _first, max(value) + 0.0 AS _last, sum(k) AS _sum, sum(k::HUGEINT * k) AS _squares
FROM (SELECT {keys}, value, (value / (SELECT unit FROM scale))::BIGINT AS k FROM finite)
GROUP BY {keys}
