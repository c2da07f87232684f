"""Which files of an execution become tables: the declared ones, then what ends like a table."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import PurePosixPath

from sierra.config.project_file import Output
from sierra.ingest.messages import shown
from sierra.ingest.model import Shape
from sierra.model import OutputFile, Result
from sierra.store.schema import check_name
from sierra.util.text import natural

AUTOMATIC = {".csv": "csv", ".tsv": "csv", ".parquet": "parquet", ".jsonl": "jsonl", ".ndjson": "jsonl"}
AUTOMATIC_AT_MOST = 20
"""Undeclared tables of one run; beyond, its undeclared files are kept as files."""
NOTED_AT_MOST = 1000
IN_FOLDERS = 'undeclared, in a subfolder ([outputs.NAME] file = "{glob}" makes a table of them)'
TOO_MANY = f'undeclared, and of more than {AUTOMATIC_AT_MOST} in a run ([outputs.NAME] file = "{{glob}}" makes a table of them)'
TAKEN = 'undeclared, and another has the table of that name already ([outputs.NAME] file = "{file}" makes it a table)'
NOT_UTF8 = "with a name that is no UTF-8"
"""Why files that look like tables are kept as files."""


class OutputMatcher:
    """Assigns files to tables, and remembers those that look like tables and become none."""

    def __init__(self, outputs: Mapping[str, Output]) -> None:
        self._outputs = outputs
        self.kept: dict[str, dict[str, None]] = {}
        """Why such files are kept as files, and which."""

    def of(self, result: Result) -> Iterator[tuple[str, Shape, OutputFile]]:
        """The files of one execution that become tables: the declared ones, then what ends like a table."""
        automatic = []
        for file in sorted(result.outputs, key=lambda file: natural(file.path)):
            declared = next((n for n, o in self._outputs.items() if o.matches(file.path)), None)
            kind = self._outputs[declared].kind if declared else _automatic(file.path)
            if kind in (None, "file"):
                continue
            if shown(file.path) != file.path:
                self._keep(NOT_UTF8, file)
            elif declared is not None:
                yield declared, _shape(self._outputs[declared]), file
            elif "/" in file.path:
                self._keep(IN_FOLDERS, file)
            else:
                automatic.append(file)
        if len(automatic) > AUTOMATIC_AT_MOST:
            for file in automatic:
                self._keep(TOO_MANY, file)
            return
        taken = {name.lower() for name in self._outputs}
        for file in automatic:
            name = table_name(file.path)
            if name.lower() in taken:
                self._keep(TAKEN, file)
            else:
                taken.add(name.lower())
                yield name, Shape(_automatic(file.path)), file  # type: ignore[arg-type]

    def _keep(self, why: str, file: OutputFile) -> None:
        """Note that a file is kept as it is, though it looks like a table."""
        kept = self.kept.setdefault(why, {})
        if len(kept) < NOTED_AT_MOST:
            kept[shown(file.path)] = None


def table_name(path: str) -> str:
    """The table that an undeclared file becomes: by its name."""
    stem = "".join(c if c.isalnum() and c.isascii() else "_" for c in PurePosixPath(path).stem)
    name = ("_" if stem[:1].isdigit() else "") + stem or "_"
    return name if check_name(name) else name + "_"


def _automatic(path: str) -> str | None:
    """The format of what is a table by its ending."""
    return AUTOMATIC.get(PurePosixPath(path).suffix.lower())


def _shape(output: Output) -> Shape:
    many = any(c in output.file for c in "*?[")
    return Shape(output.kind, output.delimiter, output.header, output.columns, many)  # type: ignore[arg-type]
