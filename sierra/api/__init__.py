"""The Python interface of SIERRA: the actions of the command line, as functions that return values.

The examples in docstrings are executed by a test, in a project with the variables `population_size` and `noise` whose runs
write a table `swarm` with the columns `tick` and `coverage`.
"""

from sierra.api.noun import observer_for as observer_for
from sierra.api.noun import slots as slots
from sierra.api.packages import IN_PACKAGE as IN_PACKAGE
from sierra.api.packages import PACKAGED as PACKAGED
from sierra.api.packages import report_package as report_package
from sierra.api.packages import reproduce as reproduce
from sierra.api.project import Project as Project
