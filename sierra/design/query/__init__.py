"""Research queries: their grammar, and the ranges of values that they describe."""
