"""Refusals of clusters: the scheduler's message, the requested settings, and the resources of the site."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest

from sierra.config.cluster_table import ClusterTable
from sierra.errors import ConfigError
from sierra.runners.schedulers.base import Request
from sierra.runners.schedulers.pbs import Pbs
from sierra.runners.schedulers.refusals import PBS, SLURM, Meaning, about
from tests import pbs, projects
from tests.clusters import Slurm

ALL = ClusterTable(
    array_tasks=7,
    cpus=99,
    memory=8_000_000_000,
    wall=3600.0,
    partition="p",
    account="a",
    qos="q",
    constraint="c",
    gpus=2,
    directives=("-x y",),
)
SITE = "the site has partition debug (up to 1:00:00): nodes of 4 cores, 4000 MB, gpu:2, fast"


def assert_about(words: str, table: Sequence[Meaning], settings: str) -> None:
    told = about(words, table, ALL, tuple)
    assert told.startswith(f"{words}: ")
    assert re.findall(r"(\w+) = ", told) == settings.split()


@pytest.mark.parametrize(
    ("words", "settings"),
    [
        ("PartitionConfig", "partition cpus memory gpus constraint wall"),
        ("Requested partition configuration not available now", "partition cpus memory gpus constraint wall"),
        ("Requested node configuration is not available", "partition cpus memory gpus constraint wall"),
        ("PartitionTimeLimit", "partition wall"),
        ("Requested time limit is invalid (missing or exceeds some limit)", "partition wall"),
        ("Invalid account or account/partition combination specified", "partition account qos"),
        ("InvalidAccount", "partition account qos"),
        ("Job violates accounting/QOS policy", "partition account qos cpus memory gpus constraint wall array_tasks"),
        ("AssocMaxWallDurationPerJobLimit", "partition account qos wall"),
        ("QOSMaxCpuPerJobLimit", "partition account qos cpus"),
        ("QOSMinMemory", "partition account qos memory"),
        ("Invalid qos specification", "qos account"),
        ("InvalidQOS", "qos account"),
        ("BadConstraints", "constraint"),
        ("Invalid feature specification", "constraint"),
        ("Memory specification can not be satisfied", "partition memory"),
        ("Invalid generic resource (gres) specification", "gpus partition"),
        ("Invalid job array specification", "array_tasks"),
        ("unrecognized option '--nonsense'", "directives"),
    ],
)
def test_messages_of_slurm_are_matched_to_the_settings_that_they_concern(words: str, settings: str) -> None:
    assert_about(words, SLURM, settings)


@pytest.mark.parametrize(
    ("words", "settings"),
    [
        ("Unknown queue", "partition"),
        ("Unauthorized Request", "partition account"),
        ("Invalid account", "account"),
        ("Job violates queue and/or server resource limits", "partition cpus memory gpus constraint wall array_tasks"),
        (
            "Can Never Run: Insufficient amount of resource: ncpus (R: 99 A: 4 T: 4)",
            "partition cpus memory gpus constraint wall array_tasks",
        ),
        ("Job exceeds queue resource limits MSG=cannot satisfy queue max walltime requirement", "partition wall"),
        ("illegal -J value", "array_tasks"),
        ("Array job exceeds server or queue size limit", "array_tasks"),
        ("Unknown resource type  Resource_List.mempo", "gpus constraint directives"),
        ("Unknown resource: ngpus", "gpus constraint directives"),
    ],
)
def test_messages_of_pbs_are_matched_to_the_settings_that_they_concern(words: str, settings: str) -> None:
    assert_about(words, PBS, settings)


def test_an_unknown_message_is_reported_unchanged() -> None:
    assert about("slurm is tired", SLURM, ALL, lambda: ["partition debug"]) == "slurm is tired"


@pytest.mark.integration
@pytest.mark.parametrize(
    ("table", "words"),
    [
        (
            "cpus = 99",
            r"PartitionConfig: no node of the partition can satisfy the whole request; requested: cpus = 99; the site has",
        ),
        pytest.param(
            'constraint = "slow"',
            r"Invalid feature specification: .*; requested: constraint = 'slow'; the site has",
            marks=pytest.mark.nightly,
        ),
        pytest.param(
            'partition = "closed"',
            r"account.*: not available to the account; requested: partition = 'closed'; the site has partition closed",
            marks=pytest.mark.nightly,
        ),
        ('memory = "1 TB"', r"Memory specification.*; requested: memory = 1000 GB; the site has"),
    ],
)
def test_refusals_of_slurm_name_the_requested_settings_and_the_sites_resources(
    tmp_path: Path, slurm: Slurm, table: str, words: str
) -> None:
    root = projects.make(tmp_path / "project", f"{projects.CONFIG}[runners.slurm]\n{table}\n")
    done = projects.sierra(root, "run", "noise=1", "--on", "slurm", "--no-figures")
    assert done.returncode in (2, 3)
    [line] = [line for line in done.stderr.splitlines() if line.startswith("sierra: ")]
    assert re.search(words, line), line
    assert SITE in line or "closed" in table


@pytest.mark.nightly
def test_status_reports_the_same_for_a_detached_batch(tmp_path: Path, slurm: Slurm) -> None:
    root = projects.make(tmp_path / "project", f"{projects.CONFIG}[runners.slurm]\ncpus = 99\n")
    assert projects.sierra(root, "run", "noise=1", "--on", "slurm", "--detach").returncode == 0
    told = projects.sierra(root, "status").stdout
    assert re.search(r"cannot start: PartitionConfig: .*; requested: cpus = 99, wall = 3600; the site has", told), told


def test_refusals_of_pbs_name_the_requested_settings_and_the_sites_resources(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, request_of: Callable[[Path], Request]
) -> None:
    server = pbs.Server(tmp_path / "pbs")
    monkeypatch.setenv("PATH", str(server.bin), prepend=os.pathsep)
    with pytest.raises(ConfigError, match=r"Unknown queue.*; requested: partition = 'nowhere'; the site has queues workq"):
        Pbs(ClusterTable(partition="nowhere")).submit(request_of(tmp_path))


@pytest.fixture
def request_of() -> Callable[[Path], Request]:
    return lambda folder: Request("sierra-1", "", (0,), folder, folder, ("true",))
