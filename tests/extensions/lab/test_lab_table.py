"""Lists of hosts, and the division of batches into shares."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sierra.errors import ConfigError
from sierra.extensions.lab.lab_table import Host, LabTable, host_of, sizes
from sierra.runners import schedulers


@pytest.mark.parametrize(
    ("text", "name", "slots"),
    [
        ("pc1", "pc1", None),
        ("pc2:8", "pc2", 8),
        ("8/pc2", "pc2", 8),
        ("user@pc2", "user@pc2", None),
        ("user@pc2:2222", "user@pc2:2222", None),
        (" 4/user@pc2:2222 ", "user@pc2:2222", 4),
    ],
)
def test_a_host_may_name_its_number_of_runs_at_a_time(text: str, name: str, slots: int | None) -> None:
    assert host_of(text) == Host(name, slots)


@pytest.mark.parametrize("text", [":", "@group", "pc1:0", "-oProxyCommand=x", "pc 1", "ssh -p 22 pc1", "8/", ""])
def test_a_text_that_names_no_host_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match=r"names no host|0 runs at a time"):
        host_of(text)


def test_a_file_lists_hosts_as_gnu_parallel_does(tmp_path: Path) -> None:
    hosts = tmp_path / "hosts"
    hosts.write_text("# the lab\n8/pc1\n\npc2  # at the window\n")
    assert list(LabTable(hosts=("pc3:2",), hosts_file=str(hosts)).listed().values()) == [
        Host("pc3", 2),
        Host("pc1", 8),
        Host("pc2", None),
    ]


def test_a_wrong_line_of_the_file_is_named(tmp_path: Path) -> None:
    hosts = tmp_path / "hosts"
    hosts.write_text("pc1\n:\n")
    with pytest.raises(ConfigError, match=r"hosts, line 2: ':' names no host"):
        LabTable(hosts_file=str(hosts)).listed()


def test_a_host_that_is_listed_twice_is_refused() -> None:
    with pytest.raises(ConfigError, match="'pc1' is listed twice"):
        LabTable(hosts=("pc1", "pc1:4")).listed()


def test_a_missing_file_of_hosts_is_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="absent cannot be read: No such file"):
        LabTable(hosts_file=str(tmp_path / "absent")).listed()


@pytest.mark.parametrize(
    ("settings", "complaint"),
    [
        ({}, "a lab needs hosts"),
        ({"hosts": ["pc1"], "partition": "short"}, "partition: a lab has no such setting"),
        ({"hosts": ["pc1"], "cpus": 4}, "cpus: a lab has no such setting"),
        ({"hosts": [":"]}, "names no host"),
        ({"hosts": ["pc1"], "lease": 1}, "lease"),
        ({"hosts": ["pc1"], "folder": "a b"}, "folder"),
    ],
)
def test_a_table_without_hosts_or_with_settings_of_clusters_is_refused(settings: dict[str, object], complaint: str) -> None:
    with pytest.raises(ConfigError, match=complaint):
        schedulers.table("lab", settings, "lab")


@given(st.lists(st.floats(0.001, 1000), max_size=200), st.integers(1, 64))
def test_shares_hold_each_run_once(durations: list[float], slots: int) -> None:
    shares = sizes(sorted(durations, reverse=True), slots)
    assert sum(shares) == len(durations)
    assert all(share > 0 for share in shares)


def test_shares_become_smaller_until_they_are_single_runs() -> None:
    shares = sizes([1.0] * 1000, 16)
    assert list(shares) == sorted(shares, reverse=True)
    assert shares[0] == 32
    assert list(shares[-16:]) == [1] * 16
    assert 90 < len(shares) < 140


def test_a_share_of_long_runs_has_few_of_them() -> None:
    shares = sizes([100.0] * 4 + [1.0] * 400, 4)
    assert list(shares[:4]) == [1, 1, 1, 1]
