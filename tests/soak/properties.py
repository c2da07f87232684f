"""The properties that a soak checks with random seeds. To add one, add a `Property` to the list."""

from __future__ import annotations

from tests import random_times, written_values
from tests.properties import Property

PROPERTIES: tuple[Property, ...] = (*written_values.PROPERTIES, *random_times.PROPERTIES)
EXAMPLES = 200
"""The number of examples of each property in one step."""
