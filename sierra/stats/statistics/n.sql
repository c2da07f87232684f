-- n: the number of finite values
len(x) AS n
