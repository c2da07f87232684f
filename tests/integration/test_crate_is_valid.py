"""A package's RO-Crate and CITATION.cff are valid by published validators, without a network.

The validators need other versions of some packages than SIERRA, so that `make integration` puts them into `.venv-validators`.
"""

from __future__ import annotations

import json
import subprocess
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest

import sierra
from tests import large_stores, projects

pytestmark = pytest.mark.integration
TOML = """
[package]
title = "Coverage of a swarm"
description = "All runs of the paper."
license = "MIT"
keywords = ["swarm"]
version = "1.0"
repository = "https://example.org/project.git"
related = [{ identifier = "10.5555/12345678" }]
[[package.authors]]
name = "Jane Doe"
orcid = "0000-0002-1825-0097"
affiliation = "Example University"
ror = "https://ror.org/017zqws13"
"""
FILL = """
import io, json, pathlib, requests, requests_cache, rocrate, sys
from urllib3 import HTTPResponse

TERMS = "https://w3id.org/ro/terms/workflow-run"
NAMES = "ContainerImage DockerImage SIFImage md5 sha1 sha256 sha512 registry tag containerImage environment".split()
CRATE = pathlib.Path(rocrate.__file__).with_name("data").joinpath("ro-crate.jsonld").read_bytes()
assert b"https://w3id.org/ro/crate/1.1/context" in CRATE, "rocrate 0.13 has the context of RO-Crate 1.1"
FILES = {
    "https://w3id.org/ro/crate/1.1/context": CRATE,
    TERMS + "/context": json.dumps({"@context": {name: TERMS + "#" + name for name in NAMES}}).encode(),
}

class Files(requests.adapters.HTTPAdapter):
    def send(self, request, **_):
        headers = {"Content-Type": "application/ld+json"}
        return self.build_response(request, HTTPResponse(io.BytesIO(FILES[request.url]), headers, 200, preload_content=False))

session = requests_cache.CachedSession(sys.argv[1], backend="sqlite", expire_after=-1)
session.mount("https://", Files())
for address in FILES:
    session.get(address)
"""
"""A program that fills the cache of the validator from files."""
VALIDATORS = Path(__file__).parents[2] / ".venv-validators" / "bin"
SKIPPED = "process-run-crate-0.5_5.1"
"""It wants an address on the web as the id of each program; but the profile for workflows wants a file of the crate."""

NO_ADDRESS = "ro-crate-1.1_31.2"
"""It wants an address of each organization, which an anonymous one has not."""


def unpacked(folder: Path, query: str, runs: int, *, grown: int = 0, anonymous: bool = False) -> Path:
    """Return an unpacked package; `grown`: a batch with so many runs was written directly."""
    root = projects.make(folder / "project", projects.CONFIG + TOML)
    batch = sierra.open(root).run(query, runs=runs, figures=False).batch
    batch = large_stores.grow(root, batch, grown) if grown else batch
    sierra.open(root).packages.pack(batch, path=folder / "x.zip", anonymous=anonymous)
    with zipfile.ZipFile(folder / "x.zip") as file:
        file.extractall(folder / "x")
    return folder / "x"


@pytest.mark.parametrize(
    ("query", "grown", "skipped"),
    [("population_size=1,2,3", 0, ""), ("population_size=1,2,3", 0, NO_ADDRESS), ("population_size=1", 400, "")],
)
def test_the_crate_is_valid(tmp_path: Path, query: str, grown: int, skipped: str, require: Callable[..., str]) -> None:
    validator = require(str(VALIDATORS / "rocrate-validator"))
    package = unpacked(tmp_path, query, 1, grown=grown, anonymous=skipped == NO_ADDRESS)
    python = VALIDATORS / "python"
    subprocess.run([python, "-c", FILL, tmp_path / "cache"], check=True)
    words: list[str | Path] = [
        "--offline",
        "--cache-path",
        tmp_path / "cache",
        "-p",
        "provenance-run-crate-0.5",
        "-l",
        "recommended",
    ]
    words += ["--skip-checks", SKIPPED, "--no-paging", "-f", "json", "-o", tmp_path / "report.json", package]
    done = subprocess.run([validator, "-y", "validate", *words], check=False, capture_output=True, text=True)
    assert (tmp_path / "report.json").exists(), done.stdout + done.stderr
    report = json.loads((tmp_path / "report.json").read_text())
    issues = [(one["check"]["identifier"], one["message"]) for one in report["issues"] if one["check"]["identifier"] != skipped]
    assert issues == []
    assert done.returncode == bool(skipped), done.stdout


@pytest.mark.nightly
def test_the_citation_is_valid(tmp_path: Path, require: Callable[..., str]) -> None:
    validator = require(str(VALIDATORS / "cffconvert"))
    package = unpacked(tmp_path, "population_size=1", 1)
    done = subprocess.run(
        [validator, "--validate", "-i", package / "CITATION.cff"], check=False, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout + done.stderr
