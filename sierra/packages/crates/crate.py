"""`ro-crate-metadata.json`: the package as a Provenance Run Crate 0.5 over RO-Crate 1.1, which other programs read.

The workflow is `sierra.toml`. Its steps are the commands of the runs, and its tools the recorded sources, or programs outside
them. All facts about executions come from the records; all others from `[package]`. The authors stand for the agents of all
actions, because no record names a person, and the first affiliation stands for the publisher.

Sources: https://www.researchobject.org/workflow-run-crate/profiles/0.5/provenance_run_crate/ and
https://www.researchobject.org/ro-crate/specification/1.1/
"""

from __future__ import annotations

import re
import shlex
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import PurePosixPath
from typing import NamedTuple
from urllib.parse import quote

from sierra.config.package_table import DOI, Author, Package
from sierra.packages import instructions
from sierra.packages.crates.actions import Around, Batch, add, batches, parameter
from sierra.packages.crates.graph import Entity, Graph, local, moment, purl, ref
from sierra.packages.layout import CRATE, INSTRUCTIONS, PROJECT, README, STORED
from sierra.packages.subject import Member, PartResult, Subject
from sierra.util.version import __version__

RUN = "https://w3id.org/ro/wfrun/"
WORKFLOW_CRATE = "https://w3id.org/workflowhub/workflow-ro-crate/1.0"
BIOSCHEMAS = "https://bioschemas.org/profiles/"
FORMAL_PARAMETER = f"{BIOSCHEMAS}FormalParameter/1.0-RELEASE"
WORKFLOW = f"{BIOSCHEMAS}ComputationalWorkflow/1.0-RELEASE"
TERMS = "https://w3id.org/ro/terms/workflow-run#"
PROFILES = {
    f"{RUN}process/0.5": ("Process Run Crate", "0.5"),
    f"{RUN}workflow/0.5": ("Workflow Run Crate", "0.5"),
    f"{RUN}provenance/0.5": ("Provenance Run Crate", "0.5"),
    WORKFLOW_CRATE: ("Workflow RO-Crate", "1.0"),
    FORMAL_PARAMETER: ("FormalParameter", "1.0-RELEASE"),
    WORKFLOW: ("ComputationalWorkflow", "1.0-RELEASE"),
}
"""Names and versions of the profiles to which the crate and its entities conform."""
RESULTS = STORED
REDACTED = (
    "The package is anonymous, for double-blind review: hosts, folders, commits and times in its records are not the original "
    "ones. Ids of runs, durations and outputs are."
)
UNKNOWN = "application/octet-stream"
FORMATS = {
    ".bundle": "application/x-git-bundle",
    ".cff": "application/yaml",
    ".csv": "text/csv",
    ".json": "application/json",
    ".lock": "application/toml",
    ".md": "text/markdown",
    ".parquet": "application/vnd.apache.parquet",
    ".pdf": "application/pdf",
    ".png": "image/png",
    ".py": "text/x-python",
    ".sif": "application/vnd.sylabs.sif.layer.v1.sif",
    ".sql": "application/sql",
    ".svg": "image/svg+xml",
    ".tar": "application/x-tar",
    ".toml": "application/toml",
    ".txt": "text/plain",
    ".whl": "application/zip",
    ".xml": "application/xml",
    ".yaml": "application/yaml",
    ".yml": "application/yaml",
}
"""Media types by ending. Python's own table differs between systems."""
SPECS = """
SELECT DISTINCT p.spec, p.command, p.source, s.commit, s.remote, p.image
FROM specs p JOIN (SELECT DISTINCT spec FROM batch_runs) USING (spec)
LEFT JOIN (SELECT tree, min(commit) AS commit, min(remote) AS remote FROM sources GROUP BY tree) s ON s.tree = p.source
ORDER BY p.spec
"""
PROGRAMS = """
SELECT DISTINCT m.spec, p.name, p.version, p.sha256
FROM programs p JOIN (
    SELECT DISTINCT x.programs, m.spec FROM executions x JOIN batch_runs m ON m.run = x.run WHERE x.purpose = 'run'
) m USING (programs) WHERE p.kind = 'program' ORDER BY ALL
"""
IMAGES = """
SELECT DISTINCT ON (image) image, kind, name, sha256, variants FROM images
WHERE image IN (SELECT image FROM specs UNION SELECT image FROM isolations) ORDER BY image, name
"""


class _Spec(NamedTuple):
    spec: str
    command: list[str]
    source: str | None
    commit: str | None
    remote: str | None
    image: str | None


class _Program(NamedTuple):
    spec: str
    name: str
    version: str | None
    sha256: str | None


class Image(NamedTuple):
    """A container image, as the store has it."""

    image: str
    kind: str
    name: str | None
    sha256: str | None
    variants: list[str] | None = None


def members(subject: Subject, packed: Mapping[str, Member]) -> PartResult:
    """Return `README.md`, and the crate, which describes it, all members in `found`, and all executed runs."""
    readme = Member(README, _readme(subject, packed), "first text to read")
    graph = _graph(subject, {**packed, README: readme})
    return PartResult([readme, Member(CRATE, graph.written(), "the package as a Provenance Run Crate")])


def _readme(subject: Subject, packed: Mapping[str, Member]) -> bytes:
    """Return the text that the profile for workflows recommends, and that archives show first."""
    package = subject.project.config.package
    parts = (
        f"# {package.title}",
        "\n".join(instructions.beginning(__version__, packed)),
        package.description.strip(),
        REDACTED if subject.redacted else "",
        f"`{INSTRUCTIONS}` tells how to check the results, and what that needs.",
        f"`{PROJECT}` is a project of SIERRA {__version__} with its records: `sierra ls`, run in a copy, lists its batches.",
        f"`{CRATE}` describes all files and runs as an RO-Crate.",
    )
    return ("\n\n".join(filter(None, parts)) + "\n").encode()


def _graph(subject: Subject, packed: Mapping[str, Member]) -> Graph:
    """Return all entities. The first entity with an id counts, so that files with a role are added before all files."""
    graph = Graph()
    package = subject.project.config.package
    licence = _licence(package)
    agents = [_person(graph, number, author) for number, author in enumerate(package.authors, 1)]
    publisher = [_organization(graph, author) for author in package.authors if author.affiliation][:1]
    graph.add(_descriptor(licence))
    graph.add(licence)
    for address, (name, version) in PROFILES.items():
        graph.add({"@id": address, "@type": "CreativeWork", "name": name, "version": version})
    workflow = ref(_address(PROJECT + subject.project.file.name))
    around = _around(graph, subject, packed, agents, workflow)
    graph.add({**_file(packed[README]), "about": ref("./")})
    graph.add(_workflow(graph, subject, packed, around, publisher))
    files = [graph.add(_file(member)) for name, member in sorted(packed.items()) if name != CRATE]
    graph.add(_results([file for file in files if file["@id"].startswith(STORED)]))
    actions = add(graph, subject.store, around)
    graph.add(_root(graph, subject, [*files, around.results], actions, agents, publisher, workflow))
    return graph


def _descriptor(licence: Entity) -> Entity:
    return {
        "@id": CRATE,
        "@type": "CreativeWork",
        "about": ref("./"),
        "conformsTo": [ref("https://w3id.org/ro/crate/1.1"), ref(WORKFLOW_CRATE)],
        "sdLicense": ref(licence["@id"]),
    }


def _root(
    graph: Graph,
    subject: Subject,
    files: Sequence[Entity],
    actions: Sequence[Entity],
    agents: Sequence[Entity],
    publisher: Sequence[Entity],
    workflow: Entity,
) -> Entity:
    package = subject.project.config.package
    papers = [publication.identifier for publication in package.related if publication.relation == "isSupplementTo"]
    return {
        "@id": "./",
        "@type": "Dataset",
        "name": package.title,
        "description": " ".join(filter(None, (package.description.strip() or package.title, REDACTED * subject.redacted))),
        "datePublished": _published(subject),
        "license": ref(_licence(package)["@id"]),
        "conformsTo": [ref(address) for address in PROFILES if address.startswith((RUN, WORKFLOW_CRATE))],
        "author": agents,
        "publisher": publisher,
        "identifier": _resolved(package.doi) if package.doi else None,
        "keywords": ", ".join(package.keywords),
        "version": package.version,
        "citation": [_paper(graph, identifier) for identifier in papers],
        "mainEntity": workflow,
        "hasPart": files,
        "mentions": actions,
    }


def _published(subject: Subject) -> str:
    """Return the date of the package with a time zone; without a date and without executions, that of the newest batch."""
    if not subject.date:
        return moment(max(batch.started for batch in batches(subject.store))) or ""
    date = datetime.fromisoformat(subject.date)
    return (date if date.tzinfo else date.replace(tzinfo=UTC)).isoformat()


def _licence(package: Package) -> Entity:
    name = package.license
    address = f"https://spdx.org/licenses/{quote(name)}"
    description = f"the SPDX licence expression {name}"
    return {"@id": address, "@type": "CreativeWork", "name": name, "url": address, "description": description}


def _resolved(identifier: str) -> str:
    """Return the address of a DOI, or the address itself."""
    return f"https://doi.org/{identifier}" if DOI.fullmatch(identifier) else identifier


def _paper(graph: Graph, identifier: str) -> Entity:
    return graph.add({"@id": _resolved(identifier), "@type": "ScholarlyArticle", "name": identifier})


def _person(graph: Graph, number: int, author: Author) -> Entity:
    address = f"https://orcid.org/{author.orcid}" if author.orcid else local("author", number)
    employer = [_organization(graph, author)] if author.affiliation else []
    name = " ".join(filter(None, (author.given, author.family)))
    return graph.add({"@id": address, "@type": "Person", "name": name, "affiliation": employer})


def _organization(graph: Graph, author: Author) -> Entity:
    address = author.ror or local("organization", author.affiliation)
    return graph.add({"@id": address, "@type": "Organization", "name": author.affiliation, "url": author.ror})


def _around(graph: Graph, subject: Subject, packed: Mapping[str, Member], agents: Sequence[Entity], workflow: Entity) -> Around:
    specs = subject.store.select(_Spec, SPECS)
    programs = subject.store.select(_Program, PROGRAMS)
    recorded = subject.store.select(Image, IMAGES)
    each = {image.image: graph.add(described(image)) for image in recorded if not image.variants}
    parts = {image.image: [pair.partition("=")[2] for pair in image.variants or ()] or [image.image] for image in recorded}
    images = {name: [each[part] for part in ids if part in each] for name, ids in parts.items()}
    tools = {spec.spec: _tool(graph, spec, specs, programs) for spec in specs}
    rows = batches(subject.store)
    return Around(
        batches=rows,
        workflow=workflow,
        sierra=graph.add(_sierra()),
        agents=agents,
        results=ref(RESULTS),
        templates=_templates(graph, rows, packed),
        tools=tools,
        steps={spec.spec: _step(graph, number, spec, tools[spec.spec], workflow) for number, spec in enumerate(specs, 1)},
        images={spec.spec: images[spec.image] for spec in specs if spec.image in images},
        commands={spec.spec: spec.command for spec in specs},
    )


def _sierra() -> Entity:
    address = purl("pypi", "sierra-experiments", __version__)
    return {
        "@id": address,
        "@type": "SoftwareApplication",
        "name": "SIERRA",
        "softwareVersion": __version__,
        "url": ref(address),
    }


def _templates(graph: Graph, rows: Sequence[Batch], packed: Mapping[str, Member]) -> dict[str, Entity]:
    """Add the packed templates, each with its parameter, and return references by path in the project."""
    templates: dict[str, Entity] = {}
    for path in dict.fromkeys(batch.template for batch in rows):
        if member := packed.get(PROJECT + path):
            file = _file(member)
            inputs = graph.add(_parameter(local("template", path), path, "File", file["encodingFormat"]))
            templates[path] = graph.add({**file, "exampleOfWork": inputs})
    return templates


def _step(graph: Graph, number: int, spec: _Spec, tool: Entity, workflow: Entity) -> Entity:
    address = f"{workflow['@id']}#run-{number}"
    name = shlex.join(spec.command)
    return graph.add({"@id": address, "@type": "HowToStep", "name": name, "position": str(number), "workExample": tool})


def _tool(graph: Graph, spec: _Spec, specs: Sequence[_Spec], programs: Sequence[_Program]) -> Entity:
    """Add what a specification executes: its source, which needs the programs, or else its program."""
    same = {other.spec for other in specs if other.source == spec.source} if spec.source else {spec.spec}
    used = {program.name: graph.add(_program(program)) for program in programs if program.spec in same}
    if spec.source is None:
        name = spec.command[0]
        return used.get(name) or next(iter(used.values()), None) or graph.add(_program(_Program("", name, None, None)))
    address = f"https://archive.softwareheritage.org/{spec.source}"
    return graph.add(
        {
            "@id": address,
            "@type": "SoftwareSourceCode",
            "name": "source of the runs",
            "description": "its content is in this package; the archive has it only if somebody has archived it",
            "identifier": spec.source,
            "url": ref(address),
            "version": spec.commit or spec.source,
            "codeRepository": spec.remote,
            "softwareRequirements": list(used.values()),
        }
    )


def _program(program: _Program) -> Entity:
    address = purl("generic", PurePosixPath(program.name).name, sha256=program.sha256 or "")
    return {
        "@id": address,
        "@type": "SoftwareApplication",
        "name": PurePosixPath(program.name).name,
        "softwareVersion": program.version or (f"sha256:{program.sha256}" if program.sha256 else "unknown"),
        "url": ref(address),
    }


def described(image: Image) -> Entity:
    """Return the entity of a container image. A name without a registry is one of this machine, or a file."""
    prefix, _, name = (image.name or image.image).rpartition("/")
    registry, _, folder = prefix.partition("/")
    remote = re.search(r"[.:]|^localhost$", registry) is not None
    name, _, tag = name.partition("@")[0].partition(":")
    form, _, digest = image.image.partition(":")
    return {
        "@id": local("image", image.image),
        "@type": "ContainerImage",
        "additionalType": ref(TERMS + ("DockerImage" if image.kind == "oci" else "SIFImage")),
        "identifier": image.image,
        "registry": registry if remote else "localhost",
        "name": "/".join(filter(None, (folder if remote else prefix, name))),
        "tag": tag,
        "sha256": digest if form == "sha256" else image.sha256,
    }


def _parameter(address: str, name: str, kind: str, encoding: str | None = None) -> Entity:
    return {
        "@id": address,
        "@type": "FormalParameter",
        "name": name,
        "description": name,
        "additionalType": kind,
        "encodingFormat": encoding,
        "valueRequired": True,
        "conformsTo": ref(FORMAL_PARAMETER),
    }


def _workflow(
    graph: Graph, subject: Subject, packed: Mapping[str, Member], around: Around, publisher: Sequence[Entity]
) -> Entity:
    package = subject.project.config.package
    axes = dict.fromkeys(name for batch in around.batches for name in batch.axes)
    inputs = [graph.add(_parameter(parameter(name), name, "PropertyValue")) for name in axes]
    inputs += [ref(local("template", path)) for path in around.templates]
    return {
        **_file(packed[PROJECT + subject.project.file.name]),
        "@type": ["File", "SoftwareSourceCode", "ComputationalWorkflow", "HowTo"],
        "name": package.title,
        "description": "declares variables, outputs and figures; sierra run executes queries by it",
        "conformsTo": ref(WORKFLOW),
        "programmingLanguage": graph.add(_language(around.sierra)),
        "hasPart": list({tool["@id"]: tool for tool in around.tools.values()}.values()),
        "step": list(around.steps.values()),
        "input": inputs,
        "output": graph.add(_parameter(local("output"), "records", "Dataset")),
        "author": around.agents,
        "creator": around.agents,
        "license": ref(_licence(package)["@id"]),
        "sdPublisher": publisher,
        "url": ref(package.repository or around.workflow["@id"]),
        "dateCreated": _published(subject),
        "version": package.version or __version__,
    }


def _language(sierra: Entity) -> Entity:
    return {
        "@id": local("sierra-toml"),
        "@type": "ComputerLanguage",
        "name": "SIERRA",
        "alternateName": "sierra.toml",
        "identifier": sierra,
        "url": sierra,
        "version": __version__,
    }


def _address(name: str) -> str:
    """Return the id of a member: its name, as a relative address."""
    return quote(name)


def _file(member: Member) -> Entity:
    return {
        "@id": _address(member.name),
        "@type": "File",
        "name": member.name,
        "description": member.about,
        "encodingFormat": FORMATS.get(PurePosixPath(member.name).suffix.lower(), UNKNOWN),
        "contentSize": str(member.size),
        "sha256": member.sha256(),
    }


def _results(files: Sequence[Entity]) -> Entity:
    """Return the store as a whole: outputs of several runs are in one file."""
    return {
        "@id": RESULTS,
        "@type": "Dataset",
        "name": "records and outputs of all runs",
        "description": "the tables executions and artifacts name the outputs of each run; sierra sql reads them",
        "exampleOfWork": ref(local("output")),
        "hasPart": files,
    }
