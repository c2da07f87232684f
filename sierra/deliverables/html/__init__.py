"""Pages of HTML that need nothing but themselves: charts, tables, pictures, and the page around them.

A page is one file without any reference to another. Its Content-Security-Policy allows only the script and the style that are
in it, by their hashes, and pictures in `data:` addresses. The same content gives the same bytes.

    table = Table("swarm", ("time", "coverage"), ((0, 1), (0.1, 0.4)))
    chart = Chart(table, x=ChartAxis(0, "time [s]"), y=ChartAxis(1, "coverage"), series=(Series("all", "#0072B2", 0, 2),))
    data = page("Coverage", [section(SectionContent("Coverage", charts=(chart,), tables=(table,)))])
"""

from sierra.deliverables.html.charts import Chart, ChartAxis, Series
from sierra.deliverables.html.page import page
from sierra.deliverables.html.sections import SectionContent, section
from sierra.deliverables.html.tables import Table

__all__ = ["Chart", "ChartAxis", "SectionContent", "Series", "Table", "page", "section"]
