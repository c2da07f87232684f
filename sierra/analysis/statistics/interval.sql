-- low, high = mean ∓ t · sd / √n, the 95 % interval of the mean, where t is the 0.975 quantile of Student's t with
-- n − 1 degrees of freedom, $t[n − 1] (Student 1908); NULL for n = 1
mean - $t[n - 1] * sd / sqrt(n) AS low,
mean + $t[n - 1] * sd / sqrt(n) AS high
