-- unit: a power of two, so that all values are within ∓ 2^$bits units; to divide by it rounds nothing. The smallest is that of all
-- doubles, 2⁻¹⁰⁷⁴. $bits is as large as sums of the squares of all runs allow in 127 bits.
SELECT pow(2.0, greatest(-1074, floor(log2(greatest(max(abs(value)), 5e-324))) + 1 - $bits)) AS unit FROM finite
