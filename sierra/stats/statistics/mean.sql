-- mean = (x₁ + … + xₙ) / n = (least + q + r / n) · unit, where Σ kᵢ = q · n + r (see counted.sql and finer.sql), rounded to stay within the
-- values. The sum of whole numbers neither overflows nor rounds. A near quotient is divided first: 128 bits take ten times as long.
round(_sum::DOUBLE / n)::BIGINT AS _near,
(_sum - n::HUGEINT * _near)::BIGINT AS _off,
_near + _off // n AS _quotient,
_off % n AS _rest,
greatest(_first, least(_last, (_least + _quotient + _rest / n) * _unit)) AS mean
