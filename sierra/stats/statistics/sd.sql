-- sd = √(Σ (xᵢ − mean)² / (n − 1)), the sample standard deviation; NULL for n = 1. With kᵢ = (xᵢ − x₁) / unit of sums.sql,
-- s = Σ kᵢ, q = ⌊s / n⌋ and r = s − n · q, the sum is (Σ kᵢ² − q · (s + r) − r² / n) · unit². All but r² / n are whole numbers, and it
-- is small: nothing over- or underflows, and a large mean costs no digits.
CASE WHEN n > 1 THEN
  sqrt(((_squares - _sum // n * (_sum + _sum % n))::DOUBLE - (_sum % n)::DOUBLE ** 2 / n) / (n - 1)) * _unit END AS sd
