-- mean = (x₁ + … + xₙ) / n = (x₁ / unit + Σ kᵢ / n) · unit (see sums.sql), rounded to stay within the values; the sum of whole
-- numbers neither overflows nor rounds
greatest(_first, least(_last, (_first / _unit + _sum // _n + _sum % _n / _n) * _unit)) AS mean
