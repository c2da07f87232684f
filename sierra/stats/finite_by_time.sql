-- finite: the values of runs that are finite numbers, at finite times. NaN is greater than all numbers in SQL.
SELECT experiment, t, value
FROM observations
WHERE value BETWEEN -1.7976931348623157e308 AND 1.7976931348623157e308
  AND t BETWEEN -1.7976931348623157e308 AND 1.7976931348623157e308
