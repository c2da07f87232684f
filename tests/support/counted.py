"""A command of SIERRA that counts what it does: `python -m tests.support.counted FILE ARGUMENTS…` writes JSON to FILE."""

from __future__ import annotations

import atexit
import json
import os
import sys
from collections import Counter
from pathlib import Path
from typing import Any

from sierra.cli.main import program
from sierra.store import local_connection, segments, store, verified_files

STORE = f"{os.sep}.sierra{os.sep}"
COUNTED = {"open": "files opened", "os.listdir": "folders listed", "os.scandir": "folders listed"}
done: Counter[str] = Counter()


def note(event: str, values: tuple[Any, ...]) -> None:
    """Count the event if it is a cost of a command that may grow with the store."""
    if event in COUNTED and isinstance(values[0], str | os.PathLike) and STORE in f"{os.fspath(values[0])}{os.sep}":
        done[COUNTED[event]] += 1
    elif event == "subprocess.Popen":
        done[f"processes of {Path(str(values[0])).name}"] += 1


def count() -> None:
    """Begin to count, and write all counts at the end of the process."""
    call, snapshot = local_connection.Interruptible._call, store.Store.snapshot

    def counting(self: Any, method: Any, *arguments: Any, **named: Any) -> object:
        if arguments and isinstance(arguments[0], str):
            done["statements"] += 1
            done["files read by statements"] += arguments[0].count(".parquet'")
        return call(self, method, *arguments, **named)

    def counted(self: Any, *arguments: Any, **named: Any) -> Any:
        done["snapshots"] += 1
        return snapshot(self, *arguments, **named)

    local_connection.Interruptible._call = counting  # type: ignore[method-assign]
    store.Store.snapshot = counted  # type: ignore[method-assign]
    for module, name, value in ((segments, "SETTLED_NS", sys.maxsize), (verified_files, "RACY_NS", -sys.maxsize)):
        setattr(module, name, value)  # or the counts depend on the time since the last write
    sys.addaudithook(note)
    target = Path(sys.argv.pop(1))
    atexit.register(lambda: target.write_text(json.dumps({**done, "modules": len(sys.modules)})))


if __name__ == "__main__":
    count()
    program()
