-- sum = Σ kᵢ and squares = Σ kᵢ² of each group, where kᵢ = (xᵢ − x₁) / unit, rounded to a whole number. Sums of whole numbers are
-- exact, so neither the order of rows nor the number of threads changes them. Squares have up to 105 bits, and the sum 127:
-- enough for 4 million values; if a sum does not fit, DuckDB reports an error.
SELECT {keys}, sum(k) AS _sum, sum(k::HUGEINT * k) AS _squares
FROM (
  SELECT {keys}, round(value / _unit - _first / _unit)::BIGINT AS k
  FROM observations JOIN ranges USING ({keys})
  WHERE isfinite(value)
)
GROUP BY {keys}
