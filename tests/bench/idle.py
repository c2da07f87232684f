"""The project for measurements: its simulator does nothing."""

from __future__ import annotations

from pathlib import Path

TOML = """
template = "template.xml"
command = "/bin/true {input}"
seed = "/experiment/@seed"
[variables]
population_size = "//swarm/@count"
"""
TEMPLATE = '<experiment seed="1"><swarm count="3"/></experiment>\n'


def project(folder: Path, more: str = "", *, command: str = "/bin/true {input}") -> Path:
    """Make the project in a folder, unless it exists; `more` is added to its sierra.toml."""
    folder.mkdir(exist_ok=True)
    (folder / "sierra.toml").write_text(TOML.replace("/bin/true {input}", command) + more)
    (folder / "template.xml").write_text(TEMPLATE)
    return folder
