"""Reports: one page of HTML that tells the whole story of batches, and needs nothing but itself.

`sierra.deliverables.report.make` reads the store and returns the page; there is a module for each of its sections. The same
store gives the same bytes: a report has no time of its own.
"""
