"""Verdicts as JUnit XML for continuous integration: a test suite for each experiment, a test case for each run."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING
from xml.etree import ElementTree as ET

from sierra.cli.output import readable

if TYPE_CHECKING:
    from sierra.replay.verdicts import Compared, OfExperiment, Replay


def write(answer: Replay, file: Path) -> None:
    """Write the verdicts of a replay to a file. Raises OSError."""
    root = ET.Element("testsuites", name="sierra replay")
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
