"""Programs by fingerprint: with loaded libraries, installed distributions of Python, and files that a template names."""

from __future__ import annotations

import json
import os
import struct
import subprocess
import sys
import venv
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

import sierra
from sierra.errors import Missing
from sierra.provenance import dependency_model, fingerprint_programs, libraries, pythons, referenced_files
from sierra.provenance.dependency_model import NOTHING, Kind, Program, Programs
from tests import projects

SEARCH = "/usr/bin:/bin"
Require = Callable[..., str]


def make(folder: Path, command: str, more: str = "", template: str = '<e seed="0" n="0"/>') -> sierra.Project:
    folder.mkdir(parents=True, exist_ok=True)
    toml = f"template = 't.xml'\ncommand = '{command}'\nruns = 1\nseed = '//e/@seed'\n[variables]\nn = '//e/@n'\n{more}"
    (folder / "sierra.toml").write_text(toml)
    (folder / "t.xml").write_text(template)
    return sierra.open(folder)


def rows(project: sierra.Project, kind: str) -> dict[str, dict[str, str]]:
    """Return the recorded programs of one kind, by name."""
    return {row["name"]: row for row in project.sql(f"SELECT * FROM programs WHERE kind = '{kind}'").to_pylist()}


# ---------------------------------------------------------------- libraries


class Built:
    """A small program: its library `libcore.so` does the computation."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.program = folder / "bin" / "sim"
        self.library = folder / "lib" / "libcore.so"
        for path in (self.program, self.library):
            path.parent.mkdir(parents=True)
        self.change(1)
        (folder / "sim.c").write_text(
            '#include <stdio.h>\nint core(void);\nint main(void) { FILE *f = fopen("out.csv", "w"); '
            'fprintf(f, "v\\n%d\\n", core()); return fclose(f); }\n'
        )
        self._compile("-o", self.program, folder / "sim.c", f"-L{self.library.parent}", "-lcore")

    def change(self, value: int) -> None:
        (self.folder / "core.c").write_text(f"int core(void) {{ return {value}; }}\n")
        self._compile("-shared", "-fPIC", "-o", self.library, self.folder / "core.c")

    def _compile(self, *words: str | Path) -> None:
        subprocess.run(["gcc", *map(str, words)], check=True)


@pytest.fixture
def built(tmp_path: Path, require: Require) -> Built:
    require("gcc")
    require("ld.so", there=Path("/lib64").exists() or Path("/lib").exists())
    return Built(tmp_path / "built")


@pytest.mark.integration
def test_a_loaded_library_is_recorded_and_its_change_executes_runs_again(built: Built, tmp_path: Path) -> None:
    project = make(tmp_path / "p", str(built.program), f"[environment.set]\nLD_LIBRARY_PATH = '{built.library.parent}'\n")
    assert project.run("n=1", figures=False).executed == 1
    assert project.run("n=1", figures=False).reused == 1
    loaded = rows(project, "library")
    assert loaded["libcore.so"]["path"] == str(built.library)
    assert {"libcore.so", "libc.so.6"} <= loaded.keys()
    built.change(2)
    assert project.run("n=1", figures=False).executed == 1
    assert project.sql("SELECT v FROM out").column(0).to_pylist() == [2]


def test_a_missing_library_is_reported_before_any_run_executes(built: Built, tmp_path: Path) -> None:
    project = make(tmp_path / "p", str(built.program))
    with pytest.raises(Missing, match=r"^sim needs libcore\.so, which was not found; "):
        project.run("n=1", figures=False)
    assert not (tmp_path / "p" / ".sierra").exists()


def packaged(folder: Path, built: Built) -> Path:
    """Return the script of a Python package; it starts the package's compiled program of the same name."""
    program = folder / "lib" / "python3.11" / "site-packages" / "sims" / "bin" / "sim"
    script = folder / "bin" / "sim"
    for path in (program, script):
        path.parent.mkdir(parents=True)
    program.write_bytes(built.program.read_bytes())
    script.write_text(f"#!/usr/bin/env python3\nimport subprocess, sys\nsys.exit(subprocess.call([{str(program)!r}]))\n")
    for path in (program, script):
        path.chmod(0o755)
    return script


def test_a_library_that_a_packaged_program_lacks_is_reported_before_any_run_executes(built: Built, tmp_path: Path) -> None:
    project = make(tmp_path / "p", str(packaged(tmp_path / "env", built)))
    with pytest.raises(Missing, match=r"^sim: program needs libcore\.so, which was not found; install it"):
        project.run("n=1", figures=False)
    assert not (tmp_path / "p" / ".sierra").exists()


def test_the_compiled_program_of_a_packaged_script_is_recorded(built: Built, tmp_path: Path) -> None:
    script, variables = packaged(tmp_path / "env", built), {"PATH": SEARCH, "LD_LIBRARY_PATH": str(built.library.parent)}
    found = fingerprint_programs.find((str(script),), variables, tmp_path)
    assert {"sim: program", "libcore.so"} <= {one.name for one in found.all}


@pytest.mark.nightly
def test_variables_that_the_env_command_sets_are_used_to_find_libraries(built: Built, tmp_path: Path) -> None:
    project = make(tmp_path / "p", f"env LD_LIBRARY_PATH={built.library.parent} {built.program}")
    assert project.run("n=1", figures=False).failed == 0
    assert "libcore.so" in rows(project, "library")


def test_a_program_started_by_another_may_lack_libraries(built: Built, tmp_path: Path) -> None:
    found = fingerprint_programs.find(("nice", str(built.program)), {"PATH": SEARCH}, tmp_path)
    assert str(built.program) in {one.path for one in found.all}


def test_scripts_and_static_programs_load_no_libraries(tmp_path: Path, require: Require) -> None:
    require("gcc")
    (tmp_path / "x.c").write_text("int main(void) { return 0; }\n")
    done = subprocess.run(["gcc", "-static", "-o", tmp_path / "static", tmp_path / "x.c"], check=False, capture_output=True)
    require("a static libc", there=done.returncode == 0)
    (tmp_path / "script").write_text("#!/nowhere\n")
    assert libraries.loaded(str(tmp_path / "static"), {}) == libraries.NONE
    assert libraries.loaded(str(tmp_path / "script"), {}) == libraries.NONE


def elf(interpreter: bytes, *, at: int = 120, length: int | None = None) -> bytes:
    """Return the beginning of an ELF file that names a loader."""
    size = len(interpreter) if length is None else length
    head = b"\x7fELF\x02\x01\x01" + bytes(9) + struct.pack("<HHIQQQIHHHHHH", 2, 62, 1, 0, 64, 0, 0, 64, 56, 1, 0, 0, 0)
    return head + struct.pack("<IIQQQQQQ", 3, 4, at, 0, 0, size, size, 1) + interpreter


def test_a_loader_that_a_hostile_file_names_is_never_executed(tmp_path: Path) -> None:
    loader = tmp_path / "loader"
    loader.write_text(f"#!/bin/sh\ntouch {tmp_path}/executed\n")
    loader.chmod(0o755)
    hostile = tmp_path / "hostile"
    hostile.write_bytes(elf(os.fsencode(loader) + b"\0"))
    hostile.chmod(0o755)
    found = fingerprint_programs.find((str(hostile),), {"PATH": SEARCH}, tmp_path)
    assert [one.name for one in found.all] == [str(hostile)]
    assert found.notes == (f"the libraries of {hostile} are not recorded: its loader {loader} does not belong to the system",)
    assert not (tmp_path / "executed").exists()


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"\x7fELF",
        b"\x7fELF\x02\x01",
        elf(b"")[:100],
        elf(b"", at=2**63),
        elf(b"", at=2**64 - 1, length=2**64 - 1),
        elf(b"\0"),
    ],
)
def test_a_truncated_or_damaged_program_has_no_loader(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "x").write_bytes(content)
    assert libraries.loaded(str(tmp_path / "x"), {}) == libraries.NONE


def test_only_a_loader_by_name_in_the_systems_folders_is_executed(tmp_path: Path) -> None:
    """Hostile files may name an existing program, or reach it through a link."""
    (tmp_path / "ld-linux.so.2").symlink_to(libraries.interpreter(os.path.realpath("/bin/true")) or "/bin/true")
    hostile = tmp_path / "hostile"
    for loader in ("/usr/lib/os-release", f"/lib/../{tmp_path}/ld-linux.so.2", str(tmp_path / "ld-linux.so.2")):
        hostile.write_bytes(elf(os.fsencode(loader) + b"\0"))
        doubt = libraries.loaded(str(hostile), {}).doubt
        assert doubt is None or "does not belong to the system" in doubt
        assert doubt is not None or not Path(loader).exists()


# ---------------------------------------------------------------- Python


@pytest.fixture
def python(tmp_path: Path) -> Path:
    """Return a Python without installed packages."""
    (tmp_path / "p").mkdir()
    venv.create(tmp_path / "env", symlinks=True)
    return tmp_path / "env" / "bin" / "python"


def install(python: Path, name: str, version: str, direct: str | None = None, record: str = "") -> None:
    [folder] = python.parent.parent.glob("lib/python3*/site-packages")
    info = folder / f"{name}-{version}.dist-info"
    info.mkdir(exist_ok=True)
    (info / "RECORD").write_text(record)
    if direct is not None:
        (info / "direct_url.json").write_text(direct)


def seen(python: Path, root: Path, **variables: str) -> Programs:
    return fingerprint_programs.find((str(python),), {**variables, "PATH": SEARCH}, root)


def test_the_interpreter_and_its_distributions_are_recorded(python: Path, tmp_path: Path) -> None:
    install(python, "numpy", "2.0.1")
    install(python, "Brax_x", "1!0.1+local")
    found = seen(python, tmp_path)
    [installed] = [one for one in found.all if one.kind == "distributions"]
    assert installed.version == "brax-x==1!0.1+local\nnumpy==2.0.1"
    real = os.path.realpath(sys.executable)
    assert [one.path for one in found.all if one.kind == "program"] == [str(python), real]


def test_environments_with_the_same_distributions_have_the_same_id(python: Path, tmp_path: Path) -> None:
    venv.create(tmp_path / "other", symlinks=True)
    other = tmp_path / "other" / "bin" / "python"
    for one in (python, other):
        install(one, "numpy", "2.0.1")
    assert seen(python, tmp_path).id == seen(other, tmp_path).id
    install(other, "scipy", "1")
    assert seen(python, tmp_path).id != seen(other, tmp_path).id


@pytest.mark.integration
@pytest.mark.parametrize("observe", ["first", pytest.param("none", marks=pytest.mark.nightly)])
def test_any_name_of_the_python_that_starts_sierra_reuses_the_same_runs(observe: str, tmp_path: Path) -> None:
    """`{python}` is the link that SIERRA was started by; two tools have made environments with the same distributions."""
    folder = tmp_path / "p"
    make(folder, "{python} {project}/sim.py {input}")
    toml = (folder / "sierra.toml").read_text()
    (folder / "sierra.toml").write_text(toml.replace("runs = 1", f'runs = 3\nobserve = "{observe}"'))
    (folder / "sim.py").write_text('import six\nopen("out.csv", "w").write("t,v\\n0,1\\n")\n')
    executed = []
    for environment, names in {"pip": ("python3", "python3.11", "python"), "uv": ("python",)}.items():
        venv.create(tmp_path / environment, symlinks=True)
        python = tmp_path / environment / "bin" / "python"
        install(python, "six", "1.16", record=f"six-1.16.dist-info/INSTALLER,sha256={environment},4\nsix.py,,\n")
        [site] = python.parent.parent.glob("lib/python3*/site-packages")
        (site / "six.py").write_text("")
        if environment == "uv":
            config = python.parent.parent / "pyvenv.cfg"
            kept = [line for line in config.read_text().splitlines() if line.startswith(("home", "include"))]
            config.write_text("\n".join(("uv = 0.9.1", "version_info = 3.11", *kept)))
            (python.parent / "activate.bat").write_text("")
        for name in names:
            if not (python.parent / name).exists():
                (python.parent / name).symlink_to("python3")
            words = (str(python.parent / name), str(projects.SIERRA), "run", "n=1", "--no-figures", "--json")
            path = os.pathsep.join(filter(None, sys.path))
            done = subprocess.run(words, cwd=folder, env={**os.environ, "PYTHONPATH": path}, capture_output=True, text=True)
            assert done.returncode == 0, done.stderr
            executed.append(json.loads(done.stdout)["executed"])
            assert not any(word in done.stderr for word in ("recorded", "have changed", "named"))
    assert executed == [3, 0, 0, 0]


@pytest.mark.integration
def test_executions_with_another_recorded_name_of_the_python_count(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, require: Require
) -> None:
    """Earlier versions recorded the link that had started SIERRA."""
    require("strace")
    folder = tmp_path / "p"
    make(folder, "{python} {project}/sim.py {input}")
    (folder / "sierra.toml").write_text((folder / "sierra.toml").read_text().replace("runs = 1", "runs = 3"))
    (folder / "sim.py").write_text('open("out.csv", "w").write("t,v\\n0,1\\n")\n')
    with monkeypatch.context() as patch:
        patch.setattr(pythons, "NAMED", "python")
        assert projects.run(folder, "n=1")[0]["executed"] == 3
    summary, said = projects.run(folder, "n=1")
    assert (summary["executed"], summary["reused"]) == (0, 3)
    assert "changed" not in projects.other_notes(said)
    assert projects.run(folder, "n=1")[0]["executed"] == 0


@pytest.mark.parametrize(
    ("words", "programs"),
    [
        ("./sim --fast true", {"./sim"}),
        ("./sim --fast /bin/true", {"./sim", "/bin/true"}),
        ("./sim true", {"./sim", "true"}),
        ("nice -n 5 ./sim --fast true", {"nice", "./sim"}),
        ("env -i true --fast false", {"env", "true"}),
        ("timeout -v nice -n 1 true", {"timeout", "nice", "true"}),
    ],
)
def test_the_value_of_an_option_is_no_program_unless_the_program_starts_others(
    tmp_path: Path, words: str, programs: set[str]
) -> None:
    (tmp_path / "sim").write_bytes(Path("/bin/true").read_bytes())
    (tmp_path / "sim").chmod(0o755)
    command = [word.replace("./sim", str(tmp_path / "sim")) for word in words.split()]
    found = fingerprint_programs.find(command, {"PATH": SEARCH}, tmp_path / "other")
    named = {one.name for one in found.all if one.kind == "program"}
    assert named == {word.replace("./sim", str(tmp_path / "sim")) for word in programs}


def test_the_python_that_a_script_starts_is_recorded(python: Path, tmp_path: Path) -> None:
    """The shims of pyenv and asdf are such scripts."""
    install(python, "numpy", "2.0.1")
    shim = tmp_path / "shims" / "python3"
    shim.parent.mkdir()
    shim.write_text(f'#!/bin/sh\nexec {python} "$@"\n')
    shim.chmod(0o755)
    found = fingerprint_programs.find(("python3",), {"PATH": f"{shim.parent}:{SEARCH}"}, tmp_path / "p")
    assert "numpy==2.0.1" in [one.version for one in found.all]
    assert "python3: interpreter" in {one.name for one in found.all}


def test_a_program_of_the_project_named_python_is_not_executed_for_planning(tmp_path: Path) -> None:
    project = make(tmp_path / "p", "bin/python3 {input}")
    (project.root / "bin").mkdir()
    (project.root / "bin" / "python3").write_text(f"#!/bin/sh\ntouch {tmp_path}/executed\n")
    (project.root / "bin" / "python3").chmod(0o755)
    project.plan("n=1")
    assert not (tmp_path / "executed").exists()


def test_an_editable_install_is_identified_by_its_code(python: Path, tmp_path: Path) -> None:
    code = tmp_path / "my code"
    for folder in (code, code / ".venv", code / "env"):
        folder.mkdir()
    (code / "env" / "pyvenv.cfg").touch()
    (code / "sim.py").write_text("x = 1\n")
    install(python, "sim", "0.1", f'{{"url": "{code.as_uri()}", "dir_info": {{"editable": true}}}}')
    first = seen(python, tmp_path / "p")
    (row,) = (one for one in first.all if one.name == "python: sim")
    assert (row.path, row.version) == (str(code), "sim==0.1")
    for ignored in (code / ".venv" / "x.py", code / "env" / "x.py", code / "notes.txt"):
        ignored.write_text("x")
    assert seen(python, tmp_path / "p").id == first.id
    (code / "sim.py").write_text("x = 2\n")
    assert seen(python, tmp_path / "p").id != first.id


def test_a_package_installed_from_a_folder_is_identified_by_its_record(python: Path, tmp_path: Path) -> None:
    def installed(record: str) -> str:
        install(python, "sim", "0.1", '{"url": "file:///home/me/sim", "dir_info": {}}', record)
        return seen(python, tmp_path).id

    first = installed("sim.py,sha256=a,1\n../../bin/sim,sha256=here,1\n__pycache__/sim.cpython-311.pyc,,\n")
    assert installed("sim.py,sha256=a,1\n../../bin/sim,sha256=there,1\n") == first
    assert installed("sim.py,sha256=b,1\n") != first


@pytest.mark.parametrize("direct", ["", "{", "[]", "null", '{"url": 1}', "[" * 100_000])
def test_a_damaged_record_of_an_install_is_ignored(python: Path, tmp_path: Path, direct: str) -> None:
    install(python, "sim", "0.1", direct)
    assert "sim==0.1" in [one.version for one in seen(python, tmp_path).all]


def test_folders_of_pythonpath_are_recorded_and_the_users_site_packages_are_not(python: Path, tmp_path: Path) -> None:
    (tmp_path / "modules").mkdir()
    (tmp_path / "modules" / "m.py").write_text("x = 1\n")
    first = seen(python, tmp_path / "p", PYTHONPATH=str(tmp_path / "modules"))
    assert str(tmp_path / "modules") in [one.path for one in first.all]
    assert not [one for one in first.all if str(Path.home() / ".local") in one.path]
    (tmp_path / "modules" / "m.py").write_text("x = 2\n")
    assert seen(python, tmp_path / "p", PYTHONPATH=str(tmp_path / "modules")).id != first.id


# ---------------------------------------------------------------- files that a template names


@pytest.mark.integration
def test_a_file_that_a_template_names_is_recorded_unless_it_is_in_the_source(tmp_path: Path) -> None:
    """The runs are not observed: nobody knows that they do not read the file."""
    mesh = tmp_path / "outside" / "a mesh.stl"
    mesh.parent.mkdir()
    mesh.write_text("one")
    project = make(tmp_path / "p", "true", template=f'<e seed="0" n="0"><mesh file="{mesh}"/><map>maps/held.pgm</map></e>')
    config = project.root / "sierra.toml"
    config.write_text(f'observe = "none"\n{config.read_text()}')
    project = sierra.open(project.root)
    (project.root / "maps").mkdir()
    (project.root / "maps" / "held.pgm").touch()
    assert project.run("n=1", figures=False).executed == 1
    assert list(rows(project, "file")) == [str(mesh)]
    assert project.run("n=1", figures=False).reused == 1
    mesh.write_text("two")
    assert project.run("n=1", figures=False).executed == 1


@pytest.mark.integration
def test_files_that_an_included_model_names_are_resolved_from_its_folders(tmp_path: Path) -> None:
    project = make(tmp_path / "p", "true", template='<e seed="0" n="0"><include file="models/arm.xml"/></e>')
    for folder in ("models", "models/meshes"):
        (project.root / folder).mkdir()
    (project.root / "models" / "arm.xml").write_text('<m><compiler meshdir="meshes"/><mesh file="hand.stl"/></m>')
    (project.root / "models" / "meshes" / "hand.stl").write_text("one")
    (project.root / ".gitignore").write_text("*.stl\n")
    subprocess.run(["git", "init", "-q", project.root], check=True)
    project.run("n=1", figures=False)
    assert list(rows(project, "file")) == ["{project}/models/meshes/hand.stl"]


@pytest.mark.integration
def test_files_that_a_scenario_names_are_recorded_for_every_query(tmp_path: Path) -> None:
    (tmp_path / "map.pgm").write_text("one")
    scenario = f"[scenarios.s]\nchanges = [{{ add = '//e', xml = '<map file=\"{tmp_path}/map.pgm\"/>' }}]\n"
    project = make(tmp_path / "p", "true", scenario)
    project.run("n=1", figures=False)
    assert list(rows(project, "file")) == [f"{tmp_path}/map.pgm"]


def test_comments_and_files_of_sierra_are_not_recorded_as_referenced_files(tmp_path: Path) -> None:
    template = '<e seed="0" n="0"><!-- <x file="results.csv"/>\n --><doc>sierra.toml t.xml figures/b/x.png</doc></e>'
    project = make(tmp_path / "p", "true", "[outputs.old]\nfile = 'old.csv'\nrequired = false\n", template)
    for name in ("results.csv", "old.csv"):
        (project.root / name).touch()
    subprocess.run(["git", "init", "-q", project.root], check=True)
    (project.root / ".gitignore").write_text("*.csv\n")
    assert [one.name for one in project.plan("n=1").programs.all if one.kind == "file"] == []


def test_tags_and_xpaths_are_not_recorded_as_referenced_files(tmp_path: Path) -> None:
    """`</x>` is not the file `/x`, and neither is the XPath `/x`."""
    for name in ("path", "value"):
        (tmp_path / f"{name}.pgm").touch()
    change = f"{{ set = '{tmp_path}/path.pgm', value = '{tmp_path}/value.pgm' }}"
    more = f"[variables.v]\nset = '{tmp_path}/path.pgm'\n[scenarios.s]\nchanges = [{change}]\n"
    project = make(tmp_path / "p", "true", more, '<e seed="0" n="0"><held.csv></held.csv><?held.csv?></e>')
    (project.root / "held.csv").touch()
    subprocess.run(["git", "init", "-q", project.root], check=True)
    (project.root / ".gitignore").write_text("*.csv\n")
    assert [one.name for one in project.plan("n=1").programs.all if one.kind == "file"] == [f"{tmp_path}/value.pgm"]


def test_closing_tags_are_not_looked_up_as_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    looked_at: list[Path] = []
    monkeypatch.setattr(referenced_files, "_is", lambda kind, path: looked_at.append(path))
    (tmp_path / "t.xml").write_text('<e><x a="/y/z"></x><w>b.c</w></e>')
    assert referenced_files.data([tmp_path / "t.xml"], (), tmp_path, set(), ("t.xml",)) == NOTHING
    assert {Path("/y/z"), tmp_path / "b.c"} <= set(looked_at)
    assert not {Path("/x"), Path("/e"), Path("/w")} & set(looked_at)


def test_a_note_reports_that_files_named_only_by_the_query_are_not_recorded(tmp_path: Path) -> None:
    more = f"[variables.map]\nchanges = [{{ set = '//e/@m', value = '{tmp_path}/maps/{{map}}' }}]\n"
    project = make(tmp_path / "p", "true", more, '<e seed="0" n="0" m=""/>')
    (tmp_path / "maps").mkdir()
    for name in ("a.pgm", "b.pgm"):
        (tmp_path / "maps" / name).write_text(name)
    (project.root / "held.pgm").touch()
    notes = project.plan("map=a.pgm,gone.pgm", sets=[("//e/@n", f"{tmp_path}/maps/b.pgm")]).notes
    named = sorted(note.split()[0] for note in notes if "named only by the query" in note)
    assert named == [f"{tmp_path}/maps/a.pgm", f"{tmp_path}/maps/b.pgm"]
    assert not [note for note in project.plan("n=held.pgm").notes if "named only by the query" in note]


def test_hostile_texts_of_a_template_are_not_recorded_as_referenced_files(tmp_path: Path) -> None:
    texts = ("a/" * 5000, "/" + "x" * 4000, "/dev/zero", "/proc/kcore", "..", "/", "./" * 2000, "\0/x", "file://nowhere/x")
    (tmp_path / "t.xml").write_text("".join(f'<e a="{text}"/>' for text in texts))
    assert referenced_files.data([tmp_path / "t.xml"], (), tmp_path, set(), ("t.xml",)) == NOTHING


INCLUDES = """\
import pathlib, re, sys

file = pathlib.Path(sys.argv[1])
included = file.parent / re.search('file="(.*?)"', file.read_text())[1]
pathlib.Path("out.csv").write_text(included.read_text())
"""


@pytest.mark.nightly
def test_a_note_for_a_failed_relative_include_says_how_to_reach_it(tmp_path: Path) -> None:
    project = make(tmp_path / "p", "python3 sim.py {input}", template='<e seed="0" n="0"><include file="parts/arm.xml"/></e>')
    (project.root / "sim.py").write_text(INCLUDES)
    (project.root / "parts").mkdir()
    (project.root / "parts" / "arm.xml").write_text("v\n1\n")
    failed = project.run("n=1", figures=False)
    assert failed.failed == 1
    [told] = [note for note in failed.notes if "relative path" in note]
    assert told.startswith("the template names 'parts/arm.xml' by a relative path: it is in the project")
    setting = 'files = ["parts"]'
    assert f"set {setting} in sierra.toml" in told
    toml = project.root / "sierra.toml"
    toml.write_text(f"{setting}\n{toml.read_text()}")
    mended = sierra.open(project.root).run("n=1", figures=False)
    assert (mended.executed, mended.failed) == (1, 0)
    assert not [note for note in mended.notes if "relative path" in note]


@pytest.mark.nightly
def test_a_relative_include_is_noted_only_if_failed_runs_mention_it(tmp_path: Path) -> None:
    template = '<e seed="0" n="0"><include file="arm.xml"/><other>no/such.xml</other></e>'
    project = make(tmp_path / "p", "sh sim.sh {input}", template=template)
    (project.root / "arm.xml").touch()
    script = project.root / "sim.sh"
    script.write_text("grep -q 'n=\"1\"' $1\n")
    assert [note for note in project.run("n=1,2", figures=False).notes if "relative path" in note] == []
    script.write_text("grep -q 'n=\"1\"' $1 || { echo cannot read arm.xml >&2; exit 1; }\n")
    assert ["'arm.xml'" in note for note in project.run("n=1,2", figures=False).notes if "relative path" in note] == [True]


@pytest.mark.nightly
def test_a_referenced_file_that_is_too_large_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(referenced_files, "MAX_SIZE", 3)
    (tmp_path / "map.pgm").write_text("four")
    project = make(tmp_path / "p", "true", template=f'<e seed="0" n="0"><map>{tmp_path}/map.pgm</map></e>')
    assert any("map.pgm" in note and "larger than 1 GB" in note for note in project.run("n=1", figures=False).notes)


@pytest.mark.integration
def test_a_replay_reports_changes_of_files_that_the_template_names(tmp_path: Path) -> None:
    (tmp_path / "map.pgm").write_text("one")
    project = make(tmp_path / "p", "sh sim.sh", template=f'<e seed="0" n="0"><map>{tmp_path}/map.pgm</map></e>')
    (project.root / "sim.sh").write_text(f"cat {tmp_path}/map.pgm > out.txt\n")
    batch = project.run("n=1", figures=False).batch
    same = project.replay(batch)
    assert (str(same.verdict), same.notes) == ("identical", ())
    (tmp_path / "map.pgm").write_text("two")
    other = project.replay(batch)
    assert str(other.verdict) == "different"
    assert [note.split(": ")[:2] for note in other.notes] == [["different programs", "map.pgm"]]


# ---------------------------------------------------------------- reports


def test_a_program_that_only_has_another_name_is_not_reported_as_changed() -> None:
    python, library = (Program(name, "", digest * 64) for name, digest in (("python3.11", "a"), ("sim", "b")))
    before = Programs((python, library))
    now = Programs((replace(python, name="python3"), library))
    assert list(fingerprint_programs.differences(before, now)) == ["python3.11 is named python3 now, with the same content"]
    assert before.unlike(now) == []
    changed = Programs((replace(python, name="python3"), replace(library, sha256="c" * 64)))
    assert before.unlike(changed) == ["sim"]
    assert list(fingerprint_programs.differences(before, changed)) == ["sim: bbbbbbbbbb recorded, cccccccccc found"]


@pytest.mark.parametrize("kind", [Kind.PROGRAM, Kind.FILE, Kind.LIBRARY])
def test_an_exchange_of_contents_is_a_change(kind: Kind) -> None:
    one, other = (Program(f"/d/{name}", f"/d/{name}", digest * 64, kind) for name, digest in (("f1", "a"), ("f2", "b")))
    exchanged = Programs((replace(one, sha256=other.sha256), replace(other, sha256=one.sha256)))
    assert Programs((one, other)).unlike(exchanged) == ["f1", "f2"]


@pytest.mark.integration
@pytest.mark.each_case
@pytest.mark.parametrize(("name", "after"), [("map.txt", "132"), ("map.txt", "113"), ("map.txt", "122"), ("sim", "132")])
def test_files_and_programs_of_one_name_are_told_apart(name: str, after: str, tmp_path: Path) -> None:
    """The contents 1, 2, 3 or 1, 1, 2 of three files change places, or one of them becomes that of another."""
    folder, before = tmp_path / "p", "123" if after == "132" else "112"
    paths = [tmp_path / place / name for place in "abc"]

    def write(contents: str) -> None:
        for path, content in zip(paths, contents, strict=True):
            path.parent.mkdir(exist_ok=True)
            path.write_text(f"#!/bin/sh\necho {content}\n" if name == "sim" else content)
            path.chmod(0o755)

    call = "$($1),$($2),$($3)" if name == "sim" else "$(cat $1),$(cat $2),$(cat $3)"
    make(folder, f"{{project}}/drive.sh {' '.join(map(str, paths))}", "[source]\npaths = ['drive.sh']")
    (folder / "sierra.toml").write_text((folder / "sierra.toml").read_text().replace("runs = 1", "runs = 1\nobserve = 'none'"))
    (folder / "drive.sh").write_text(f'#!/bin/sh\necho a,b,c > out.csv; echo "{call}" >> out.csv\n')
    (folder / "drive.sh").chmod(0o755)
    write(before)
    assert [projects.run(folder, "n=1")[0]["executed"] for _ in range(2)] == [1, 0]
    write(after)
    explained = projects.quick(folder, "run", "n=1", "--dry-run", "--explain").stdout
    [changed] = [path for path, was, now in zip(paths, before, after, strict=True) if was != now][:1]
    assert str(changed) in explained
    assert projects.run(folder, "n=1")[0]["executed"] == 1
    assert projects.sql(folder, "SELECT a, b, c FROM out") == [dict(zip("abc", map(int, after), strict=True))]
    assert str(changed) in projects.quick(folder, "why", projects.sql(folder, "SELECT batch FROM batches")[0]["batch"]).stdout
    assert projects.quick(folder, "fsck").returncode == 0
    write(before)
    assert projects.run(folder, "n=1")[0]["executed"] == 0


@pytest.mark.nightly
def test_a_store_that_does_not_tell_files_of_one_name_apart_is_sound_and_so_is_an_anonymous_package(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The records of earlier versions stay readable, but their executions do not count. Redacted records lack folders."""
    folder = tmp_path / "p"
    for place in "ab":
        (tmp_path / place).mkdir()
        (tmp_path / place / "map.txt").write_text(place)
    words = "{project}/drive.sh {project}/../a/map.txt {project}/../b/map.txt"
    described = "[package]\ntitle = 'x'\nauthors = [{name = 'Jane Qvist'}]\nlicense = 'MIT'"
    make(folder, words, f"[source]\npaths = ['drive.sh']\n{described}")
    (folder / "sierra.toml").write_text((folder / "sierra.toml").read_text().replace("runs = 1", "runs = 1\nobserve = 'none'"))
    (folder / "drive.sh").write_text("#!/bin/sh\necho x,y > out.csv; echo $(cat $1),$(cat $2) >> out.csv\n")
    (folder / "drive.sh").chmod(0o755)
    with monkeypatch.context() as patch:
        patch.setattr(dependency_model, "fingerprint", dependency_model.fingerprint_by_name)
        project = sierra.open(folder)
        assert project.run("n=1", figures=False).executed == 1
    assert sierra.open(folder).maintenance.fsck().sound
    assert [projects.run(folder, "n=1")[0]["executed"] for _ in range(2)] == [1, 0]
    assert sierra.open(folder).maintenance.fsck().sound
    [batch] = [one.batch for one in sierra.open(folder).batches]
    sierra.open(folder).packages.pack(batch, report=False, path=tmp_path / "one.zip", anonymous=True)
    with zipfile.ZipFile(tmp_path / "one.zip") as file:
        file.extractall(tmp_path / "one")
    other = sierra.open(tmp_path / "one" / "project")
    assert {"/redacted/1/map.txt", "/redacted/2/map.txt"} <= set(rows(other, "file"))
    assert other.maintenance.fsck().sound


@pytest.mark.parametrize(
    ("kind", "name"), [(Kind.LIBRARY, "libcore.so.1"), (Kind.DISTRIBUTIONS, f"python{dependency_model.INSTALLED}")]
)
def test_libraries_and_environments_of_one_name_are_told_apart_by_their_paths(kind: Kind, name: str) -> None:
    one, other = (Program(name, f"/{folder}/lib", digest * 64, kind) for folder, digest in ("a1", "b2"))
    before = Programs((one, other))
    now = Programs((replace(one, sha256=other.sha256), replace(other, sha256=one.sha256)))
    assert before.id != now.id
    assert before.id == Programs((other, one, one)).id
    assert before.unlike(now) == [f"/a/lib: {name}", f"/b/lib: {name}"]
    assert any("/a/lib" in line for line in fingerprint_programs.differences(before, now))


def test_equal_programs_of_one_name_are_identified_without_their_location() -> None:
    here, there = (Programs(tuple(Program(f"/{top}/{one}/sim", "", "a" * 64) for one in "ab")) for top in ("x", "y"))
    assert here.id == there.id == Programs(here.all[:1]).id


@pytest.mark.parametrize("kind", [Kind.FILE, Kind.LIBRARY])
def test_the_name_of_a_file_or_a_library_is_its_role(kind: Kind) -> None:
    one = Program("/d/f1", "/d/f1", "a" * 64, kind)
    assert Programs((one,)).unlike(Programs((replace(one, name="/d/f2"),))) == ["f1", "f2"]


def test_changed_programs_are_reported_by_version(tmp_path: Path) -> None:
    def used(version: str, digest: str, numpy: str, library: str) -> Programs:
        return Programs(
            (
                Program("argos3", "/x/argos3", digest * 64, version=version),
                Program("python3: installed distributions", "/l", numpy * 64, "distributions", f"numpy=={numpy}\nscipy==1"),
                Program("libc.so.6", "/lib/libc.so.6", library * 64, "library"),
            )
        )

    before = used("4.0.0", "a", "1", "c")
    assert list(fingerprint_programs.differences(before, before)) == []
    assert list(fingerprint_programs.differences(before, used("4.0.1", "b", "2", "d"))) == [
        "argos3: 4.0.0 (aaaaaaaaaa) recorded, 4.0.1 (bbbbbbbbbb) found",
        "python3: installed distributions: numpy 1 recorded, 2 found",
        "libraries that differ from the record: libc.so.6",
    ]
    alike = [Program(f"/{folder}/map.pgm", "", folder * 64, "file") for folder in "abc"]
    assert list(fingerprint_programs.differences(Programs(tuple(alike[:2])), Programs((alike[0], alike[2])))) == [
        "/b/map.pgm: bbbbbbbbbb recorded, not found",
        "/c/map.pgm: not recorded, cccccccccc found",
    ]
    assert list(fingerprint_programs.differences(Programs(before.all[:1]), NOTHING)) == [
        "argos3: 4.0.0 (aaaaaaaaaa) recorded, not found"
    ]


@pytest.mark.nightly
def test_show_displays_the_environment_and_programs_of_batches_and_executions(tmp_path: Path) -> None:
    """The text is a summary, the JSON is complete."""
    project = make(tmp_path / "p", "true")
    batch = project.run("n=1", figures=False).batch
    [execution] = project.sql("SELECT execution FROM executions").column(0).to_pylist()
    for shown in (batch, execution):
        text = projects.quick(project.root, "show", shown).stdout
        assert "true (GNU coreutils)" in text
        assert "libc.so.6" in text
        assert max(len(line) for line in text.splitlines() if line.startswith("  cpu_flags")) < 300
        whole = json.loads(projects.quick(project.root, "show", shown, "--json").stdout)
        assert {row["name"] for row in whole["programs"]} >= {"true", "libc.so.6"}
        assert whole["environment"]["limits"]["nofile"][0] > 0
        assert len(whole["environment"]["distributions"]) > 5


def test_packages_that_the_simulator_uses_are_reported_first(tmp_path: Path) -> None:
    (tmp_path / "sim.py").write_text("import sys\nfrom mujoco import MjModel\n")
    words = dependency_model.mentioned(("python3", "{project}/sim.py", "{input}"), tmp_path)
    names = ["attrs", "certifi", "glfw", "mujoco", "pip", "setuptools", "numpy"]
    assert dependency_model.by_likelihood(names, words) == ["mujoco", "attrs", "glfw", "numpy", "certifi", "pip", "setuptools"]
    assert dependency_model.by_likelihood(
        ["adduser", "argos3-simulator", "apt"], dependency_model.mentioned(("argos3", "-c"), tmp_path)
    ) == [
        "argos3-simulator",
        "adduser",
        "apt",
    ]
    installed = [
        Programs(
            (
                Program("python3: installed distributions", "/x", digit * 64, Kind.DISTRIBUTIONS, text),
                Program("sim", "/s", digit),
            )
        )
        for digit, text in (("a", "\n".join(f"{name}==1" for name in names)), ("b", "\n".join(f"{name}==2" for name in names)))
    ]
    told = list(fingerprint_programs.differences(installed[0], installed[1], words))
    assert told[0].startswith("sim: ")
    assert told[1].startswith("python3: installed distributions: mujoco 1 recorded, 2 found, attrs")
    _, seen = fingerprint_programs.differences(installed[0], installed[1], words, ["numpy", "glfw"])
    listed = [part.split()[0] for part in seen.partition("distributions: ")[2].split(", ")[::2]]
    assert listed[:4] == ["mujoco", "numpy", "glfw", "attrs"]


def test_spellings_of_a_distribution_are_one(tmp_path: Path) -> None:
    def installed(text: str, digest: str) -> Programs:
        return Programs((Program("python3: installed distributions", "/x", digest * 64, Kind.DISTRIBUTIONS, text),))

    before, now = (
        installed("JSBSim==1.2\nRuamel.YAML==1\nzip_x==1", "a"),
        installed("jsbsim==1.3\nruamel-yaml==1\nzip-x==1", "b"),
    )
    assert list(fingerprint_programs.differences(before, now)) == [
        "python3: installed distributions: jsbsim 1.2 recorded, 1.3 found"
    ]
    found = []
    for folder, name in (("one", "JSBSim"), ("two", "jsbsim")):
        (tmp_path / folder / f"{name}-1.2.dist-info").mkdir(parents=True)
        found += [one.line for one in pythons.distributions([tmp_path / folder])]
    assert found == ["jsbsim==1.2"] * 2
