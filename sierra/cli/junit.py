"""Verdicts as JUnit XML for continuous integration.

A replay has a test suite for each experiment, and a test case for each run. Others have one test suite, with a test case for
each claim or comparison. One that is refuted is a failure, one that can't be told is an error.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal, NamedTuple
from xml.etree import ElementTree as ET

from sierra.cli.output import readable
from sierra.errors import Missing

if TYPE_CHECKING:
    from sierra.packages.reproduction.outcome import Reproduction
    from sierra.replay.verdicts import Compared, OfExperiment, Replay


def write(answer: Replay, file: Path) -> None:
    """Write the verdicts of a replay to a file. Raises OSError."""
    root = ET.Element("testsuites", name="sierra replay")
    _add_replay(root, answer)
    _save(root, file)


def write_reproduction(done: Reproduction, cases: Sequence[Case], file: Path) -> None:
    """Write the verdicts of a reproduction: the suites of its replays, then that of its claims, `cases`. Raises OSError."""
    root = ET.Element("testsuites", name="sierra reproduce")
    for batch in done.batches:
        if batch.replay is not None:
            _add_replay(root, batch.replay)
        else:
            suite = ET.SubElement(root, "testsuite", name=f"batch {batch.planned.batch[:10]}", tests="1")
            suite.set("errors" if batch.lacking else "skipped", "1")
            case = ET.SubElement(suite, "testcase", classname="batches", name=batch.planned.batch[:10])
            ET.SubElement(case, "error" if batch.lacking else "skipped", message=readable(batch.reason))
    if cases:
        _add_cases(root, "claims", cases)
    _save(root, file)


def _add_replay(root: ET.Element, answer: Replay) -> None:
    for experiment in answer.experiments:
        bad = [run for run in experiment.runs if not experiment.verdict.fine and not run.verdict.fine]
        failed = sum(run.verdict == "failed" for run in bad)
        suite = ET.SubElement(root, "testsuite", name=called(experiment))
        for name, count in (("tests", len(experiment.runs)), ("failures", len(bad) - failed), ("errors", failed)):
            suite.set(name, str(count))
        for run in experiment.runs:
            case = ET.SubElement(suite, "testcase", classname=called(experiment), name=f"run {run.taken.number}")
            if run in bad:
                element = ET.SubElement(case, "error" if run.verdict == "failed" else "failure", message=str(run.verdict))
                element.text = "\n".join(_lines(run, experiment))
            else:
                ET.SubElement(case, "system-out").text = "\n".join(_lines(run, experiment))


class Case(NamedTuple):
    """A test case: `outcome` is the element of one that did not pass, and `message` its verdict."""

    name: str
    outcome: Literal["", "failure", "error"]
    message: str
    lines: tuple[str, ...]


def write_cases(name: str, cases: Sequence[Case], file: Path) -> None:
    """Write the cases of one test suite to a file. Raises Missing."""
    root = ET.Element("testsuites", name=f"sierra {name}")
    _add_cases(root, name, cases)
    try:
        _save(root, file)
    except OSError as error:
        raise Missing(f"{file}: cannot be written: {error.strerror}") from error


def _add_cases(root: ET.Element, name: str, cases: Sequence[Case]) -> None:
    suite = ET.SubElement(root, "testsuite", name=name, tests=str(len(cases)))
    for outcome in ("failure", "error"):
        suite.set(f"{outcome}s", str(sum(case.outcome == outcome for case in cases)))
    for case in cases:
        element = ET.SubElement(suite, "testcase", classname=name, name=readable(case.name))
        part = ET.SubElement(element, case.outcome or "system-out", {"message": case.message} if case.outcome else {})
        part.text = "\n".join(map(readable, case.lines))


def _save(root: ET.Element, file: Path) -> None:
    ET.indent(root)
    file.write_bytes(ET.tostring(root, encoding="utf-8", xml_declaration=True) + b"\n")


def called(experiment: OfExperiment) -> str:
    """Return a name for an experiment: the values of its axes, or a prefix of its id."""
    return ", ".join(f"{name}={value}" for name, value in experiment.values.items()) or experiment.id[:10]


def _lines(run: Compared, experiment: OfExperiment) -> Iterator[str]:
    for path, agreement in run.outputs.items():
        yield readable(f"{path or 'run'}: {agreement.verdict}{f': {agreement.reason}' if agreement.reason else ''}")
    for metric in experiment.metrics:
        yield readable(metric.reason)
