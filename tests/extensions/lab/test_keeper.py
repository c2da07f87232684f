"""The GPUs that the slots of a host get."""

from __future__ import annotations

import pytest

from sierra.extensions.lab.agent.keeper import with_gpus_of
from sierra.worker import gpus


@pytest.mark.parametrize(
    ("wanted", "lists"),
    [(1.0, ["0", "1", "0", "1"]), (0.5, ["0", "1", "0", "1"]), (2.0, ["0,1", ""]), (0.0, ["0,1", "0,1"])],
)
def test_each_slot_has_gpus_of_its_own(wanted: float, lists: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gpus, "of_this_machine", lambda environment: gpus.Gpus("CUDA_VISIBLE_DEVICES", ("0", "1")))
    given = {"CUDA_VISIBLE_DEVICES": "0,1", "PATH": "/usr/bin"}
    slots = [with_gpus_of(slot, wanted, given) for slot in range(len(lists))]
    assert [variables["CUDA_VISIBLE_DEVICES"] for variables in slots] == lists
    assert all(variables["PATH"] == "/usr/bin" for variables in slots)


def test_a_host_without_gpus_shows_none(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gpus, "of_this_machine", lambda environment: gpus.Gpus("CUDA_VISIBLE_DEVICES", ()))
    assert with_gpus_of(0, 1.0, {})["CUDA_VISIBLE_DEVICES"] == ""
