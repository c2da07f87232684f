"""Identity is content. The hashes below pin formats: if one changes, the version of its format must be raised."""

from __future__ import annotations

import os
import platform
import subprocess
from dataclasses import replace
from pathlib import Path

import pytest

import sierra
from sierra.config.output_tables import Output, Success
from sierra.containers.container_setup import Isolation
from sierra.containers.engines import podman
from sierra.containers.engines.base import Capabilities, ContainerSpec, Mount, NoEngine, Process
from sierra.containers.images.image import Image, Kind, variants_id
from sierra.design.seeds import seed
from sierra.execution.plan import Plan
from sierra.ingest.recorder import result_hash
from sierra.ingest.recording_context import Context
from sierra.model import Client, OutputFile, RunSpec
from sierra.provenance.dependency_model import fingerprint
from sierra.provenance.source.capture import Source
from sierra.provenance.source.manifest import tree_hash
from sierra.util.hashing import digest, digest_plain, merkle
from sierra.worker.devices import CDI_MARK
from tests import projects

TOML = """
template = "t.xml"
command = "sh sim.sh {input} {seed} {output}"
seed = "//e/@seed"
runs = 2
[variables]
n = "//e/@n"
[environment]
set = { MODE = "fast" }
"""

GOLDEN = {
    "spec": "2ba967922a8885cf8c491d8c0bfbf348d9d2ab1c4e7cabb4eccbc570a92055e6",
    "run": "470ce59a6a1c2b507e4d8cfb855ffbaf2268dd1009d157d725facf2d52133934",
    "experiment": "dd5519a74c9078994b3a77d66beec8eb4ca7214b23da8636565906cbf339ca38",
    "batch": "fa14571176940ca0d713c28d0553b9b5d613e0869aaf089f73c7c6d3ffdf85ed",
    "source": "swh:1:dir:ff8dcd6c434fe40e7ecd62eda7de012f245c93eb",
}
SEEDS = (118367921, 1660350901, 924057756)
RESULT = "e807b81751e170dd5a4759817cd4267350679b282c6ff9a42850c066d79d48d6"
READING = "ed83eb32a12b40a95e8ee48affdde7a6d7b6231d55e4aefa9b244eadd93ef635"


PROGRAMS = "6e14f26bdffdb35aefa5a2e6cda15e42278795487b2980915f8907eed8780f4b"
SOURCE = "15e8a149eae8046de8dea6f465713bf8ad9ee768710bc691aa0b890792191a43"


def project(folder: Path, toml: str = TOML) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "sierra.toml").write_text(toml)
    (folder / "t.xml").write_text('<e seed="0" n="0"/>\n')
    (folder / "sim.sh").write_text("echo hello\n")
    return folder


def plan(folder: Path, *query: str, runs: int | None = None) -> Plan:
    return sierra.open(folder).plan(*(query or ("n=1,2",)), runs=runs)


def ids(plan: Plan) -> dict[str, str]:
    first = plan.batch.experiments[0]
    source = plan.batch.spec.source or ""
    return {
        "spec": plan.batch.spec_id,
        "run": first.runs[0].id,
        "experiment": first.id,
        "batch": plan.batch.id,
        "source": source,
    }


def test_names_of_input_files_are_part_of_the_specification(tmp_path: Path) -> None:
    xml = plan(project(tmp_path / "xml"))
    folder = project(tmp_path / "sdf", TOML.replace("t.xml", "t.sdf"))
    (folder / "t.xml").rename(folder / "t.sdf")
    sdf = plan(folder)
    assert [one.batch.runs[0].names for one in (xml, sdf)] == [("input.xml",), ("input.sdf",)]
    assert sdf.batch.runs[0].digests == xml.batch.runs[0].digests
    assert sdf.batch.spec_id != xml.batch.spec_id


@pytest.mark.nightly
def test_a_template_of_another_name_keeps_records_sound(tmp_path: Path) -> None:
    for name in ("t.xml", "t.sdf"):
        folder = project(tmp_path / "p", TOML.replace("t.xml", name))
        (folder / "t.xml").rename(folder / name)
        (folder / "sim.sh").write_text('echo given > out.csv; basename "$1" >> out.csv\n')
        projects.run(folder, "n=1")
    assert projects.quick(folder, "fsck").returncode == 0
    for row in projects.sql(folder, "SELECT batch FROM batches"):
        assert projects.quick(folder, "replay", row["batch"]).returncode == 0
    names = projects.sql(folder, "SELECT DISTINCT given FROM out ORDER BY 1")
    assert [row["given"] for row in names] == ["input.sdf", "input.xml"]


def test_ids_are_unchanged(tmp_path: Path) -> None:
    assert ids(plan(project(tmp_path))) == GOLDEN


def test_seeds_are_unchanged() -> None:
    assert tuple(seed(0, number) for number in range(3)) == SEEDS


def test_result_hash_is_unchanged_and_independent_of_file_order() -> None:
    files = [OutputFile(name, 1, digest * 64, 1, True, "") for name, digest in (("b.csv", "b"), ("a.csv", "a"))]
    assert result_hash(files) == result_hash(reversed(files)) == RESULT
    assert merkle("result", [f"{'a' * 64} a.csv", f"{'b' * 64} b.csv"]) == RESULT


def test_id_of_ingest_rules_is_unchanged() -> None:
    outputs = {"out": Output(file="out.csv", units={"v": "m"})}
    assert Context("s", "b", "run", "e", "p", outputs, Success()).ingest_rules == READING


def test_fingerprint_of_programs_is_unchanged_and_independent_of_order_and_folder() -> None:
    names = ("/usr/bin/sim", "libm.so.6", "{project}/map.png")
    used = [(name, f"/x/{name}", digest * 64) for name, digest in zip(names, "abc", strict=True)]
    assert fingerprint(used) == fingerprint(reversed(used)) == PROGRAMS
    assert fingerprint([("/opt/bin/sim", "/opt/bin/sim", "a" * 64), *used[1:]]) == PROGRAMS
    assert fingerprint([*used, ("/opt/bin/sim", "/opt/bin/sim", "a" * 64)]) == PROGRAMS


def test_id_of_a_source_is_unchanged_and_independent_of_notes() -> None:
    state = Source("swh:1:dir:" + "a" * 40, "git", "b" * 40, "main", True, "git@example.org:x", b"", "v1-dirty", "sim", "{}")
    assert state.id == SOURCE
    assert replace(state, checkout=True, notes=("x",)).id == SOURCE


def test_units_and_mismatch_are_not_part_of_the_id_of_ingest_rules() -> None:
    outputs = {"out": Output(file="out.csv", mismatch="ragged")}
    assert Context("t", "c", "run", "f", "q", outputs, Success()).ingest_rules == READING


def test_tree_hash_is_the_hash_of_git() -> None:
    blob = "ce013625030ba8dba906f756967f9e9ca394464a"  # hello\n
    assert tree_hash({b"a": b"100644 " + blob.encode()}) == "0976950c1fdbcb52435a433913017bf044b3a58f"


def test_digest_depends_on_its_kind_and_format_version() -> None:
    assert digest("x", {"a": 1}) == digest("x", {"a": 1}, version=1) != digest("x", {"a": 1}, version=2)
    assert digest("x", {"a": 1}) != digest("y", {"a": 1})


def test_ids_do_not_depend_on_path_user_or_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    here = ids(plan(project(tmp_path / "here")))
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("USER", "somebody")
    monkeypatch.setenv("TZ", "Asia/Tokyo")
    there = project(tmp_path / "the re" / "'deep")
    for path in there.iterdir():
        os.utime(path, (1, 1))
    assert ids(plan(there)) == here


def test_ids_do_not_depend_on_the_processor_but_programs_do(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    root = project(tmp_path, TOML.replace("sh sim.sh", "sh sims/{arch}.sh"))
    (root / "sims").mkdir()
    (root / ".gitignore").write_text("sims\n")
    subprocess.run(["git", "init", "-q", str(root)], check=True)
    for arch in ("x86_64", "aarch64"):
        (root / "sims" / f"{arch}.sh").write_text(f"echo {arch}\n")
    plans = []
    for machine in ("x86_64", "aarch64"):
        monkeypatch.setattr(platform, "machine", lambda machine=machine: machine)
        plans.append(plan(root))
    assert plans[0].batch.spec.command[:2] == ("sh", "{project}/sims/{arch}.sh")
    assert ids(plans[0]) == ids(plans[1])
    assert [[one.name for one in made.programs.all if "sims" in one.name] for made in plans] == [
        ["{project}/sims/x86_64.sh"],
        ["{project}/sims/aarch64.sh"],
    ]


def test_git_repository_around_a_project_changes_no_ids(tmp_path: Path) -> None:
    before = ids(plan(project(tmp_path)))
    subprocess.run(["git", "init", "-q", str(tmp_path)], check=True)
    assert ids(plan(tmp_path)) == before


def test_equal_values_in_another_query_syntax_give_the_same_ids(tmp_path: Path) -> None:
    folder = project(tmp_path)
    assert ids(plan(folder, "n=1,2,4,8")) == ids(plan(folder, "n.Log8"))


def test_setting_a_number_to_itself_in_another_spelling_gives_the_same_batch(tmp_path: Path) -> None:
    opened = sierra.open(project(tmp_path))
    same = opened.plan("montecarlo.C2", sets=[("//e/@n", "0.0")])
    assert same.batch.id == opened.plan("montecarlo.C2").batch.id


@pytest.mark.nightly
def test_another_spelling_that_gives_the_same_runs_executes_nothing(tmp_path: Path) -> None:
    folder = projects.make(tmp_path / "p", template=projects.TEMPLATE.replace("0.1", "0.0"))
    assert projects.quick(folder, "run", "noise=0", "--no-figures").returncode == 0
    assert "0 of 2 runs would execute" in projects.quick(folder, "run", "noise=0.0", "-n").stdout


def test_more_runs_per_experiment_keep_the_first_runs_unchanged(tmp_path: Path) -> None:
    folder = project(tmp_path)
    few, many = plan(folder, runs=8).batch, plan(folder, runs=10).batch
    assert few.id != many.id
    for one, other in zip(few.experiments, many.experiments, strict=True):
        assert one.runs == other.runs[:8]


def test_order_of_keys_does_not_change_ids(tmp_path: Path) -> None:
    turned = """
    runs = 2
    seed = "//e/@seed"
    command = "sh sim.sh {input} {seed} {output}"
    template = "t.xml"
    environment.set = { MODE = "fast" }
    [variables]
    n = "//e/@n"
    """
    assert ids(plan(project(tmp_path / "a"))) == ids(plan(project(tmp_path / "b", turned)))


@pytest.mark.parametrize(
    "more", ["[limits]\nwall = 5\nmemory = '1 GB'\n", "[figures.x]\nkind = 'box'\n", "[outputs.o]\nfile = 'o'\n"]
)
def test_limits_figures_and_outputs_are_not_part_of_ids(tmp_path: Path, more: str) -> None:
    assert ids(plan(project(tmp_path / "a"))) == ids(plan(project(tmp_path / "b", TOML + more)))


@pytest.mark.parametrize(
    ("was", "becomes"),
    [
        ("fast", "slow"),
        ("sim.sh {input}", "sim.sh -v {input}"),
        ('seed = "//e/@seed"', 'seed = { set = "//e/@seed", base = 1 }'),
    ],
)
def test_declared_variables_command_and_base_seed_are_part_of_run_ids(tmp_path: Path, was: str, becomes: str) -> None:
    old, new = plan(project(tmp_path / "a")), plan(project(tmp_path / "b", TOML.replace(was, becomes)))
    assert {run.id for run in old.batch.runs}.isdisjoint(run.id for run in new.batch.runs)


def test_code_and_template_are_part_of_run_ids(tmp_path: Path) -> None:
    folder = project(tmp_path)
    seen = {run.id for run in plan(folder).batch.runs}
    (folder / "sim.sh").write_text("echo other\n")
    second = {run.id for run in plan(folder).batch.runs}
    (folder / "t.xml").write_text('<e seed="0" n="0" x="1"/>\n')
    third = {run.id for run in plan(folder).batch.runs}
    assert len(seen | second | third) == 12


def test_run_spec_contains_everything_that_runs_have_in_common() -> None:
    spec = RunSpec("command", ("a",), {"B": "c"}, "swh:1:dir:0", None)
    assert set(spec.preimage()) == {"platform", "command", "environment", "source", "image"}


CONTAINED = [
    "b5d2f5a75e3684cf333182755ff08a4587b7841a1a46ff9c1e3d8ffe21fbfeec",
    "c828f09234ce24a94094541f6546b435bc643b254d42a609c65aea9502bc7d6b",
]
VARIANTS = "variants:b1946e70871620f0d479c9c5249befe7cd14b4b45d401d8a66a3658ffb499be7"


def test_run_spec_in_an_image_contains_the_image_id_and_host_access() -> None:
    plain = RunSpec("command", ("a",), {"B": "c"}, "swh:1:dir:0", "sha256:" + "0" * 64)
    reaching = replace(plain, host_access=("device /dev/dri", "network"))
    assert plain.preimage()["image"] == {"id": "sha256:" + "0" * 64, "reach": []}
    assert [digest("recipe", one.preimage()) for one in (plain, reaching)] == CONTAINED
    assert replace(plain, image=None, host_access=("network",)).preimage()["image"] is None


def test_images_by_processor_have_one_id() -> None:
    ids = {"x86_64": "sha256:" + "0" * 64, "aarch64": "squashfs:" + "1" * 64}
    assert variants_id(ids) == VARIANTS
    assert variants_id(dict(reversed(ids.items()))) == VARIANTS
    assert variants_id(dict(zip(ids, reversed(ids.values()), strict=True))) != VARIANTS


ISOLATION = "248f73e6160525a63312e2ea2bb660709f2c72ba1316f4c6561046f4f7205a30"


class Engine(NoEngine):
    """A fake engine that returns the command line of a container without starting it."""

    name = "fake"

    def client(self, box: ContainerSpec, process: Process) -> Client:
        return Client(("fake", "--cid=\0/id", f"--session={box.session}", box.reference), {})


def test_id_of_an_isolation_is_unchanged_and_independent_of_the_session() -> None:
    image = Image("sim", "sha256:" + "0" * 64, Kind.OCI, "amd64", (), {})
    box = ContainerSpec(image, "sim", "s", (Mount("/code", "/run/sierra/project"),), True, ("/dev/dri",), True, 1 << 30, 1.5, 9)
    able = Capabilities("fake 1", rootless=True, enforced=frozenset({"memory"}), user="somebody")
    row = Isolation(Engine(), able, box).row
    assert row is not None
    assert (row.isolation, row.argv) == (ISOLATION, ["fake", "--cid={run}/id", "--session=", "sim"])
    assert Isolation(Engine(), able, replace(box, session="t")).row == row
    assert Isolation(Engine(), able).row is None


class PodmanWords(NoEngine):
    """An engine that returns podman's command line, without a look at how podman starts here."""

    name = "podman"

    def client(self, box: ContainerSpec, process: Process) -> Client:
        return Client(podman.words(box, process), {})


def test_record_of_containers_has_no_gpus_of_single_runs() -> None:
    image = Image("sim", "sha256:" + "0" * 64, Kind.OCI, "amd64", (), {})
    box = ContainerSpec(image, "sim", "s", gpu=True)
    words = ["--device=nvidia.com/gpu=all", "--device=nvidia.com/gpu={gpus}"]
    for names, word in zip(("all", CDI_MARK), words, strict=True):
        row = Isolation(PodmanWords(), Capabilities("podman 4"), replace(box, gpus=names)).row
        assert row is not None
        assert (word in row.argv, row.devices) == (True, ["gpu"])
        assert not any(not text.isprintable() for text in row.argv)


def test_fast_digest_of_plain_text_fields_equals_the_general_digest() -> None:
    fields = {"session": "0f3a", "run": GOLDEN["run"], "text": 'ü "\\\n\x7f\u2028'}
    assert digest_plain("execution", fields) == digest("execution", fields)
