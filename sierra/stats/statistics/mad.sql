-- mad: the median of the distances |xᵢ − median|, without a factor; distances are halved so that they never overflow
list_sort(list_transform(x, lambda v: abs(v / 2 - median / 2))) AS _distances,
_distances[(n + 1) // 2] + _distances[(n + 2) // 2] AS mad
