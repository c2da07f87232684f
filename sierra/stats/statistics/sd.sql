-- sd = √(Σ (xᵢ − mean)² / (n − 1)), the sample standard deviation; NULL for n = 1. With s = Σ kᵢ = q · n + r of the mean, the sum is
-- (Σ kᵢ² − q · (s + r) − r² / n) · unit². All but r² / n are whole numbers, and it is small: nothing over- or underflows, and a large
-- mean costs no digits.
CASE WHEN n > 1 THEN
  sqrt(((_squares - _quotient * (_sum + _rest))::DOUBLE - _rest::DOUBLE ** 2 / n) / (n - 1)) * _unit END AS sd
