WITH starts AS (SELECT run, robot, x, y FROM walk WHERE time = 0)
SELECT walk.run, walk.time, avg(sqrt((walk.x - starts.x) ** 2 + (walk.y - starts.y) ** 2)) AS metres
FROM walk JOIN starts USING (run, robot)
GROUP BY ALL
