"""The documentation is correct: commands print the shown output, settings are valid, and links have targets."""

from __future__ import annotations

import os
import re
import runpy
import shlex
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from contextlib import chdir
from dataclasses import dataclass
from pathlib import Path

import pytest

from sierra import platforms
from sierra.config import project_file
from tests import plugins, projects

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
TUTORIAL = DOCS / "tutorial.md"
PLUGINS = DOCS / "how-to" / "plugins.md"
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted(DOCS.rglob("*.md"))]
EXECUTED = [ROOT / "README.md", TUTORIAL, *sorted((DOCS / "how-to").glob("*.md"))]
LONG = {"derived-tables", "number-of-runs", "packages", "plugins", "queries", "report", "supervised-trials", "targets"}
"""Guides whose commands take long; they are executed at night, those of all other pages for each change."""
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


def blocks(page: Path) -> Iterator[Block]:
    text = page.read_text("utf-8")
    for found in FENCE.finditer(text):
        comment = COMMENT.search(text, endpos=found.start())
        notes = {comment["key"]: comment["value"]} if comment else {}
        line = text.count("\n", 0, found.start()) + 1
        yield Block(found["kind"], found["title"] or "", found["text"], line, notes)


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


def run(command: str, folder: Path) -> tuple[int, str, str]:
    """Return the exit code, the output and the messages of a command."""
    words = shlex.split(command, comments=True)
    if words[0] == "sierra" and not SHELL.search(command.partition("  #")[0]):
        done = projects.quick(folder, *words[1:])
    else:
        done = subprocess.run(["bash", "-c", command], cwd=folder, capture_output=True, text=True, timeout=100, check=False)
    return done.returncode, done.stdout, done.stderr


def pattern(shown: list[str]) -> re.Pattern[str]:
    """Return the pattern that output must match: `…` matches any text in a line, and as a line of its own any lines."""
    lines = (r"(?:.*\n)*?" if line == "…" else ".*".join(map(re.escape, line.rstrip().split("…"))) + r" *\n" for line in shown)
    return re.compile("".join(lines))


def follow(page: Path, folder: Path) -> None:
    """Execute the steps of a page in order."""
    for block in blocks(page):
        if "not executed" in block.notes:
            continue
        if block.title:
            (folder / block.title).parent.mkdir(parents=True, exist_ok=True)
            (folder / block.title).write_text(block.text, "utf-8")
        elif block.kind in ("sh", "console"):
            codes = []
            for command, shown in steps(block):
                code, output, messages = run(command, folder)
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


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The tutorial's project after its step 3."""
    folder = tmp_path_factory.mktemp("docs") / "project"
    folder.mkdir()
    for block in blocks(TUTORIAL):
        if block.title:
            (folder / block.title).write_text(block.text, "utf-8")
    with pytest.MonkeyPatch.context() as patch:
        as_user(patch)
        done = projects.quick(folder, "run", "population_size.Log4", "--no-figures")
    assert done.returncode == 0, done.stderr
    return folder


@pytest.mark.integration
@pytest.mark.each_case
@pytest.mark.parametrize(
    "page",
    [pytest.param(page, marks=pytest.mark.nightly if page.stem in LONG else ()) for page in EXECUTED],
    ids=name_of,
)
def test_commands_of_a_page_print_the_shown_output(
    page: Path, project: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    as_user(monkeypatch)
    folder = tmp_path / "project"
    if page == PLUGINS:
        plugins.project(folder)
        place = plugins.install(tmp_path / "package")
        monkeypatch.syspath_prepend(str(place))
        monkeypatch.setenv("PYTHONPATH", str(place))
    elif page.parent.name == "how-to":
        shutil.copytree(project, folder)
    else:
        folder.mkdir()
    if page.name == "README.md":
        monkeypatch.setenv("SIERRA_FIGURES", "false")  # the tutorial draws the same
        for name in ("sim.py", "arena.xml"):
            shutil.copy(project / name, folder)
    follow(page, folder)


def test_page_on_plugins_shows_the_tested_package() -> None:
    for block in blocks(PLUGINS):
        if block.title:
            file = plugins.SOURCE / ("project" if block.title == "sierra.toml" else "") / block.title
            assert file.read_text("utf-8") == block.text, f"{name_of(PLUGINS)}, line {block.line}"


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_settings_shown_in_a_page_are_valid(page: Path) -> None:
    for block in blocks(page):
        if block.kind == "toml" and "not loaded" not in block.notes:
            settings = tomllib.loads(block.text)
            if not {"template", "templates", "command"} & settings.keys():
                settings |= {"template": "arena.xml", "command": "true"}
            where = f"{name_of(page)}, line {block.line}"
            loaded = project_file.parse(settings, where)
            if page != PLUGINS:  # its platform is in a package that is not installed here
                platforms.find(loaded.platform, loaded)


def test_every_command_is_executed_or_has_a_reason_why_not() -> None:
    kinds = {block.kind for page in PAGES for block in blocks(page)}
    assert kinds <= {"", "console", "python", "sh", "text", "toml", "xml"}, "a test must know what to do with it"
    for page in EXECUTED:
        for block in blocks(page):
            if block.kind == "" and block.text.startswith("$ "):
                assert block.notes.get("not executed"), f"{name_of(page)}, line {block.line}"


def slugs(page: Path) -> set[str]:
    """Return the anchors of a page's headings, as GitHub and Sphinx make them."""
    text = FENCE.sub("", page.read_text("utf-8"))
    return {re.sub(r"[^\w\- ]", "", title.lower()).strip().replace(" ", "-") for title in re.findall(r"(?m)^#+ (.+)$", text)}


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_every_link_has_a_target(page: Path) -> None:
    text = re.sub(r"`[^`\n]*`", "", FENCE.sub("", page.read_text("utf-8")))
    for link in re.findall(r"\]\(([^)\s]+)\)", text):
        if "://" in link:
            continue
        path, _, anchor = link.partition("#")
        target = (page.parent / path).resolve() if path else page
        assert target.is_file(), f"{name_of(page)}: {link}"
        assert not anchor or anchor in slugs(target), f"{name_of(page)}: {link}"
        if page.is_relative_to(DOCS):
            assert target.is_relative_to(DOCS), f"{name_of(page)}: {link} is not on the site"


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_every_repository_file_named_in_a_page_exists(page: Path) -> None:
    if page.is_relative_to(DOCS / "reference"):
        return
    named = re.findall(r"`((?:sierra|tests|docs|schemas)/[\w./-]+)`", FENCE.sub("", page.read_text("utf-8")))
    assert [path for path in named if not (ROOT / path).exists()] == []


def test_site_navigation_lists_every_page() -> None:
    contents: dict[str, list[str]] = runpy.run_path(str(DOCS / "conf.py"))["CONTENTS"]
    listed = ["index.md", *(f"{page}.md" for pages in contents.values() for page in pages)]
    assert sorted(listed) == sorted(str(page.relative_to(DOCS)) for page in DOCS.rglob("*.md"))


def test_generated_reference_is_up_to_date() -> None:
    pages = runpy.run_path(str(DOCS / "generate.py"))["pages"]()
    written = {path.name: path.read_text("utf-8") for path in (DOCS / "reference").iterdir()}
    assert written == pages, "make schemas writes them again"


def test_readme_has_at_most_150_lines() -> None:
    assert len((ROOT / "README.md").read_text("utf-8").splitlines()) <= 150
