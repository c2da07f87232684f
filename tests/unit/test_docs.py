"""The documentation is correct: commands print the shown output, settings are valid, and links have targets."""

from __future__ import annotations

import re
import runpy
import shutil
import tomllib
from pathlib import Path

import pytest

import sierra
from sierra.config import project_file
from sierra.config.extensions import is_there, without_absent
from sierra.config.plugin_registry import FIGURES
from sierra.design import platforms
from tests import plugins, projects
from tests.support.pages import DOCS, FENCE, ROOT, as_user, blocks, extension_of, follow, name_of

TUTORIAL = DOCS / "tutorial.md"
EXTENSIONS = DOCS / "extensions"
PLUGINS = DOCS / "how-to" / "plugins.md"
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted(DOCS.rglob("*.md"))]
ROBOTS = DOCS / "how-to" / "robots.md"
"""The page that `tests/extensions/robots/test_robots_page.py` executes, on a fleet."""
EXECUTED = [ROOT / "README.md", TUTORIAL, *sorted((DOCS / "how-to").glob("*.md")), *sorted(EXTENSIONS.glob("*.md"))]
OVERVIEWS = (DOCS / "index.md", DOCS / "gallery.md")
"""The pages that list what extensions have."""
LONG = {
    "derived-tables",
    "from-scripts",
    "number-of-runs",
    "packages",
    "plugins",
    "queries",
    "report",
    "targets",
    "trials",
}
"""Guides whose commands take long; they are executed at night, those of all other pages for each change."""


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
    [pytest.param(page, marks=pytest.mark.nightly if page.stem in LONG else ()) for page in EXECUTED if page != ROBOTS],
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
    elif page.parent.name in ("how-to", "extensions"):
        shutil.copytree(project, folder)
    else:
        folder.mkdir()
    if page.name == "README.md":
        monkeypatch.setenv("SIERRA_FIGURES", "false")  # the tutorial draws the same
        (folder / "my_simulator").mkdir()
        for name in ("sim.py", "arena.xml"):
            shutil.copy(project / name, folder / "my_simulator")
    follow(page, folder)


def test_page_on_plugins_shows_the_tested_package() -> None:
    for block in blocks(PLUGINS):
        if block.title:
            file = plugins.SOURCE / ("project" if block.title in ("sierra.toml", "ranges.py") else "") / block.title
            assert file.read_text("utf-8") == block.text, f"{name_of(PLUGINS)}, line {block.line}"


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_settings_shown_in_a_page_are_valid(page: Path) -> None:
    for block in blocks(page):
        if block.kind == "toml" and "not loaded" not in block.notes:
            settings = tomllib.loads(block.text)
            if page.parent == EXTENSIONS:
                settings, _ = without_absent(settings)  # a page may show tables of another extension, which can be deleted
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


ID = re.compile(r"(?<![\w./:-])(?=[0-9]*[a-f])(?=[a-f]*[0-9])[0-9a-f]{10}(?:[0-9a-f]{2,54})?(?![\w-])")
CALL = re.compile(r"(?m)(?:^|[`$ ])sierra [a-z-]+ [^\n]*")
PREFIX = re.compile(r"(?<![\w./-])(?=[a-f]*[0-9])[0-9a-f]{4,64}(?![\w.])")
NO_IDS = {"7e5d2f2a41": "a commit", "c6bc2e0f1f40fd4c": "a segment"}
SAID = "self.random.normalvariate(0, self.noise)", "self.random.gauss(0, self.noise)"


def shown_ids(page: Path) -> set[str]:
    """Return the ids and prefixes in the texts of a page that are not compared by executing it."""
    text = page.read_text("utf-8")
    for block in blocks(page):
        if page in EXECUTED and "not executed" not in block.notes and block.kind in ("sh", "console", "python"):
            text = text.replace(block.text, "")
    calls = " ".join(CALL.findall(text))
    return {*ID.findall(text), *(word for word in PREFIX.findall(calls) if not word.isdigit())} - NO_IDS.keys()


def executed_ids(page: Path) -> set[str]:
    """Return the ids that are compared by executing a page."""
    texts = (block.text for block in blocks(page) if "not executed" not in block.notes and block.kind == "console")
    return {one for text in texts for one in ID.findall(text)}


@pytest.mark.integration
def test_ids_that_are_not_executed_are_those_of_the_example(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """All others are in the output of executed commands. Help texts are in the reference of commands."""
    folder = tmp_path / "demo"
    assert projects.quick(tmp_path, "init", "--example", "swarm", str(folder)).returncode == 0
    known = {one for page in EXECUTED for one in executed_ids(page)}
    example = sierra.open(folder)
    plans = [example.plan("population_size.Log8"), example.plan("population_size.Log4", runs=5)]
    plans.append(example.plan("population_size.Log8", "controller=random_walk,pheromone"))
    (folder / "swarm.py").write_text(
        (folder / "swarm.py").read_text("utf-8").replace(*SAID), "utf-8"
    )  # as on the page on comparing
    speed = ("//numeric[@name='max_speed']/@data", "0.3")
    plans.append(sierra.open(folder).plan("population_size.Log4", runs=5, sets=[speed]))
    batches = [plan.batch for plan in plans]
    known.update(*({batch.id, *(run.id for run in batch.runs)} for batch in batches))
    pages = [*PAGES, *(ROOT / "sierra").rglob("*.md"), *(ROOT / "sierra").rglob("*.toml")]
    wrong = {
        f"{name_of(page)}: {one}"
        for page in pages
        for one in shown_ids(page)
        if not any(id.startswith(one[:10]) or one.startswith(id) for id in known)
    }
    assert not wrong


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
        if target.parent == EXTENSIONS and not is_there(extension_of(target)):
            continue  # the page has been deleted with its extension
        assert target.is_file(), f"{name_of(page)}: {link}"
        assert not anchor or anchor in slugs(target), f"{name_of(page)}: {link}"
        if page.is_relative_to(DOCS):
            assert target.is_relative_to(DOCS), f"{name_of(page)}: {link} is not on the site"
        if page.is_relative_to(DOCS) and page not in OVERVIEWS and not page.is_relative_to(EXTENSIONS):
            assert not target.is_relative_to(EXTENSIONS), f"{name_of(page)}: {link} is of an extension, which can be deleted"


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


def test_first_page_links_to_every_page() -> None:
    linked = re.findall(r"\]\(([\w/-]+\.md)", (DOCS / "index.md").read_text("utf-8"))
    assert {str(page.relative_to(DOCS)) for page in DOCS.rglob("*.md")} - {"index.md", *linked} == set()


def test_generated_reference_is_up_to_date() -> None:
    pages = runpy.run_path(str(DOCS / "generate.py"))["pages"]()
    written = {path.name: path.read_text("utf-8") for path in (DOCS / "reference").iterdir()}
    assert written == pages, "make schemas writes them again"


def test_gallery_has_all_kinds_of_figures() -> None:
    text = runpy.run_path(str(DOCS / "generate.py"))["gallery"]()
    assert (DOCS / "gallery.md").read_text("utf-8") == text, "make schemas writes its overview again"
    assert set(re.findall(r"\[!\[(\w+)\]", text)) == set(FIGURES.shipped)


def test_readme_has_at_most_100_lines() -> None:
    assert len((ROOT / "README.md").read_text("utf-8").splitlines()) <= 100
