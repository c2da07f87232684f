"""Settings of Sphinx, which builds the documentation as a site: `make docs`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

project = "SIERRA"
html_title = "SIERRA"
html_theme = "furo"
extensions = ["myst_parser"]
myst_heading_anchors = 3
exclude_patterns = ["conf.py", "generate.py"]
suppress_warnings = ["misc.highlighting_failure"]  # an example of a session is not valid in any language

CONTENTS = {
    "Begin": ["tutorial", "gallery", "glossary", "limitations"],
    "How-to guides": [
        "how-to/from-scripts",
        "how-to/your-simulator",
        "how-to/templates",
        "how-to/simulators",
        "how-to/compile",
        "how-to/around-a-run",
        "how-to/queries",
        "how-to/targets",
        "how-to/runs-on-robots",
        "how-to/robots",
        "how-to/outputs",
        "how-to/sql",
        "how-to/derived-tables",
        "how-to/figures",
        "how-to/report",
        "how-to/models",
        "how-to/compare",
        "how-to/paper",
        "how-to/claims",
        "how-to/published-study",
        "how-to/number-of-runs",
        "how-to/replay",
        "how-to/containers",
        "how-to/clusters",
        "how-to/lab",
        "how-to/gpus",
        "how-to/hosts",
        "how-to/share",
        "how-to/packages",
        "how-to/maintain",
        "how-to/python",
        "how-to/plugins",
    ],
    "Extensions": [f"extensions/{page.stem}" for page in sorted(Path(__file__).with_name("extensions").glob("*.md"))],
    "Reference": ["reference/commands", "reference/sierra-toml", "reference/tables"],
    "Explanation": [
        "explanation/architecture",
        "explanation/identity",
        "explanation/store-format",
        "explanation/execution",
        "explanation/standstill",
        "explanation/observation",
        "explanation/cluster-protocol",
        "explanation/threat-model",
        "explanation/self-checks",
        "explanation/other-tools",
    ],
}


def add_contents(app: Any, document: str, source: list[str]) -> None:
    """Append the table of contents to the first page. In the file itself, other viewers of Markdown would show it as code."""
    if document == "index":
        for title, pages in CONTENTS.items():
            source[0] += "\n```{toctree}\n:hidden:\n:caption: " + title + "\n" + "\n".join(pages) + "\n```\n"


def setup(app: Any) -> None:
    """Connect to Sphinx."""
    app.connect("source-read", add_contents)
