"""Facts that are recorded with a trial: hashes of declared files, and what declared commands print."""

from __future__ import annotations

import subprocess
from pathlib import Path

from sierra.errors import Missing
from sierra.execution import commands
from sierra.extensions.trials.table import Trials
from sierra.util.hashing import sha256
from sierra.util.regular_files import read_regular

TIMEOUT_S = 30.0
KEPT = 1000
"""The number of characters that are kept of what a command prints."""


def of_files(trials: Trials, root: Path) -> dict[str, str]:
    """Return the SHA-256 of each declared file, by path. Raises Missing."""
    found = {}
    for name in trials.files:
        try:
            found[name] = sha256(read_regular(root / name))
        except OSError as error:
            raise Missing(f"[trials] files: {name} cannot be read: {error.strerror}") from error
    return found


def of_commands(trials: Trials, root: Path) -> dict[str, str]:
    """Return what each declared command prints to standard output, by name. Raises Missing for a command that fails."""
    return {name: _printed(name, commands.fill(words, root), root) for name, words in trials.commands.items()}


def _printed(name: str, argv: tuple[str, ...], root: Path) -> str:
    command = f"[trials.commands] {name}: {argv[0]}"
    try:
        ended = subprocess.run(argv, cwd=root, stdin=subprocess.DEVNULL, capture_output=True, timeout=TIMEOUT_S, check=False)
    except OSError as error:
        raise Missing(f"{command} cannot be started: {error.strerror}") from error
    except subprocess.TimeoutExpired as error:
        raise Missing(f"{command} did not end within {TIMEOUT_S:g} s") from error
    if ended.returncode:
        said = ended.stderr.decode("utf-8", "replace").strip().splitlines()[-1:]
        raise Missing(": ".join([f"{command} ended with status {ended.returncode}", *said]))
    return ended.stdout.decode("utf-8", "replace").strip()[:KEPT]
