-- finite: the values of runs that are finite numbers, one per run. NaN is greater than all numbers in SQL.
SELECT experiment, value
FROM observations
WHERE value BETWEEN -1.7976931348623157e308 AND 1.7976931348623157e308
