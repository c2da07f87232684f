"""The worker lends devices to runs: whole ones or shares, to as many runs at a time as they suffice for."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from functools import partial
from typing import Any

import pytest

from sierra.worker.devices import CDI_MARK, NoDevices, Pool, requested, runs_at_once, with_leased
from tests.waiting import PATIENCE_S

TWO = {"CUDA_VISIBLE_DEVICES": "0,3"}


def going_on() -> bool:
    return False


def taken(pool: Pool, gpus: float) -> list[tuple[str, ...]]:
    """Take devices until one would have to wait; return those of each lease."""
    leases: list[tuple[str, ...]] = []
    while lease := pool.take(gpus, partial(next, iter((False, True)))):
        leases.append(lease.ids)
    return leases


@pytest.mark.parametrize(
    ("variables", "gpus", "leases"),
    [
        (TWO, 1.0, [("0",), ("3",)]),
        (TWO, 2.0, [("0", "3")]),
        (TWO, 0.5, [("0",), ("3",), ("0",), ("3",)]),
        (TWO, 0.6, [("0",), ("3",)]),
        ({"CUDA_VISIBLE_DEVICES": "0,1,2"}, 2.0, [("0", "1")]),
        ({"CUDA_VISIBLE_DEVICES": "GPU-1f"}, 1 / 3, [("GPU-1f",)] * 3),
        ({"CUDA_VISIBLE_DEVICES": "MIG-5a"}, 0.1, [("MIG-5a",)] * 10),
        ({"ROCR_VISIBLE_DEVICES": "1", "NVIDIA_VISIBLE_DEVICES": "all"}, 1.0, [("1",)]),
    ],
)
def test_devices_suffice_for_so_many_runs(variables: Mapping[str, str], gpus: float, leases: list[tuple[str, ...]]) -> None:
    assert taken(Pool(variables), gpus) == leases
    count = len(next(iter(variables.values())).split(","))
    assert runs_at_once(count, gpus) == len(leases)


@pytest.mark.parametrize("listed", ["", "-1", "NoDevFiles", "void"])
def test_a_run_without_any_device_fails(listed: str) -> None:
    with pytest.raises(NoDevices, match=r"\[limits\] gpus = 0.5, but no GPU is listed in CUDA_VISIBLE_DEVICES or ROCR"):
        Pool({"CUDA_VISIBLE_DEVICES": listed}).take(0.5, going_on)


def test_a_run_that_requests_more_devices_than_there_are_fails() -> None:
    with pytest.raises(NoDevices, match=r"\[limits\] gpus = 3, but 2 GPUs are listed"):
        Pool(TWO).take(3.0, going_on)


def test_a_run_waits_for_the_devices_of_another_and_a_later_one_does_not_overtake_it() -> None:
    pool, order = Pool(TWO), []
    first, second = pool.take(1.0, going_on), pool.take(1.0, going_on)
    assert first is not None
    assert second is not None

    def wait(gpus: float, asked: threading.Event) -> None:
        if pool.take(gpus, lambda: asked.set() is not None):
            order.append(gpus)

    asked = threading.Event()
    both = threading.Thread(target=wait, args=(2.0, asked))
    both.start()
    assert asked.wait(PATIENCE_S)
    later = threading.Thread(target=wait, args=(0.5, threading.Event()))
    later.start()
    pool.give_back(first)
    assert order == []
    pool.give_back(second)
    both.join()
    assert order == [2.0]
    pool.give_back(first)
    later.join()
    assert order == [2.0, 0.5]


def test_a_worker_that_stops_lends_nothing() -> None:
    pool = Pool(TWO)
    pool.take(2.0, going_on)
    assert pool.take(1.0, lambda: True) is None


def job(environment: Mapping[str, str], gpus: float, **more: Any) -> Any:
    return {"environment": {**environment, **requested(environment, gpus)}, "limits": {"gpus": gpus}, **more}


def leased(job: Any, variables: Mapping[str, str] = TWO) -> Any:
    lease = Pool(variables).take(job["limits"]["gpus"], going_on)
    assert lease is not None
    return with_leased(job, lease)


def test_a_run_with_a_share_reserves_only_its_part_of_the_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("CUDA_DEVICE_ORDER", raising=False)
    assert leased(job({"A": "1"}, 0.25))["environment"] == {
        "A": "1",
        "CUDA_VISIBLE_DEVICES": "0",
        "CUDA_DEVICE_ORDER": "PCI_BUS_ID",
        "XLA_PYTHON_CLIENT_MEM_FRACTION": "0.225",
    }
    assert "XLA_PYTHON_CLIENT_MEM_FRACTION" not in leased(job({}, 1.0))["environment"]


@pytest.mark.parametrize("name", ["XLA_PYTHON_CLIENT_MEM_FRACTION", "XLA_CLIENT_MEM_FRACTION"])
def test_a_declared_part_of_the_memory_stays(name: str) -> None:
    fractions = {
        variable: value for variable, value in leased(job({name: ".1"}, 0.5))["environment"].items() if "FRACTION" in variable
    }
    assert fractions == {name: ".1"}


def test_a_container_that_has_only_the_devices_of_its_run_counts_them_from_0() -> None:
    client = {"argv": ["podman", f"--device=nvidia.com/gpu={CDI_MARK}", "--env=CUDA_VISIBLE_DEVICES=\1CUDA_VISIBLE_DEVICES"]}
    filled = leased(job({}, 2.0, client={**client, "environment": {}}))
    words = ["podman", "--device=nvidia.com/gpu=0", "--device=nvidia.com/gpu=3", "--env=CUDA_VISIBLE_DEVICES=0,1"]
    assert filled["client"]["argv"] == words
    assert filled["environment"]["CUDA_VISIBLE_DEVICES"] == "0,1"
    assert filled["gpus"] == ["0", "3"]
