-- grouped, per group: the counts of all rows, also if no value is finite, and the sums in the unit of the column or of the group
SELECT
  * EXCLUDE (own, least, sum, squares, unit)
    REPLACE (coalesce(missing, 0) AS missing, coalesce(infinite, 0) AS infinite, coalesce(_n, 0) AS _n,
      coalesce(sum, _sum) AS _sum, coalesce(squares, _squares) AS _squares),
  coalesce(own, unit) AS _unit,
  coalesce(least, 0) AS _least
FROM absent
FULL JOIN counted USING ({keys})
LEFT JOIN finer USING ({keys})
CROSS JOIN scale
