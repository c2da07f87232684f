"""Check that this project has not become larger: `make check`. The limits are in ratchet.toml.

    ratchet.py            name what is over its limit; exit 1 if there is anything
    ratchet.py --lower    write numbers that are now lower to ratchet.toml

Numbers may only fall. A change that needs a higher one edits ratchet.toml and says why in its commit. Extensions are free: they
can be deleted.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
import tempfile
import tomllib
from collections import defaultdict
from collections.abc import Mapping
from pathlib import Path

import grimp
import networkx
from idle import project
from lines import PACKAGE, ROOT, Size, core, packages

LIMITS = Path(__file__).with_name("ratchet.toml")
SLACK = 3
"""The number of modules more that a command may import: a few depend on the machine."""
FEWEST = 0.15
"""The lines of docstrings for each line of code, at least."""
RUN = ("run", "--runs", "1", "--no-figures")
COMMANDS = {
    **{name: (name,) for name in ("--version", "--help", "status", "ls")},
    "sql": ("sql", "SELECT count(*) FROM runs"),
    "show": ("show", "{batch}"),
    "why": ("why", "{batch}"),
    "run -n": ("run", "-n", "population_size=3"),
    "run": (*RUN, "population_size=4,5"),
}
"""The commands whose imports are counted, in a project with one batch."""
PROBE = """
import atexit, sys
from pathlib import Path
def count():
    names = {name.partition(".")[0] for name in sys.modules} - sys.stdlib_module_names - {"__main__", "__mp_main__"}
    Path(file).write_text(str(sum(name.partition(".")[0] in names for name in sys.modules)))
file = sys.argv.pop(1)
atexit.register(count)
from sierra.cli.main import program
program()
"""


def main() -> int:
    limits = tomllib.loads(LIMITS.read_text())
    size = core(packages())
    now = measured(size)
    if "--lower" in sys.argv:
        LIMITS.write_text(lowered(LIMITS.read_text(), limits, now))
        return 0
    over = [
        f"{name}: {value:,}, and the limit is {limits[table].get(name, 0):,}"
        for table, values in now.items()
        for name, value in values.items()
        if value > limits[table].get(name, 0) + (SLACK if table == "imported modules" else 0)
    ]
    if size.docstrings < FEWEST * size.code:
        over.append(f"docstrings: {size.docstrings:,} lines for {size.code:,} lines of code, fewer than {FEWEST} each")
    for line in over:
        print(f"ratchet: {line}: make it smaller, or say why not in {LIMITS.relative_to(ROOT)}", file=sys.stderr)
    print(f"Ratchet: {size.code:,} lines of code in the core, of {limits['size']['core code']:,}.")
    return 1 if over else 0


def measured(core: Size) -> dict[str, dict[str, int]]:
    """Return the present numbers, by table and name as in ratchet.toml."""
    from sierra.config import extensions

    extensions.added = lambda kind: {}  # their commands and keys are free, too
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
    floors = next(len(contract["layers"]) for contract in contracts if contract["type"] == "layers")
    return {
        "size": {"core code": core.code, "core modules": core.modules},
        "structure": {"entries": entries(), "floors": floors, "circles": circles()},
        "breadth": {"commands": commands(), "keys": keys(), "rows of keys": rows()},
        "imported modules": imported(),
    }


def entries() -> int:
    """Return the number of modules and packages at the top."""
    paths = (ROOT / PACKAGE).iterdir()
    return sum(path.suffix == ".py" or (path.is_dir() and any(path.rglob("*.py"))) for path in paths)


def circles() -> int:
    """Return the number of groups of siblings, modules or packages, that import each other in a circle."""
    graph = grimp.build_graph(PACKAGE, exclude_type_checking_imports=True)
    siblings: Mapping[str, networkx.DiGraph] = defaultdict(networkx.DiGraph)
    for module in graph.modules:
        for other in graph.find_modules_directly_imported_by(module):
            ours, theirs = module.split("."), other.split(".")
            same = next((place for place, (a, b) in enumerate(zip(ours, theirs, strict=False)) if a != b), None)
            if same is not None:
                siblings[".".join(ours[:same])].add_edge(ours[same], theirs[same])
    return sum(len(group) > 1 for each in siblings.values() for group in networkx.strongly_connected_components(each))


def keys() -> int:
    """Return the number of keys of sierra.toml in all of its tables."""
    from sierra.setup import published_schemas

    schema = published_schemas.json_schema()
    return sum(len(table.get("properties", ())) for table in (schema, *schema["$defs"].values()))


def rows() -> int:
    """Return the number of keys that the reference describes, those of extensions included; repeated ones count once."""
    return sum(line.startswith("| `") for line in (ROOT / "docs/reference/sierra-toml.md").read_text().splitlines())


def commands() -> int:
    """Return the number of commands, also those of groups."""
    from typer.main import get_command

    from sierra.cli.app import app

    def ends(command: object) -> int:
        return sum(map(ends, command.commands.values())) if hasattr(command, "commands") else 1

    return ends(get_command(app))


def imported() -> dict[str, int]:
    """Return the number of modules that commands import, without those of Python itself."""
    with tempfile.TemporaryDirectory(prefix="sierra-ratchet-") as folder:
        root = project(Path(folder, "project"))
        probe, file = Path(folder, "probe.py"), Path(folder, "count")
        probe.write_text(PROBE)

        def called(*words: str) -> tuple[int, str]:
            done = subprocess.run([sys.executable, probe, file, *words], cwd=root, capture_output=True, text=True, check=True)
            return int(file.read_text()), done.stdout

        called(*RUN, "population_size=1,2")
        [batch] = json.loads(called("ls", "--json")[1])
        return {name: called(*(word.format(**batch) for word in words))[0] for name, words in COMMANDS.items()}


def lowered(text: str, limits: Mapping[str, Mapping[str, int]], now: Mapping[str, Mapping[str, int]]) -> str:
    """Return the text of ratchet.toml with the numbers that are lower now."""
    for table, values in now.items():
        for name, value in values.items():
            if value < limits[table].get(name, value):
                text = re.sub(rf'(?m)^("{re.escape(name)}" = )\d+', rf"\g<1>{value}", text)
    return text


if __name__ == "__main__":
    sys.exit(main())
