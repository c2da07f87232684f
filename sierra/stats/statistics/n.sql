-- n: the number of finite values
_n AS n
