"""Properties of the values that SIERRA writes into templates: independent readers read them, and all others as before.

There is one property per format. Its documents have all of a notation: comments, escapes, anchors, encodings, line ends.
"""

from __future__ import annotations

from tests.properties import Property
from tests.written_values import lines, trees, xml

XML = Property("values in XML", xml.STRATEGIES, xml.claim)
JSON = Property("values in JSON", trees.STRATEGIES["json"], trees.claim)
YAML = Property("values in YAML", trees.STRATEGIES["yaml"], trees.claim)
TOML = Property("values in TOML", trees.STRATEGIES["toml"], trees.claim)
INI = Property("values in INI", lines.STRATEGIES["ini"], lines.claim)
JAVA = Property("values in properties", lines.STRATEGIES["properties"], lines.claim)
TEXT = Property("values in texts", lines.TEXT_STRATEGIES, lines.text_claim)
PROPERTIES = (XML, JSON, YAML, TOML, INI, JAVA, TEXT)
