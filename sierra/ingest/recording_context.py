"""The data of a session that recording needs, and hashes of the project's ingest rules."""

from __future__ import annotations

import json
from collections.abc import Mapping
from collections.abc import Set as AbstractSet
from pathlib import Path
from typing import NotRequired, TypedDict, cast

from sierra.config.output_tables import Output, Success
from sierra.config.plugin_registry import Tables
from sierra.errors import Damaged
from sierra.ingest.base import Used
from sierra.store.lamport_clock import stamp
from sierra.store.row_types import IsolationRow
from sierra.store.segments import disk_errors
from sierra.util.fs import read_record, write_whole
from sierra.util.hashing import digest
from sierra.util.json_types import Json, JsonView
from sierra.util.lazy_definitions import dataclass, field, regex

ID, SESSION = regex("[0-9a-f]{64}"), regex("[0-9a-f]{16}")
UNREAD = {"units", "rates", "time", "ticks_per_second", "tolerance", "ordered", "volatile"}
"""The settings of an output that do not influence how it is recorded."""
SAME_PROGRAMS = """(CASE WHEN e.reusing IS NULL THEN e.packages IS NULL AND e.programs = $programs
    AND e.session NOT IN (SELECT s.stale FROM stale_sessions s WHERE s.session = $session) ELSE e.reusing = $session END)"""
"""The SQL condition that a candidate e used programs and files that are unchanged; see `Context.same_programs`."""
SAVED = (
    "session",
    "batch",
    "purpose",
    "environment",
    "programs",
    "engine",
    "shared",
    "enforced",
    "number",
    "raw",
    "engines",
    "trial",
)
"""The fields that are saved as they are."""


class Declared(TypedDict):
    """A project's declarations of outputs and success, and the readers of other packages, as JSON."""

    outputs: dict[str, dict[str, Json]]
    success: dict[str, Json]
    readers: NotRequired[Used]


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
    isolation: IsolationRow | None = None
    """The isolation of the runs; None if they were not isolated."""
    shared: bool = False
    enforced: tuple[str, ...] = ()
    """The limits that the engine enforces."""
    number: int | None = None
    """The session's Lamport number; None without a session."""

    def lamport(self, position: int = 0) -> int:
        """Return the `lamport` value of a record of this session; `position` is an execution's position in it."""
        return stamp(self.number, self.session, position)

    raw: bool = True
    """True if the bytes of files that become tables are stored too."""
    readers: Used = field(default_factory=dict)
    """The readers of other packages that the outputs need."""
    engines: Tables = field(default_factory=dict)
    """The options of engines in `sierra.toml`."""
    trial: Mapping[str, JsonView] | None = None
    """The columns of the row in `trials` of the one execution that is a supervised trial now; None if there is none."""

    @property
    def same_programs(self) -> dict[str, str]:
        """The parameters of `SAME_PROGRAMS`."""
        return {"programs": self.programs, "session": self.session}

    @property
    def ingest_rules(self) -> str:
        """The hash of the rules that decide if an execution is successful and what is recorded of it."""
        return digest("reading", self._tables({"mismatch", *UNREAD}))

    @property
    def batch_rules(self) -> str:
        """The hash of these rules and of the differences that are allowed between siblings."""
        return digest("reading", self._tables(UNREAD))

    @property
    def declared(self) -> str:
        """The project's declarations of outputs and success, as JSON."""
        return json.dumps(self._tables())

    def _tables(self, without: AbstractSet[str] = frozenset()) -> dict[str, JsonView]:
        """Return the declarations; later keys and readers only if they are used, so that earlier hashes stay the same."""
        outputs = {
            name: output.model_dump(mode="json", exclude={*without, *output.unused_later_keys})
            for name, output in self.outputs.items()
        }
        success = self.success.model_dump(mode="json", exclude={*self.success.unused_later_keys})
        declared: dict[str, JsonView] = {"outputs": outputs, "success": success}
        if self.readers:
            declared["readers"] = {name: dict(cast("Mapping[str, JsonView]", reader)) for name, reader in self.readers.items()}
        return declared

    def save(self, path: Path) -> None:
        fields = {**{name: getattr(self, name) for name in SAVED}, **self._tables()}
        fields["isolation"] = self.isolation and self.isolation._asdict()
        with disk_errors(path.parent):
            write_whole(path, json.dumps(fields, default=str).encode())

    @classmethod
    def load(cls, path: Path) -> Context:
        """Load a saved context. Raises FileNotFoundError, and Damaged if the file is not a valid context."""
        fields = read_record(path)
        try:
            declared = Declared(outputs=fields["outputs"], success=fields["success"], readers=fields.get("readers", {}))
            fields["outputs"], fields["success"], fields["readers"] = rules_of(declared)
            fields["isolation"] = IsolationRow(**known) if (known := fields.get("isolation")) else None
            context = cls(**fields)
            if ID.fullmatch(context.batch) and SESSION.fullmatch(context.session):
                return context
        except (ValueError, LookupError, TypeError, AttributeError):
            pass
        raise Damaged(
            f"{path}: was not written by this version of SIERRA; move {path.parent} away, or continue with the other version"
        )


def rules_of(declared: Declared) -> tuple[dict[str, Output], Success, Used]:
    """Return the declarations of outputs and success, and the readers, from the form of `Context.declared`."""
    outputs = {name: Output.model_validate(output) for name, output in declared["outputs"].items()}
    return outputs, Success.model_validate(declared["success"]), dict(declared.get("readers", {}))
