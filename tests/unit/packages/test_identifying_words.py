"""The words that identify come from all places that know the user, and leave out what everybody has."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from sierra.config import project_file
from sierra.config.package_table import Package
from sierra.packages.anonymity import identifying_words
from sierra.packages.anonymity.identifying_words import words
from tests import projects


class Records:
    """A store that knows two hosts, two remotes and an operator."""

    def values(self, kind: type, text: str) -> list[str]:
        known = {
            identifying_words.HOSTS: ["node7.cluster.lab.example", "localhost", "host-1"],
            identifying_words.REMOTES: [
                "ssh://git@git.lab.example:22/janes-group/sim.git",
                "https://github.com/other/x",
                "../y",
            ],
            identifying_words.OPERATORS: ["Grace Hopper", "redacted"],
        }
        return known[text]


def test_words_come_from_the_package_git_the_account_and_the_records(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    root = projects.commit(projects.make(tmp_path / "study"))
    (root / ".git/config").write_text(
        '[user]\nname = José Müller\nemail = jm@uni.example\n[remote "origin"]\nurl = git@github.com:janelab/swarm.git\n'
    )
    monkeypatch.setenv("USER", "jmueller")
    monkeypatch.setenv("HOME", "/home/jmueller")
    monkeypatch.setenv("LOGNAME", "root")
    author = {"name": "Doe, Jane Q.", "orcid": "0000-0002-1825-0097", "affiliation": "MIT"}
    package = Package(title="x", license="MIT", authors=(author,), related=({"identifier": "10.5555/12345678"},))  # type: ignore[arg-type]
    project = project_file.load(root)
    fleet = {"fleet": {"tb1": {"host": "pi@tb1.robots.example:22"}, "tb2": {"host": "tb2"}, "tb3": {"host": "192.168.1.9"}}}
    project = replace(project, config=project.config.model_copy(update={"package": package, "runners": {"robots": fleet}}))
    found, general = words(project, Records())  # type: ignore[arg-type]
    texts = {word.text for word in found}
    assert texts > {
        *("Jane Q. Doe", "Jane Doe", "Doe", "0000-0002-1825-0097", "10.5555/12345678", "José Müller", "Müller"),
        *("jm@uni.example", "uni.example", "github.com/janelab/swarm", "janelab", "jmueller", "/home/jmueller", str(root)),
        *("node7.cluster.lab.example", "node7", "cluster.lab.example", "git.lab.example", "janes-group", "other"),
        *("Grace Hopper", "Hopper", "tb1.robots.example", "robots.example"),
    }
    assert {"root", "localhost", "host-1", "github.com", "MIT"} <= set(general)
    assert not texts & {
        "redacted",
        "tb2",
        "192.168.1.9",
        "root",
        "localhost",
        "github.com",
        "MIT",
        "..",
        "y",
        "/",
        "/home",
        "/tmp",
    }
    assert all(len(text) > 1 for text in texts)
