"""Sequential studies: a query that gets more runs until its intervals are narrow enough."""
