"""The data of a session that recording needs, and hashes of the project's ingest rules."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from sierra.config.plugin_registry import Tables
from sierra.config.project_file import Output, Success
from sierra.errors import Damaged
from sierra.ingest.base import Used
from sierra.store.order import stamp
from sierra.store.segments import disk_errors
from sierra.util.fs import read_record, write_whole
from sierra.util.hashing import digest

ID, SESSION = re.compile("[0-9a-f]{64}"), re.compile("[0-9a-f]{16}")
UNREAD = {"units", "time", "tolerance", "ordered", "volatile"}
"""The settings of an output that do not influence how it is recorded."""
SAVED = (
    *(
        "session",
        "batch",
        "purpose",
        "environment",
        "programs",
        "engine",
        "isolation",
        "shared",
        "enforced",
        "number",
        "raw",
        "engines",
    ),
)


@dataclass(frozen=True, slots=True)
class Context:
    """All data of a session that recording needs, so that another process can finish it."""

    session: str
    batch: str
    purpose: str
    environment: str
    programs: str
    outputs: Mapping[str, Output]
    success: Success
    engine: str = "none"
    isolation: Mapping[str, Any] | None = None
    """The isolation of the runs as a row of `isolations`; None if they were not isolated."""
    shared: bool = False
    enforced: tuple[str, ...] = ()
    """The limits that the engine enforces."""
    number: int | None = None
    """The session's Lamport number; None without a session."""

    def lamport(self, position: int = 0) -> int | None:
        """Return the `lamport` value of a record of this session; `position` is an execution's position in it."""
        return stamp(self.number, self.session, position)

    raw: bool = True
    """True if the bytes of files that become tables are stored too."""
    readers: Used = field(default_factory=dict)
    """The readers of other packages that the outputs need."""
    engines: Tables = field(default_factory=dict)
    """The options of engines in `sierra.toml`."""

    @property
    def ingest_rules(self) -> str:
        """The hash of the rules that decide if an execution is successful and what is recorded of it."""
        return self._declared({"mismatch", *UNREAD})

    @property
    def batch_rules(self) -> str:
        """The hash of these rules and of the differences that are allowed between siblings."""
        return self._declared(UNREAD)

    @property
    def declared(self) -> str:
        """The project's declarations of outputs and success, as JSON."""
        return json.dumps(self._tables())

    def _tables(self) -> dict[str, Any]:
        outputs = {name: output.model_dump(mode="json") for name, output in self.outputs.items()}
        return {"outputs": outputs, "success": self.success.model_dump(mode="json"), **self._others()}

    def _others(self) -> dict[str, Any]:
        """Return the readers of other packages, if there are any: the hashes of rules without them stay the same."""
        return {"readers": self.readers} if self.readers else {}

    def _declared(self, without: set[str]) -> str:
        outputs = {name: output.model_dump(mode="json", exclude=without) for name, output in self.outputs.items()}
        return digest("reading", {"outputs": outputs, "success": self.success.model_dump(mode="json"), **self._others()})

    def save(self, path: Path) -> None:
        fields = {name: getattr(self, name) for name in SAVED}
        fields |= self._tables()
        with disk_errors(path.parent):
            write_whole(path, json.dumps(fields, default=str).encode())

    @classmethod
    def load(cls, path: Path) -> Context:
        """Load a saved context. Raises FileNotFoundError, and Damaged if the file is not a valid context."""
        fields = read_record(path)
        try:
            fields["outputs"], fields["success"], fields["readers"] = rules_of(fields)
            made = cls(**fields)
            if ID.fullmatch(made.batch) and SESSION.fullmatch(made.session):
                return made
        except (ValueError, LookupError, TypeError, AttributeError):
            pass
        raise Damaged(
            f"{path}: was not written by this version of SIERRA; move {path.parent} away, or continue with the other version"
        )


def rules_of(declared: Mapping[str, Any]) -> tuple[dict[str, Output], Success, Used]:
    """Return the declarations of outputs and success, and the readers, from the form of `Context.declared`."""
    outputs = {name: Output.model_validate(output) for name, output in declared["outputs"].items()}
    return outputs, Success.model_validate(declared["success"]), dict(declared.get("readers", {}))
