-- min, max: the smallest and the largest of the values
x[1] AS min,
x[n] AS max
