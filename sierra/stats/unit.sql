-- unit, of each group: a power of two, so that (x₁ … xₙ) − x₁ are 0 … 2⁵² units; scaling by it rounds nothing. The smallest is
-- that of all doubles, 2⁻¹⁰⁷⁴. Halves do not overflow. Each group has its own, so that one of tiny values keeps its digits.
SELECT *, CASE WHEN _first < _last
  THEN pow(2.0, greatest(-1074, floor(log2(greatest(_last / 2 - _first / 2, 5e-324))) - 50)) ELSE 1.0 END AS _unit
FROM counted
