"""`REPRODUCING.md`: the first text that an evaluator reads, made from the description of the package."""

from __future__ import annotations

import math
import shlex
from collections.abc import Iterable, Iterator, Mapping

from sierra.packages.layout import CRATE, INSTRUCTIONS, OWN_REQUIREMENTS, PROGRAM, README, REQUIREMENTS, SIERRA, WHEELS
from sierra.packages.manifest import PackageManifest, PackedBatch
from sierra.packages.members import MANIFEST
from sierra.packages.needs import Machine
from sierra.packages.subject import Member
from sierra.util.lazy_definitions import regex
from sierra.util.quoted_values import words
from sierra.util.text import counted, one_line, size

QUICK_S = 600
"""The time in seconds that a first look may take."""
SPARE, SLOWER = 2, "half the"
"""An evaluator's machine may be slower by this factor."""
HOUR_S, MINUTE_S = 3600, 60
ABOUT = """SIERRA executes experiments, and records each run with its code, inputs, environment and outputs. It executes
recorded runs again, compares the results, and decides the claims of a paper by them."""
VENV = "reproduction/venv"
PIP = f"python3 -m venv {VENV}\n{VENV}/bin/pip install"
DIFFERENCES = """
| verdict | meaning |
|---|---|
| identical | the same bytes as recorded |
| same values | other bytes, but each value is the same |
| within tolerance | values differ by no more than `sierra.toml` allows |
| equivalent | values differ, but the metrics that `sierra.toml` names are statistically equivalent over all runs |
| different | values differ: the command ends with exit status 1 |

Another processor or another version of a library may change the last digits of floating-point numbers, and chaotic simulations
amplify such differences. In the recorded image, on the same kind of processor, all bytes should be the same unless the runs are
not deterministic. In a copy of `project/`, `sierra why BATCH` shows how a batch differs from the project as it is.
"""
PLACES = {
    "README.md": "the text that archives show",
    "reproduce.py": "verifies the package, and tells what is needed to execute it",
    "package.json": "this description for programs, with the measured needs",
    "manifest-sha256.txt": "the SHA-256 of all files",
    "ro-crate-metadata.json": "the description as a Provenance Run Crate",
    "report.html": "what the records say, with figures, claims and failures, as one page for a browser",
    "project/": "the project: `sierra.toml`, templates and source",
    "project/.sierra/": "the records: inputs, outputs, environments and logs of all runs",
    "source/": "other sources than that of the newest batch, and the history of commits as a git bundle",
    "figures/": "figures, tables and videos as they were made",
    "execution/": "what `reproduce.py` executes without SIERRA",
    "environment/": "descriptions of the environment: files of the machine, image, SIERRA, wheels",
}


def member(described: PackageManifest, members: Mapping[str, Member]) -> Member:
    """Return the text for a package with these other members."""
    lines = "\n".join(_lines(described, members)).rstrip("\n") + "\n"
    return Member(INSTRUCTIONS, lines.encode(), "instructions for evaluators")


def _lines(described: PackageManifest, members: Mapping[str, Member]) -> Iterator[str]:
    yield f"# {_text(described.title)}\n"
    measured = [batch.needs.seconds for batch in described.batches if batch.needs]
    yield from beginning(described.sierra, members, sum(measured) if measured else None)
    yield "\nThis package has all that is needed to check the results below."
    if described.redacted:
        yield "\nIt is anonymous, for review: hosts, folders, commits and times in its records are not the original ones."
    yield "\n## Results\n"
    yield "| batch | research query | experiments | runs | successful |\n|---|---|---|---|---|"
    for batch in described.batches:
        numbers = f"{batch.experiments:,} | {batch.runs:,} | {batch.successful:,}"
        yield f"| `{batch.batch[:10]}` | `{_text(batch.query)}` | {numbers} |"
    yield ""
    yield from (f"- {_text(note)}" for note in described.notes)
    yield from _claims(described)
    yield "\n## Needs\n"
    yield from _needs(described, members)
    yield "\n## First look\n"
    yield from _quick_check(described.batches)
    yield "\n## Full evaluation\n"
    yield from _full(described.batches)
    yield "\n## Differences that may occur"
    yield DIFFERENCES
    yield "## Contents\n"
    there = (*members, README, CRATE, MANIFEST)
    yield from (f"- `{name}`: {about}" for name, about in PLACES.items() if any(path.startswith(name) for path in there))
    yield "\n## Other parameters\n"
    yield "A copy of `project/` is an ordinary project of SIERRA. In it, `sierra run` executes a query; other values make new"
    yield "runs."
    yield "In `project/` itself, commands write to the store, and the package would no longer be verified:\n"
    copy = "mkdir -p reproduction\ncp -r project reproduction/project\ncd reproduction/project"
    yield f"```sh\n{copy}\nsierra run {shlex.join(words(one_line(described.batches[0].query)))}\n```"


def beginning(version: str, members: Mapping[str, Member], seconds: float | None = None) -> Iterator[str]:
    """Yield the commands that need nothing but Python, each level with what it proves, and how SIERRA is installed.

    `seconds`: the measured time of all runs; None if it is not known.
    """
    yield f"```sh\npython3 {PROGRAM}\npython3 {PROGRAM} --execute --yes\n```\n"
    if fitting := _fitting(members):
        yield f"The wheels in `{WHEELS}` are for {fitting}. For another Python, installing SIERRA needs a network.\n"
    yield "The first command checks all files of the package. It needs nothing but Python 3.8 or newer, and executes nothing of"
    yield "the package. The second one also executes its runs again, at the highest level that this machine allows:\n"
    long = "" if seconds is None else f"; {_time(SPARE * seconds)} on one core of {SLOWER} speed"
    yield "| level | command | time | shows that |\n|---|---|---|---|"
    yield f"| 1 | `python3 {PROGRAM}` | seconds | all files are those that the authors listed |"
    yield f"| 2 | `python3 {PROGRAM} --execute --level 2` | all runs{long} | the packed code gives the same bytes again |"
    yield f"| 3 | `sierra reproduce .` | all runs{long} | values within tolerances, figures and claims follow again |"
    yield f"\n{ABOUT}\n"
    yield f"SIERRA {version} wrote this package. To install it for Python 3.11 or newer, in the extracted package:\n"
    if any(name.startswith(WHEELS) for name in members):
        yield f"- without a network, for the versions of Python and the processors that `{WHEELS}` has:\n"
        places = " ".join(f"--find-links {folder.rstrip('/')}" for folder in (WHEELS, SIERRA))
        yield _sh(f"{PIP} --no-index {places} --require-hashes -r {REQUIREMENTS}")
        yield "- for others, with a network:\n"
    yield _sh(f"{PIP} {_installed(version, members)}")
    yield f"The command `sierra` is then `{VENV}/bin/sierra`."


FOR_ONE = regex(r"-cp3(\d{1,2})-cp3\d{1,2}-\S*?_(x86_64|aarch64)\.whl")
"""The end of the name of a wheel for one version of Python and one processor."""


def _fitting(members: Iterable[str]) -> str:
    """Return the Pythons and processors for which a package has wheels, in words; "" if none is for a certain one."""
    targets = sorted({(int(match[1]), match[2]) for name in members if (match := FOR_ONE.search(name))})
    return " and ".join(f"Python 3.{minor} on {machine}" for minor, machine in targets)


def _installed(version: str, members: Mapping[str, Member]) -> str:
    """Return what pip installs with a network: SIERRA's own wheel and the locked packages, as far as the package has them."""
    wheel = next((name for name in members if name.startswith(SIERRA) and name.endswith(".whl")), None)
    if wheel is None:
        return f"sierra-experiments=={version}"
    locked = members[OWN_REQUIREMENTS].content
    return f"--require-hashes -r {OWN_REQUIREMENTS}" if isinstance(locked, bytes) and b"==" in locked else wheel


def _sh(commands: str) -> str:
    return f"```sh\n{commands}\n```\n"


def _claims(described: PackageManifest) -> Iterator[str]:
    """Yield the claims with their verdicts on the recorded data, and commands that decide them again."""
    if described.claims:
        yield "\n## Claims\n"
        yield "| claim | in the paper | registered | recorded verdict | command | time |\n|---|---|---|---|---|---|"
        for claim in described.claims:
            last = (f"`sierra reproduce . --claim {claim.name}`", _time(SPARE * claim.seconds)) if claim.batches else ("–", "–")
            texts = map(_text, (claim.says, claim.shown, claim.registration))
            cells = (*texts, f"{claim.verdict}: {_text(claim.text)}", *last)
            yield f"| {' | '.join(cells)} |"
        yield f"\nEach command executes the runs behind a claim again. The time is that of one core of {SLOWER} speed."
        yield "In a copy of `project/`, `sierra claims` decides claims about the source there by the recorded data, in seconds."


def _needs(described: PackageManifest, members: Mapping[str, Member]) -> Iterator[str]:
    """Yield the needs as they were measured."""
    content = sum(member.size for member in members.values())
    measured = [batch.needs for batch in described.batches if batch.needs]
    yield f"- disk: {size(content)} for the extracted package, and about as much again for new results"
    if memory := max((needs.memory or 0 for needs in measured), default=0):
        yield f"- memory: {size(memory)} for each run that is executed at the same time (measured)"
    if measured:
        total = sum(needs.seconds for needs in measured)
        longest = max(needs.longest for needs in measured)
        yield f"- time: {_time(total)} for all runs one after the other; the longest took {_time(longest)} (measured)"
    yield f"- network: {_network(members)}"
    yield from (f"- measured on: {_machine(machine)}" for machine in described.machines)


def _network(members: Mapping[str, Member]) -> str:
    """Return the steps that need a network: only the installation, unless the package has all wheels."""
    if any(name.startswith(WHEELS) for name in members):
        return f"none; only to install SIERRA for another Python or processor than those of `{WHEELS}`, pip fetches packages"
    return "only to install SIERRA, for which pip fetches packages; none to check the package and to execute its runs"


def _machine(machine: Machine) -> str:
    processor = " with ".join(filter(None, (machine.cpu, counted(machine.cores, "core") if machine.cores else None)))
    memory = f"{size(machine.memory)} of memory" if machine.memory else None
    image = f"in the image {machine.image[:19]}" if machine.image else None
    parts = filter(None, (processor, machine.architecture, memory, machine.os, *machine.gpus, image))
    return _text(", ".join(parts)) or "a machine that was not recorded"


def _quick_check(batches: tuple[PackedBatch, ...]) -> Iterator[str]:
    """Yield how to check the files, and the shortest run of each experiment, within a short time."""
    yield f"Check the files by `python3 {PROGRAM}`, which takes seconds. Then execute a few runs of each batch again. Both"
    yield "commands state what they execute, and ask first. SIERRA compares values and decides the claims. Without it, bytes"
    yield "are compared:\n"
    shortest = SPARE * sum(batch.needs.shortest for batch in batches if batch.needs)
    yield f"```sh\nsierra reproduce . --budget {QUICK_S // MINUTE_S}m\n```\n"
    yield f"```sh\npython3 reproduce.py --execute --budget {QUICK_S // MINUTE_S}m\n```\n"
    if shortest <= QUICK_S:
        yield f"The shortest run of each experiment takes {_time(shortest)} together, on a machine of {SLOWER} speed."
    else:
        yield f"The shortest run of each experiment would take {_time(shortest)} together: the command says which are left out."


def _full(batches: tuple[PackedBatch, ...]) -> Iterator[str]:
    total = SPARE * sum(batch.needs.seconds for batch in batches if batch.needs)
    yield "```sh\nsierra reproduce .\n```\n"
    yield f"It executes all runs again: {_time(total)} on one core of {SLOWER} speed, less if several run at the same time."
    yield "The exit status is 0 if everything was reproduced, 1 if anything differs, and 3 if something needed is missing."


def _time(seconds: float) -> str:
    """Return a duration, rounded up."""
    if seconds <= MINUTE_S:
        return counted(math.ceil(seconds), "second")
    if seconds <= HOUR_S:
        return counted(math.ceil(seconds / MINUTE_S), "minute")
    return counted(math.ceil(seconds / HOUR_S), "hour")


def _text(text: str) -> str:
    """Return a text on one line that ends no cell and no code."""
    return one_line(text).replace("|", "\\|").replace("`", "'")
