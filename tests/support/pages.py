"""The documentation as a test reads and follows it: blocks of a page, and the commands in them with the shown output."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from contextlib import chdir
from dataclasses import dataclass
from pathlib import Path

import pytest

from tests import projects

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
FENCE = re.compile(r"(?ms)^```(?P<kind>\w*)(?: title=\"(?P<title>[^\"]+)\")?\n(?P<text>.*?)^```$")
COMMENT = re.compile(r"<!-- (?P<key>not executed|not loaded|exit code): (?P<value>[^\n]+) -->\n\Z")
SHELL = re.compile(r"[|<>&;$`*#\\]")
"""Characters that need a shell; a command without them is called within this process, which is faster."""


@dataclass(frozen=True, slots=True)
class Block:
    """A fenced block of a page, and the comment before it."""

    kind: str
    title: str
    text: str
    line: int
    notes: dict[str, str]


def blocks(page: Path, section: str = "") -> Iterator[Block]:
    """Yield the blocks of a page, or those below one of its headings, which is given by its first words."""
    text = page.read_text("utf-8")
    first, last = _section(text, section) if section else (0, len(text))
    for found in FENCE.finditer(text, first, last):
        comment = COMMENT.search(text, endpos=found.start())
        notes = {comment["key"]: comment["value"]} if comment else {}
        line = text.count("\n", 0, found.start()) + 1
        yield Block(found["kind"], found["title"] or "", found["text"], line, notes)


def _section(text: str, section: str) -> tuple[int, int]:
    found = re.search(rf"(?ms)^## {re.escape(section)}\b.*?(?=^## |\Z)", text)
    assert found, section
    return found.span()


def extension_of(page: Path) -> str:
    """Return the extension that a page in `docs/extensions` belongs to."""
    return {"capture": "videos"}.get(page.stem, page.stem)


def name_of(page: Path) -> str:
    return str(page.relative_to(ROOT))


def steps(block: Block) -> Iterator[tuple[str, list[str]]]:
    """Yield each command of a block, with the lines of output that the page shows for it."""
    if block.kind == "sh":
        yield from ((line, []) for line in block.text.splitlines() if line.strip())
        return
    for step in re.split(r"(?m)^\$ ", block.text)[1:]:
        command, *shown = step.splitlines()
        yield command, shown


def run(command: str, folder: Path, timeout_s: float = 100) -> tuple[int, str, str]:
    """Return the exit code, the output and the messages of a command."""
    words = shlex.split(command, comments=True)
    if words[0] == "sierra" and not SHELL.search(command.partition("  #")[0]):
        done = projects.quick(folder, *words[1:])
    else:
        argv = ["bash", "-c", command]
        done = subprocess.run(argv, cwd=folder, capture_output=True, text=True, timeout=timeout_s, check=False)
    return done.returncode, done.stdout, done.stderr


def pattern(shown: list[str]) -> re.Pattern[str]:
    """Return the pattern that output must match: `…` matches any text in a line, and as a line of its own any lines."""
    lines = (r"(?:.*\n)*?" if line == "…" else ".*".join(map(re.escape, line.rstrip().split("…"))) + r" *\n" for line in shown)
    return re.compile("".join(lines))


def follow(page: Path, folder: Path, section: str = "", timeout_s: float = 100) -> None:
    """Execute the steps of a page, or of one section, in order. A command `cd FOLDER` holds for all that follow."""
    for block in blocks(page, section):
        if "not executed" in block.notes:
            continue
        if block.title:
            (folder / block.title).parent.mkdir(parents=True, exist_ok=True)
            (folder / block.title).write_text(block.text, "utf-8")
        elif block.kind in ("sh", "console"):
            codes = []
            for command, shown in steps(block):
                if command.startswith("cd ") and not SHELL.search(command):
                    folder = (folder / command.removeprefix("cd ")).resolve(strict=True)
                    codes.append(0)
                    continue
                code, output, messages = run(command, folder, timeout_s)
                codes.append(code)
                where = f"{name_of(page)}, line {block.line}: {command}\n{output}{messages}"
                assert not shown or pattern(shown).fullmatch(output), where
                assert code == 0 or "exit code" in block.notes, where
            assert codes[-1] == int(block.notes.get("exit code", 0)), f"{name_of(page)}, line {block.line}"
        elif block.kind == "python":
            with chdir(folder):
                exec(compile(block.text, name_of(page), "exec"), {})  # noqa: S102


def as_user(patch: pytest.MonkeyPatch) -> None:
    """Find `sierra` and `python3` where a user has them."""
    patch.setenv("PATH", f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}")
