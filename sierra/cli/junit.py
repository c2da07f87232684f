"""Verdicts as JUnit XML for continuous integration.

Of a replay: a test suite for each experiment, a test case for each run. Of claims: one test suite, a test case for each claim.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING
from xml.etree import ElementTree as ET

from sierra.cli.output import readable

if TYPE_CHECKING:
    from sierra.deliverables.claims.model import Evaluated
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
    _save(root, file)


def write_claims(claims: Sequence[Evaluated], file: Path) -> None:
    """Write the verdicts on claims to a file: one that does not hold is a failure, one that can't be told an error.

    Raises OSError.
    """
    from sierra.deliverables.claims.model import Verdict

    elements = {Verdict.does_not_hold: "failure", Verdict.cannot_tell: "error"}
    counts = {element: sum(one.verdict is verdict for one in claims) for verdict, element in elements.items()}
    root = ET.Element("testsuites", name="sierra claims")
    suite = ET.SubElement(root, "testsuite", name="claims", tests=str(len(claims)))
    suite.set("failures", str(counts["failure"]))
    suite.set("errors", str(counts["error"]))
    for one in claims:
        case = ET.SubElement(suite, "testcase", classname="claims", name=one.name)
        if one.verdict in elements:
            part = ET.SubElement(case, elements[one.verdict], message=str(one.verdict))
        else:
            part = ET.SubElement(case, "system-out")
        part.text = "\n".join(map(readable, (one.says, one.text, *one.notes, str(one.ground))))
    _save(root, file)


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
