-- ends: x₁ and xₙ, the smallest and the largest value; only a step, so that what follows need not carry all values
x[1] AS _first,
x[n] AS _last
