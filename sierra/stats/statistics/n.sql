-- n: how many finite values there are
len(x) AS n
