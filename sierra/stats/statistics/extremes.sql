-- extremes: x₁ and xₙ, the smallest and the largest value; an intermediate step, so that later steps do not need all values
x[1] AS _first,
x[n] AS _last
