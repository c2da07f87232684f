"""The part `execution/` of a package: the jobs of its runs, for machines where SIERRA is not installed.

The jobs are those of a replay, with marks for the paths of the machine. `sierra.worker.package_plan` describes the files, and
`sierra.worker.execute_runs` executes them. If the runs of a batch need more than that program provides, the plan has the reason
instead of jobs.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from sierra.containers.engines import apptainer, apptainer_ways_to_start, podman, podman_ways_to_start
from sierra.containers.engines.apptainer import SCRIPT, Apptainer
from sierra.containers.engines.base import PROJECT as PROJECT_INSIDE
from sierra.containers.engines.base import ContainerSpec, Mount, run_process
from sierra.containers.engines.podman import Podman
from sierra.containers.images.image import AnyImage, Image
from sierra.errors import DamagedFile, Missing, SierraError
from sierra.execution import commands, plan_from_record, shared_files, targets
from sierra.execution.plan_from_record import LAST, Last, Recalled
from sierra.packages.layout import EXECUTION, EXECUTOR, PLAN, PROJECT
from sierra.packages.members import unsafe
from sierra.packages.parts import recorded_jobs
from sierra.packages.parts.sources import folders
from sierra.packages.subject import Member, PartResult, Subject
from sierra.provenance.dependency_model import Kind
from sierra.provenance.source.manifest import LINK, parts, read
from sierra.store.store import Store
from sierra.util import worker_zip
from sierra.util.fs import inside
from sierra.util.hashing import short
from sierra.util.text import counted
from sierra.worker import package_places, package_plan, program

STARTER = b'''"""Starts the program that executes the runs of this package: `execute_runs` in worker.pyz, beside this file."""

import os
import runpy
import sys

sys.argv.insert(1, "execute_runs")
runpy.run_path(os.path.join(os.path.dirname(os.path.abspath(__file__)), "worker.pyz"), run_name="__main__")
'''
IN_PROJECT = "{project}/"
FILES = (Kind.PROGRAM, Kind.LIBRARY, Kind.FILE)


def members(subject: Subject, packed: Mapping[str, Member]) -> PartResult:
    """Return the programs, the plan, and the jobs of each batch. The reason why a batch has no jobs is a fact."""
    batches = [_Batch(subject, packed, batch) for batch in subject.batches]
    plan = {"format": package_plan.FORMAT, "batches": [part.plan for part in batches]}
    described = Member(PLAN, json.dumps(plan, indent=1).encode() + b"\n", "plan of the runs for execution without SIERRA")
    obstacles = ((part.plan["batch"], part.plan["obstacle"]) for part in batches)
    facts = (f"only SIERRA can execute batch {short(batch)} again: {reason}" for batch, reason in obstacles if reason)
    jobs = (member for part in batches for member in part.members)
    return PartResult([*_programs(), described, *jobs], facts=tuple(facts))


def _programs() -> list[Member]:
    about = "program that executes the runs and compares their outputs; it needs only Python"
    members = [Member(EXECUTOR, STARTER, about), Member(EXECUTION + SCRIPT.name, SCRIPT, about)]
    return [*members, Member(EXECUTION + program.NAME, worker_zip.packed(), about)]


class _Batch:
    """The plan and the files of one batch."""

    def __init__(self, subject: Subject, packed: Mapping[str, Member], batch: str) -> None:
        self._subject = subject
        self._found = packed
        self.members: list[Member] = []
        self.plan: dict[str, Any] = {"batch": batch, "obstacle": ""}
        try:
            self._make(batch)
        except DamagedFile:
            raise
        except SierraError as error:
            self.members = []
            self.plan = {"batch": batch, "obstacle": str(error)}

    def _make(self, batch: str) -> None:
        store = self._subject.store
        [last] = store.select(Last, LAST, b=batch)
        if last.programs is None or last.ingest_rules is None:
            raise Missing("no run was executed")
        recalled = plan_from_record.recall(store, batch, last.programs, last.ingest_rules)
        _check(recalled)
        project = targets.of_batch(self._subject.project, store, batch)
        image = _executed(plan_from_record.image(project, store, recalled.spec), store, batch)
        folder = next((name for name, tree in folders(self._subject).items() if tree.tree == recalled.spec.source), PROJECT)
        self.plan |= {
            "project": folder.rstrip("/"),
            "programs": [
                name[len(folder) :] for name, member in self._found.items() if name.startswith(folder) and member.executable
            ],
            "files": self._files(recalled, folder),
            "beside": self._beside(recalled, folder),
            "needs": _needs(recalled),
            "requires": list(project.config.requires),
            "image": _image(image),
            "clients": {} if image is None else _clients(recalled, image),
            "success": sorted(recalled.success.statuses),
            "notes": _notes(recalled),
        }
        jobs = recorded_jobs.Jobs(store, project, recalled, image)
        self.plan["limits"] = jobs.limits
        path, name = self._subject.folder / f"jobs-{batch[:12]}", f"{EXECUTION}{batch[:12]}.jsonl"
        jobs.write(batch, path)
        if not jobs.runs:
            raise Missing("no run was executed successfully")
        self.plan |= {
            "jobs": name,
            "of": recorded_jobs.count(store, batch),
            "runs": jobs.runs,
            "seconds": round(jobs.seconds, 3),
        }
        self.plan |= {"environment": jobs.environment, "by_value": jobs.by_value, **jobs.patterns}
        self.members.append(Member(name, path, "jobs of the runs of a batch"))

    def _files(self, recalled: Recalled, folder: str) -> dict[str, dict[str, Any]]:
        """Return the project's files that runs used and that the folder lacks, with the members that have them."""
        recorded = {used.name: used.sha256 for used in recalled.programs if used.sha256 and used.kind in FILES}
        files: dict[str, dict[str, Any]] = {}
        for path, sha256 in sorted((recorded | dict(recalled.observed)).items()):
            name = path.removeprefix(IN_PROJECT)
            if name == path or _is(self._found.get(folder + name), sha256):
                continue
            member = self._found.get(PROJECT + name)
            if not _is(member, sha256) and folder + name in self._found and self._subject.store.kept(sha256) is not None:
                member = self._kept(sha256)  # git restores the source with other bytes
            if member is None or not _is(member, sha256):
                raise Missing(f"its runs used {name!r}, which is not packed as it was")
            files[name] = {"member": member.name, "program": member.executable}
        return files

    def _beside(self, recalled: Recalled, folder: str) -> dict[str, dict[str, Any]]:
        """Return the files that lie beside the inputs of runs, with the members that have them."""
        shared = recalled.spec.shared_files
        files: dict[str, dict[str, Any]] = {}
        for row in shared_files.recorded(self._subject.store, shared) if shared else ():
            if reason := unsafe(row.name):
                raise Missing(f"its runs have the file {row.name!a} beside their inputs, but {reason}")
            member = self._found.get(folder + row.name)
            if member is None or not _is(member, row.sha256):
                member = self._kept(row.sha256)
            files[row.name] = {"member": member.name, "program": row.executable}
        return files

    def _kept(self, sha256: str) -> Member:
        """Return a member with a file of the store."""
        path = inside(self._subject.folder, f"beside/{sha256}")
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(self._subject.store.object(sha256))
        member = Member(f"{EXECUTION}beside/{sha256}", path, "file beside the inputs of runs")
        self.members.append(member)
        return member


def _check(recalled: Recalled) -> None:
    """Raise Missing if the runs need more than a folder with the project."""
    spec = recalled.spec
    if spec.robots is not None:
        raise Missing("its runs take robots")
    if any(commands.ABOVE.search(word) for word in (*spec.words, *spec.environment.values())):
        raise Missing("its command uses files outside the project")
    if spec.host_access:
        raise Missing(f"its containers had access to the host ({', '.join(spec.host_access)})")


def _is(member: Member | None, sha256: str) -> bool:
    return member is not None and member.sha256() == sha256


def _needs(recalled: Recalled) -> list[dict[str, str]]:
    """Return the machine's programs that the runs used: names without folders, and versions.

    The interpreter behind a script of the machine (`python3: interpreter`) counts as the script.
    """
    versions: dict[str, str] = {}
    for used in recalled.programs:
        if used.kind == Kind.PROGRAM and not used.name.startswith(IN_PROJECT):
            name = used.program().called.partition(":")[0]
            versions[name] = used.version or versions.get(name, "")
    return [{"name": name, "version": version} for name, version in sorted(versions.items())]


EXECUTED = """
SELECT DISTINCT i.image FROM effective f JOIN executions e USING (execution) JOIN isolations i USING (isolation)
WHERE f.batch = $b
"""


def _executed(image: AnyImage | None, store: Store, batch: str) -> Image | None:
    """Return the image of runs; of images for several processors, the one in which they were executed. Raises Missing."""
    if image is None or isinstance(image, Image):
        return image
    used = store.values(str, EXECUTED, b=batch)
    if len(used) != 1:
        raise Missing(f"its runs were executed in {len(used)} of the images {image.name}, one for each processor")
    return next(variant for variant in image.known.values() if variant.id == used[0])


def _image(image: Image | None) -> dict[str, str] | None:
    """Return the image that engines need; it has a name only if it can be pulled by it."""
    if image is None:
        return None
    return {"id": image.id, "kind": image.kind, "name": "" if image.file else image.name, "architecture": image.architecture}


def _clients(recalled: Recalled, image: Image) -> dict[str, dict[str, Any]]:
    """Return the commands by which engines start a container for a run, with the marks of `package_places`."""
    conducting = commands.CONDUCTING if recalled.spec.around else ()
    mounts = [Mount(package_places.SOURCE, PROJECT_INSIDE)]
    mounts += [Mount(f"{package_places.HERE}/{program.NAME}", commands.PROGRAM)] if conducting else []
    process = run_process((*conducting, package_places.COMMAND), {package_places.VARIABLE: package_places.VALUE}, *mounts)
    box = ContainerSpec(image, package_places.IMAGE, session="package")
    start = apptainer_ways_to_start.Launcher(Apptainer.name, "", mapped=False, squashfs=True)
    packed = f"{package_places.HERE}/{SCRIPT.name}"
    return {
        Podman.name: {
            "argv": podman.words(box, process, (package_places.WAY,)),
            "environment": {},
            "inherits": podman.HANDED_ON.pattern,
            "stop": podman.STOP,
            "ways": podman_ways_to_start.WAYS,
        },
        Apptainer.name: {
            "argv": (package_places.WAY, *(word.replace(str(SCRIPT), packed) for word in apptainer.words(start, box, process))),
            "environment": dict(apptainer.variables(start, box, process)),
            "inherits": apptainer_ways_to_start.HANDED_ON.pattern,
            "stop": (),
            "ways": (),
        },
    }


def _notes(recalled: Recalled) -> list[str]:
    links = sum(parts(what)[0] == LINK for what in read(recalled.manifest).values())
    return [f"{counted(links, 'symbolic link')} of the source is not in the package's folders"] if links else []
