-- min, max: the smallest and the largest of the values
_first AS min,
_last AS max
