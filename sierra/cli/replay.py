"""`sierra replay`: execute recorded runs again and compare the results."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sierra.cli.arguments import AsJson, Jobs, Runner, ShownId
from sierra.cli.output import cell, print_json, readable, table
from sierra.cli.render_columns import column_lines, volatile_lines
from sierra.errors import Missing, UsageError
from sierra.util.text import few

if TYPE_CHECKING:
    from sierra.config.output_tables import Output, Tolerance
    from sierra.replay.compare_values import Agreement, Verdict
    from sierra.replay.verdicts import Compared, OfExperiment, Replay

SHOWN = 3


def replay(
    prefix: ShownId = None,
    runs: Annotated[
        int | None, typer.Option("--runs", metavar="K", min=1, help="Only the first K runs of each experiment.")
    ] = None,
    jobs: Jobs = None,
    runner: Runner = "local",
    engine: Annotated[
        str | None,
        typer.Option("--engine", metavar="ENGINE", help="Container engine: podman, apptainer, none (default: as recorded)."),
    ] = None,
    set_tolerance: Annotated[
        list[str] | None,
        typer.Option(
            metavar="[OUTPUT.]COLUMN=KIND:X",
            help="Allowed difference of a column: abs, rel or ulp. `*` means every column. May be repeated.",
        ),
    ] = None,
    keep: Annotated[
        bool, typer.Option("--keep", help="Keep the restored source and the runs' folders, and print their path.")
    ] = False,
    no_record: Annotated[bool, typer.Option("--no-record", help="Write nothing to the store, which may be read-only.")] = False,
    yes: Annotated[
        bool, typer.Option("--yes", help="Let robots of supervised trials move without a person, one run after the other.")
    ] = False,
    as_json: AsJson = False,
    junit: Annotated[Path | None, typer.Option("--junit", metavar="FILE", help="Also write the verdicts as JUnit XML.")] = None,
) -> None:
    """Execute recorded runs again, and compare the results.

    A replay uses only the record: the source is restored to a separate folder, and inputs come from the store. Each output is
    identical (same bytes), equal (same values), within tolerance (as declared in sierra.toml), or different. For a different
    output, the place and the size of the difference are printed. An experiment whose runs have different values is equivalent
    if the metrics of [equivalence] are equivalent over all its runs. The exit code is 0 if nothing is different or failed.

    \b
    Examples:
      sierra replay
      sierra replay 9e1c
      sierra replay 9e1c --runs 2 --json
      sierra replay 9e1c --set-tolerance swarm.coverage=rel:1e-9
      sierra replay 9e1c --on slurm
      sierra replay 9e1c --junit replay.xml --keep
      sierra replay 9e1c --no-record
    """
    from sierra.cli import junit as junit_file
    from sierra.cli import open_project
    from sierra.cli.progress import watching

    requested = tolerances(set_tolerance or ())
    project = open_project.project()
    if junit is not None and not junit.parent.is_dir():
        raise Missing(f"{junit}: the folder {junit.parent} does not exist")
    chosen = open_project.given_or_last(prefix, project)
    with watching(quiet=as_json) as display:
        answer = project.replay(
            chosen,
            runs=runs,
            jobs=jobs,
            runner=runner,
            engine=engine,
            tolerances=requested,
            keep=keep,
            record=not no_record,
            unattended=yes,
            observer=None if as_json else display,
        )
    if junit is not None and not answer.interrupted:
        junit_file.write(answer, junit)
    if as_json:
        print_json(_answer(answer))
    else:
        _print(answer, project.config.outputs)
    if answer.interrupted:
        raise typer.Exit(130)
    if not answer.verdict.fine:
        raise typer.Exit(1)


def tolerances(texts: Iterable[str]) -> dict[str, dict[str, Tolerance]]:
    """Return tolerances by output and column, from `[OUTPUT.]COLUMN=KIND:X[,KIND:X]`. Raises UsageError."""
    from sierra.config.output_tables import Tolerance
    from sierra.config.validate import options

    by_output: dict[str, dict[str, Tolerance]] = {}
    for text in texts:
        target, _, values = text.rpartition("=")
        output, _, column = target.rpartition(".") if "." in target else ("*", "", target)
        try:
            kinds = {kind.strip(): float(number) for kind, _, number in (part.partition(":") for part in values.split(","))}
        except ValueError:
            kinds = {}
        if not (output and column and kinds):
            raise UsageError(f"--set-tolerance {text!r}: write it as COLUMN=rel:1e-9 or OUTPUT.COLUMN=abs:0.1,ulp:4")
        by_output.setdefault(output, {})[column] = options(Tolerance, kinds, f"--set-tolerance {text!r}")
    return by_output


def _answer(answer: Replay) -> dict[str, object]:
    return {
        "replay": answer.id,
        "kind": answer.found.kind,
        "target": answer.found.id,
        "verdict": None if answer.interrupted else answer.verdict,
        "runs": len(answer.runs),
        "of": answer.of,
        "counts": {str(verdict): count for verdict, count in answer.counts.items()},
        "by_output": answer.outputs,
        "notes": list(answer.notes),
        "interrupted": answer.interrupted,
        "kept": answer.kept,
        "built": asdict(answer.built) if answer.built else None,
        "same_files": answer.files.same if answer.files else None,
        "used_gpu": answer.used_gpu,
        "experiments": [_experiment(experiment) for experiment in answer.experiments],
        "outputs": [_output(run, path, agreement) for run in answer.runs for path, agreement in run.outputs.items()],
    }


def _experiment(experiment: OfExperiment) -> dict[str, object]:
    return {
        "experiment": experiment.id,
        "values": dict(experiment.values),
        "verdict": experiment.verdict,
        "runs": len(experiment.runs),
        "metrics": [
            {
                "name": metric.name,
                "recorded_mean": metric.recorded_mean,
                "replayed_mean": metric.replayed_mean,
                "reason": metric.reason,
                **(asdict(metric.tested) if metric.tested else {}),
            }
            for metric in experiment.metrics
        ],
    }


def _output(run: Compared, path: str | None, found: Agreement) -> dict[str, object]:
    return {
        "run": run.taken.run,
        "experiment": run.taken.experiment,
        "number": run.taken.number,
        "path": path,
        **asdict(found),
    }


def _print(answer: Replay, outputs: Mapping[str, Output]) -> None:
    from sierra.replay.same_files import GPU_ADVICE
    from sierra.util.hashing import short

    if answer.interrupted:
        print("interrupted: nothing was compared")
        return
    for (verdict, path), alike in _alike(answer).items():
        _print_outputs(verdict, path, alike)
    for line in volatile_lines(answer, outputs):
        print(readable(line))
    for experiment in answer.experiments:
        for metric in experiment.metrics:
            print(
                f"{'equivalent' if metric.equivalent else 'not shown to be equivalent'}: {_values(experiment)}: {metric.reason}"
            )
    if len(answer.experiments) > 1 and answer.verdict != "identical":
        axes = list(answer.experiments[0].values)
        rows = [[*each.values.values(), len(each.runs), each.verdict] for each in answer.experiments]
        table([*axes, "runs", "verdict"], rows, right=["runs"])
    counts = ", ".join(f"{count} {verdict}" for verdict, count in sorted(answer.counts.items()))
    runs = f"{len(answer.runs)} of {answer.of} runs" if len(answer.runs) < answer.of else _many(answer.of)
    built = f"; built from source: {few(answer.built.products, SHOWN)}" if answer.built else ""
    print(f"{answer.found.kind} {short(answer.found.id)}: {answer.verdict} ({runs}: {counts}{built})")
    if answer.verdict == "different" and not answer.notes:
        print(f"the recorded code, inputs and machine, {answer.files.words if answer.files else 'and the image, are the same'}")
        print("the cause is randomness, the clock, threads, or something that is not recorded;")
        print("declare allowed differences in [outputs] or [equivalence]")
    if answer.used_gpu:
        print(GPU_ADVICE)
    if answer.kept:
        print(f"kept: {answer.kept}")


def _many(runs: int) -> str:
    return "1 run" if runs == 1 else f"{runs} runs"


def _values(experiment: OfExperiment) -> str:
    return ", ".join(f"{name}={value}" for name, value in experiment.values.items())


def _alike(answer: Replay) -> dict[tuple[Verdict, str | None], list[tuple[Compared, Agreement]]]:
    """Return the outputs that are not identical, by verdict and path, the worst verdict first."""
    from sierra.replay.compare_values import Verdict

    order = list(Verdict)
    alike: dict[tuple[Verdict, str | None], list[tuple[Compared, Agreement]]] = {}
    for run in answer.runs:
        for path, agreement in run.outputs.items():
            if agreement.verdict != "identical":
                alike.setdefault((agreement.verdict, path), []).append((run, agreement))
    return dict(sorted(alike.items(), key=lambda item: (-order.index(item[0][0]), item[0][1] or "")))


def _print_outputs(verdict: Verdict, path: str | None, alike: Sequence[tuple[Compared, Agreement]]) -> None:
    """Print some runs in which one output has the same verdict; one run is enough if the verdict is fine."""
    from sierra.util.hashing import short

    shown = alike[: 1 if verdict.fine else SHOWN]
    for run, agreement in shown:
        where = f" {path}" if path else ""
        print(readable(f"{verdict}: run {short(run.taken.run)} (number {run.taken.number}){where}: {agreement.reason}"))
        if agreement.growth and not verdict.fine and run is alike[0][0]:
            print(f"    {_grown(agreement)}")
    if more := len(alike) - len(shown):
        print(readable(f"{verdict}: {path or 'as a whole'} of {more} more run{'s' * (more > 1)} (--json has them all)"))
    if verdict in ("different", "within tolerance"):
        for line in column_lines([agreement for _, agreement in alike]):
            print(f"    {readable(line)}")


def _grown(agreement: Agreement) -> str:
    """Return a description of the growth of a difference, from where it begins."""
    from itertools import dropwhile

    from sierra.replay.compare_values import distance

    apart = list(dropwhile(lambda part: part[1] == 0, agreement.growth))
    same = agreement.growth[: len(agreement.growth) - len(apart)]
    before = [f"equal until {cell(same[-1][0])}"] if same else []
    return ", ".join([*before, f"difference {', '.join(f'{distance(far)} until {cell(until)}' for until, far in apart)}"])
