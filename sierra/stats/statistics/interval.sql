-- low, high = mean ∓ t · sd / √n, the 95 % interval of the mean; t is the 0.975 quantile of Student's t with
-- n − 1 degrees of freedom, $t[n − 1] (Student 1908). For a rate: (mean + z² / 2n ∓ z · √(mean · (1 − mean) / n + z² / 4n²))
-- / (1 + z² / n), which is always within 0 … 1; z is the 0.975 quantile of the normal distribution (Wilson 1927). The
-- column `interval` names the method; NULL for n = 1.
CASE WHEN n < 2 THEN NULL WHEN _is_rate AND mean = 0 THEN 0.0
  WHEN _is_rate THEN (mean + $z ** 2 / (2 * n) - $z * sqrt(mean * (1 - mean) / n + ($z / (2 * n)) ** 2)) / (1 + $z ** 2 / n)
  ELSE mean - $t[n - 1] * sd / sqrt(n) END AS low,
CASE WHEN n < 2 THEN NULL WHEN _is_rate AND mean = 1 THEN 1.0
  WHEN _is_rate THEN (mean + $z ** 2 / (2 * n) + $z * sqrt(mean * (1 - mean) / n + ($z / (2 * n)) ** 2)) / (1 + $z ** 2 / n)
  ELSE mean + $t[n - 1] * sd / sqrt(n) END AS high,
CASE WHEN n < 2 THEN NULL WHEN _is_rate THEN 'Wilson' ELSE 't' END AS interval
