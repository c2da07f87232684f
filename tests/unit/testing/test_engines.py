"""The shipped engines pass the conformance suite with the real programs, and the suite detects violations."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from sierra.containers import engines, images
from sierra.containers.engines.base import ContainerSpec, NoEngine, Process
from sierra.model import Client
from sierra.testing import engines as conformance
from tests import containers
from tests.users import User, a_user, called_as


@pytest.fixture(scope="session")
def archive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return an image of busybox, made once."""
    return containers.busybox(tmp_path_factory.mktemp("busybox"))


@pytest.fixture
def user(request: pytest.FixtureRequest, require: Callable[..., str]) -> Iterator[User]:
    """Yield a user without privileges; with a range of ids if the test requests it."""
    require("root, to make a user", there=os.geteuid() == 0)
    require("useradd")
    ids: bool = request.param
    with a_user(f"sierra-test-{os.getpid()}", ids=ids) as made:
        yield made


def conforms(name: str, user: User | None, archive: Path, folder: Path) -> None:
    """Check all claims of an engine that a user calls."""
    home = user.home if user else folder
    data = archive.read_bytes()

    def check() -> None:
        (home / "a project's").mkdir()
        (home / "a project's" / "busybox.tar").write_bytes(data)
        image = images.named(home / "a project's", "busybox.tar")
        trials = home / "trials"
        trials.mkdir()
        conformance.check(engines.find(name), image, home / "a project's", trials)

    called_as(user, check)


@pytest.mark.integration
def test_the_engine_none_conforms(tmp_path: Path) -> None:
    conformance.check(NoEngine(), None, tmp_path, tmp_path)


@pytest.mark.real
@pytest.mark.integration
@pytest.mark.parametrize("name", ["podman", "apptainer"])
def test_podman_and_apptainer_conform(name: str, archive: Path, tmp_path: Path, require: Callable[..., str]) -> None:
    require(name)
    conforms(name, None, archive, tmp_path)


@pytest.mark.real
@pytest.mark.nightly
@pytest.mark.parametrize(
    ("name", "user"),
    [("podman", True), ("podman", False), ("apptainer", False)],
    indirect=["user"],
    ids=["podman", "podman-without-ids", "apptainer"],
)
def test_podman_and_apptainer_conform_without_privileges(
    name: str, user: User, archive: Path, tmp_path: Path, require: Callable[..., str]
) -> None:
    require(name)
    conforms(name, user, archive, tmp_path)


class Leaking(NoEngine):
    """An engine that passes on the caller's environment."""

    def client(self, box: ContainerSpec, process: Process) -> Client:
        return Client(process.argv, {**os.environ, **process.environment})


class Splitting(NoEngine):
    """An engine that interprets a command as a line of a shell."""

    def client(self, box: ContainerSpec, process: Process) -> Client:
        return Client(("sh", "-c", " ".join(process.argv)), process.environment)


class Deaf(NoEngine):
    """An engine that forwards no signal."""

    def client(self, box: ContainerSpec, process: Process) -> Client:
        return Client(("sh", "-c", 'trap "" TERM; "$@"; exit $?', "sh", *process.argv), process.environment)


class Talking(NoEngine):
    """An engine that writes its own messages."""

    def client(self, box: ContainerSpec, process: Process) -> Client:
        return Client(("sh", "-c", 'echo INFO: starting >&2; exec "$@"', "sh", *process.argv), process.environment)


class Unsure(NoEngine):
    """An engine that can't start anything."""

    def probe(self) -> engines.Capabilities:
        return replace(super().probe(), trouble="no container can be started; start another engine")


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("engine", "claim", "complaint"),
    [
        (Leaking, conformance.passes_the_environment_exactly, "variables of the caller"),
        (Splitting, conformance.passes_words_as_they_are, "became"),
        (Deaf, conformance.ends_a_program_that_does_not_care, "did not end"),
        (Talking, conformance.keeps_output_apart, "standard error became"),
        (Unsure, conformance.says_what_it_can, "start another engine"),
        (NoEngine, conformance.has_no_rights, "Cap"),
        (NoEngine, conformance.has_no_name_of_the_hosts, "the container's host name is"),
        (NoEngine, conformance.says_what_cannot_be_started, "became|No such file"),
    ],
)
def test_the_suite_detects_violations_of_its_claims(
    engine: type[NoEngine],
    claim: Callable[[conformance.Trial], None],
    complaint: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(conformance, "SOON_S", 1.0)
    with pytest.raises((AssertionError, FileNotFoundError), match=complaint):
        claim(conformance.Trial(engine(), None, tmp_path, tmp_path))
