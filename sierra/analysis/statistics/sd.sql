-- sd = √(Σ (xᵢ − mean)² / (n − 1)), the sample standard deviation; NULL for n = 1
list_stddev_samp(x) AS sd
