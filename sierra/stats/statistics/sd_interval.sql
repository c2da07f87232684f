-- sd_low, sd_high = √(exp(ln(c · sd²) ∓ z · c · √((kurtosis − (n − 3) / n) / (n − 1)))), c = n / (n − z), the 95 % interval of the
-- standard deviation; z is the 0.975 quantile of the normal distribution (Bonett 2006). NULL for n < 5; for equal values 0.
CASE WHEN n > 4 AND sd = 0 THEN 0.0
  WHEN n > 4 THEN sd * sqrt(n / (n - $z)) * exp(-$z / 2 * n / (n - $z) * sqrt(greatest(0, _kurtosis - (n - 3) / n) / (n - 1))) END AS sd_low,
CASE WHEN n > 4 AND sd = 0 THEN 0.0
  WHEN n > 4 THEN sd * sqrt(n / (n - $z)) * exp($z / 2 * n / (n - $z) * sqrt(greatest(0, _kurtosis - (n - 3) / n) / (n - 1))) END AS sd_high
