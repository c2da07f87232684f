-- finer: Σ kᵢ and Σ kᵢ² of the groups whose values differ by less than 2⁴⁴ units, unless all are exact in units: they are, if none is
-- below 2⁵³. (In other groups, rounding to units changes a value by at most 2⁻⁴⁵ of the range.) Here, kᵢ = (xᵢ − x₁) / own, and the
-- own unit is that of the group, so that the largest k has at most 52 bits. So a group of small values keeps its digits beside
-- one of large values. Usually there is no such group, and then no row is read.
SELECT {keys}, any_value(own) AS own, any_value(_first) / any_value(own) AS least, sum(k) AS sum, sum(k::HUGEINT * k) AS squares
FROM (
  SELECT {keys}, own, _first, round(value / own - _first / own)::BIGINT AS k
  FROM finite
  JOIN (
    SELECT {keys}, _first, pow(2.0, greatest(-1074, floor(log2(greatest(_last / 2 - _first / 2, 5e-324))) + 2 - least($bits, 52))) AS own
    FROM counted CROSS JOIN scale
    WHERE _first < _last AND _last / 2 - _first / 2 < 2.0 ** 43 * unit AND greatest(_first, -_last) < 2.0 ** 53 * unit
  ) USING ({keys})
)
GROUP BY {keys}
