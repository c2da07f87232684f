"""Secrets stop a package before it is written, large files must be confirmed, and other facts are stated."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path

import pytest

import sierra
from sierra.packages.parts.secret_shapes import kinds, variables
from tests import projects

LETTERS = "aB3dE5gH7jK9mN1pQ3sT5vW7yZ9bC1eF3hJ5"
SECRETS = {
    "a token of GitHub": f"token: ghp_{LETTERS}",
    "a token of GitLab": f"glpat-{LETTERS[:20]}",
    "a key of AWS": "AKIA" + "Q7XW2M5ZK3YB6RTD",
    "a key of Google": "AIza" + LETTERS[:35],
    "a token of npm": "npm_" + LETTERS,
    "a private key": "-----BEGIN OPENSSH PRIVATE KEY-----\n" + LETTERS * 2,
    "a password in an address": "git clone https://jane:correcthorse@example.org/x.git",
    "a token in an address": f"https://{LETTERS[:24]}@example.org/x.git",
}
HARMLESS = (
    "ghp_short",
    "AKIAIOSFODNN7EXAMPLE",
    "https://user:$TOKEN@example.org/",
    "https://user:<password>@example.org/",
    "https://user:xxxx@example.org/",
    "https://example.org:8080/a@b",
    "ssh://git@example.org:22/x.git",
    "-----BEGIN PUBLIC KEY-----\n" + LETTERS * 2,
    "if line.startswith('-----BEGIN PRIVATE KEY-----'):",
)
PACKAGE = '\n[package]\ntitle = "T"\nauthors = [{ name = "Jane Doe" }]\nlicense = "MIT"\n'


@pytest.mark.parametrize("kind", SECRETS)
def test_a_secret_is_found_wherever_a_block_ends(kind: str) -> None:
    text = f"one\n{SECRETS[kind]}\ntwo\n".encode()
    for end in range(len(text)):
        assert kinds([text[:end], text[end:]]) == {kind}
    assert kinds([b"\0" + text]) == set()


def test_examples_and_placeholders_are_no_secrets() -> None:
    assert [one for one in HARMLESS if kinds([one.encode()])] == []
    table = {"API_KEY": "k", "GITHUB_TOKEN": "$GITHUB_TOKEN", "MAX_TOKENS": "5", "a": [{"db_password": "p", "secret": ""}]}
    assert list(variables(table)) == ["API_KEY", "db_password"]


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A project in git with a batch whose source, settings and log have secrets."""
    config = projects.CONFIG + '[environment]\nset = { LAB_PASSWORD = "correcthorse" }\n'
    simulator = projects.SIMULATOR + f'print("npm_" + "{LETTERS}")\n'
    root = projects.make(tmp_path_factory.mktemp("checks") / "project", config + PACKAGE, simulator=simulator)
    (root / "deploy.sh").write_text(f"{SECRETS['a password in an address']}\n")
    projects.commit(root)
    sierra.open(root).run("population_size=1", runs=1, figures=False)
    return root


@pytest.mark.integration
def test_a_package_with_secrets_is_refused_by_name_until_they_are_declared_harmless(root: Path, tmp_path: Path) -> None:
    [batch] = [one.batch for one in sierra.open(root).batches]
    ended = projects.quick(root, "package", batch, "--no-report", "-o", str(tmp_path / "x.zip"), "--yes")
    assert (ended.returncode, ended.stdout, ended.stderr.count("\n"), list(tmp_path.iterdir())) == (2, "", 1, [])
    for place in (
        "deploy.sh (a password in an address)",
        "LAB_PASSWORD (a variable in sierra.toml)",
        "LAB_PASSWORD (a recorded variable)",
        "stdout (a token of npm)",
    ):
        assert place in ended.stderr
    config = (root / "sierra.toml").read_text()
    (root / "sierra.toml").write_text(config + 'no_secrets = ["deploy.sh", "LAB_*", "stdout"]\nmax_file = "200 B"\n')
    try:
        asked = projects.quick(root, "package", batch, "--no-report", "-o", str(tmp_path / "x.zip"))
        assert (asked.returncode, "project/sim.py has " in asked.stderr, "more than 200 bytes" in asked.stderr) == (
            2,
            True,
            True,
        )
        done = projects.quick(root, "package", batch, "--no-report", "-o", str(tmp_path / "x.zip"), "--yes")
        assert (done.returncode, "no file with the text of its licence, MIT" in done.stdout) == (0, True)
        (root / "LICENSE.txt").write_text("Permission is hereby granted\n")
        done = projects.quick(root, "package", batch, "--no-report", "-o", str(tmp_path / "y.zip"), "--yes", "--json")
        assert not [fact for fact in json.loads(done.stdout)["preview"]["facts"] if "licence" in fact]
    finally:
        (root / "sierra.toml").write_text(config)
    with zipfile.ZipFile(tmp_path / "y.zip") as file:
        assert file.read("LICENSE.txt") == b"Permission is hereby granted\n"
