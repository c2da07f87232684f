"""Changes of files that no command, variable or template names are noticed, because runs were observed to use the files."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from tests import projects

QUERY = "population_size=1,2"
VALUES = "SELECT DISTINCT value FROM swarm ORDER BY ALL"
MAIN = r"""
#include <dlfcn.h>
#include <stdio.h>
#include <stdlib.h>
int main(int argc, char **argv) {
    char path[4096];
    snprintf(path, sizeof path, "%s/libphysics.so", getenv("PLUGINS"));
    void *plugin = dlopen(path, RTLD_NOW);
    if (!plugin) { fprintf(stderr, "%s\n", dlerror()); return 1; }
    double (*force)(void) = (double (*)(void)) dlsym(plugin, "force");
    FILE *file = fopen("swarm.csv", "w");
    fprintf(file, "tick,value\n0,%g\n", force());
    return fclose(file);
}
"""
PLUGIN = "double force(void) {{ return {force}; }}\n"


@pytest.fixture
def build(tmp_path: Path, require: Callable[..., str]) -> Callable[..., Path]:
    """Compile a text in C into a file."""
    require("strace")
    require("gcc")

    def build(text: str, file: Path, *options: str) -> Path:
        source = tmp_path / "source.c"
        source.write_text(text)
        file.parent.mkdir(parents=True, exist_ok=True)
        subprocess.run(["gcc", "-w", *options, "-o", file, source, "-ldl"], check=True)
        return file

    return build


def project(folder: Path, command: str, *, observe: str = "first", more: str = "") -> Path:
    config = projects.CONFIG.replace("python3 sim.py {input}", command).replace("runs = 2", f'runs = 2\nobserve = "{observe}"')
    return projects.make(folder, config + more)


@pytest.fixture
def simulator(tmp_path: Path, build: Callable[..., Path]) -> Path:
    """A project with an installed simulator in C, which loads a plug-in that nothing declares; returns the project's folder."""
    program = build(MAIN, tmp_path / "usr" / "bin" / "simulator")
    library = build(PLUGIN.format(force=1), tmp_path / "usr" / "lib" / "libphysics.so", "-shared", "-fPIC")
    return project(
        tmp_path / "project", f"{program} {{input}}", more=f'[environment]\nset = {{ PLUGINS = "{library.parent}" }}\n'
    )


@pytest.fixture
def rebuild(simulator: Path, build: Callable[..., Path]) -> Callable[[int], Path]:
    """Build the plug-in again, with another force."""
    return lambda force: build(
        PLUGIN.format(force=force), simulator.parent / "usr" / "lib" / "libphysics.so", "-shared", "-fPIC"
    )


def test_a_plug_in_that_was_rebuilt_executes_all_runs_again(simulator: Path, rebuild: Callable[[int], Path]) -> None:
    projects.run(simulator, QUERY)
    rebuild(300)
    summary, said = projects.run(simulator, QUERY)
    assert (summary["executed"], "libphysics.so" in said) == (4, True)
    assert projects.sql(simulator, VALUES) == [{"value": 300}]


def test_more_runs_are_never_mixed_with_those_of_another_plug_in(simulator: Path, rebuild: Callable[[int], Path]) -> None:
    projects.run(simulator, QUERY)
    rebuild(300)
    summary, _ = projects.run(simulator, QUERY, "--runs", "5")
    assert summary["executed"] == 10
    shown = json.loads(projects.quick(simulator, "stats", "swarm", "value", "--format", "json").stdout)
    assert {(row["mean"], row["sd"]) for row in shown} == {(300, 0)}


@pytest.mark.nightly
def test_a_plug_in_that_was_rebuilt_without_a_change_executes_nothing(simulator: Path, rebuild: Callable[[int], Path]) -> None:
    projects.run(simulator, QUERY)
    rebuild(1)
    assert projects.run(simulator, QUERY)[0]["executed"] == 0


def test_an_edited_file_of_an_installed_package_executes_all_runs_again(tmp_path: Path, require: Callable[..., str]) -> None:
    require("strace")
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", tmp_path / "venv"], check=True)
    [packages] = (tmp_path / "venv").glob("lib/python3*/site-packages")
    (packages / "physics.py").write_text("force = 1\n")
    root = project(tmp_path / "project", f"{tmp_path}/venv/bin/python3 sim.py {{input}}")
    (root / "sim.py").write_text(
        "import physics\nprint('tick,value', f'0,{physics.force}', sep='\\n', file=open('swarm.csv', 'w'))\n"
    )
    projects.run(root, QUERY)
    (packages / "physics.py").write_text("force = 300\n")
    assert projects.run(root, QUERY)[0]["executed"] == 4
    assert projects.sql(root, VALUES) == [{"value": 300}]


@pytest.mark.nightly
def test_a_script_that_the_input_names_by_its_absolute_path_is_noticed(tmp_path: Path, require: Callable[..., str]) -> None:
    require("strace")
    script = tmp_path / "scripts" / "controller.lua"
    script.parent.mkdir()
    script.write_text("1")
    root = project(tmp_path / "project", "python3 sim.py {input}")
    (root / "arena.xml").write_text(projects.TEMPLATE.replace('controller="none"', f'controller="{script}"'))
    (root / "sim.py").write_text(
        "import sys\n"
        "script = open(sys.argv[1]).read().split('controller=\"')[1].split('\"')[0]\n"
        "print('tick,value', f'0,{open(script).read()}', sep='\\n', file=open('swarm.csv', 'w'))\n"
    )
    batch = projects.run(root, QUERY)[0]["batch"]
    script.write_text("300")
    done = projects.quick(root, "replay", batch[:10])
    assert (done.returncode, "controller.lua" in done.stdout + done.stderr) == (1, True)
    assert projects.run(root, QUERY)[0]["executed"] == 4
    assert projects.sql(root, VALUES) == [{"value": 300}]


@pytest.mark.nightly
def test_products_that_a_build_makes_again_execute_nothing_if_they_are_the_same(
    tmp_path: Path, build: Callable[..., Path]
) -> None:
    """A variable names the build folder, in which a second build changes files that no run reads."""
    root = project(
        tmp_path / "project",
        "{project}/simulator {input}",
        observe="all",
        more='[environment]\nset = { PLUGINS = "{project}/build" }\n',
    )
    build(MAIN, root / "simulator")
    build(PLUGIN.format(force=1), root / "build" / "libphysics.so", "-shared", "-fPIC")
    (root / ".gitignore").write_text("build\n.sierra\n")
    (root / "build" / "CMakeCache.txt").write_text("1")
    projects.commit(root)
    assert projects.run(root, QUERY)[0]["executed"] == 4
    build(PLUGIN.format(force=1), root / "build" / "libphysics.so", "-shared", "-fPIC")
    (root / "build" / "CMakeCache.txt").write_text("2")
    assert projects.run(root, QUERY)[0]["executed"] == 0
    build(PLUGIN.format(force=300), root / "build" / "libphysics.so", "-shared", "-fPIC")
    assert projects.run(root, QUERY)[0]["executed"] == 4
    assert projects.sql(root, VALUES) == [{"value": 300}]


BOUND = 'mount --bind "$1" /etc/ld.so.cache && shift && exec "$@"'


def test_a_library_that_the_loader_finds_elsewhere_executes_all_runs_again(
    tmp_path: Path, build: Callable[..., Path], require: Callable[..., str]
) -> None:
    """The loader's cache finds the library in a folder that comes first since, and the old file is unchanged."""
    alone = ("unshare", "--mount", "--propagation", "private", "sh", "-c", BOUND, "sh")
    possible = subprocess.run([*alone, "/etc/ld.so.cache", "true"], check=False, capture_output=True).returncode == 0
    require("the right to mount a file", there=possible)
    name, cache, settings = "libsierra_test.so", tmp_path / "cache", tmp_path / "conf"
    folders = [tmp_path / "first", tmp_path / "second"]
    program = build(MAIN.replace('"%s/libphysics.so", getenv("PLUGINS")', f'"{name}"'), tmp_path / "simulator")
    build(PLUGIN.format(force=1), folders[1] / name, "-shared", "-fPIC", f"-Wl,-soname,{name}")
    folders[0].mkdir()
    root = project(tmp_path / "project", f"{program} {{input}}")
    settings.write_text(f"{folders[0]}\n{folders[1]}\ninclude /etc/ld.so.conf\n")

    def executed(found_first: Path = tmp_path / "nowhere") -> int:
        subprocess.run(["ldconfig", "-C", cache, "-f", settings], check=True)
        words = (projects.SIERRA, "run", QUERY, "--no-figures", "--json")
        variables = {**os.environ, "PATH": f"{found_first}{os.pathsep}{os.environ['PATH']}"}
        done = subprocess.run([*alone, cache, *words], cwd=root, env=variables, check=False, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        return int(json.loads(done.stdout)["executed"])

    assert executed() == 4
    build(PLUGIN.format(force=5), folders[0] / "libunused.so", "-shared", "-fPIC", "-Wl,-soname,libunused.so")
    assert executed() == 0
    build(PLUGIN.format(force=300), folders[0] / name, "-shared", "-fPIC", f"-Wl,-soname,{name}")
    assert executed() == 4
    assert projects.sql(root, VALUES) == [{"value": 300}]
    broken = tmp_path / "broken"
    broken.mkdir()
    (broken / "ldconfig").write_text("#!/nowhere/sh\n")
    (broken / "ldconfig").chmod(0o755)
    build(PLUGIN.format(force=5), folders[0] / "libunused2.so", "-shared", "-fPIC", "-Wl,-soname,libunused2.so")
    assert executed(broken) == 4  # what the changed cache finds is not known


@pytest.mark.nightly
def test_a_replay_names_the_plug_in_and_not_chance(simulator: Path, rebuild: Callable[[int], Path]) -> None:
    batch = projects.run(simulator, QUERY)[0]["batch"]
    rebuild(300)
    done = projects.quick(simulator, "replay", batch[:10])
    said = done.stdout + done.stderr
    assert (done.returncode, "libphysics.so" in said, "chance" in said) == (1, True, False)


@pytest.mark.parametrize("what", ["data", "folder", "program"])
def test_a_link_that_leads_elsewhere_is_noticed(tmp_path: Path, require: Callable[..., str], what: str) -> None:
    """Nothing changes but a link: to a file that is read, to a folder that is listed, or to a program that a script starts."""
    require("strace")
    for version in ("1", "2"):
        folder = tmp_path / f"v{version}"
        folder.mkdir()
        (folder / "value").write_text(version)
        (folder / f"a{version}.map").write_text("")
        (folder / "solver").write_text(f"#!/bin/sh\nprintf 'tick,value\\n0,{version}\\n' > swarm.csv\n")
        (folder / "solver").chmod(0o755)
    current = tmp_path / "current"
    place = {"data": "value", "folder": "", "program": "solver"}[what]
    current.symlink_to(tmp_path / "v1" / place)
    root = project(tmp_path / "project", "sh run.sh {input}")
    scripts = {
        "data": f"read value < {current}; printf 'tick,value\\n0,%s\\n' $value > swarm.csv",
        "folder": f"cd {current}; set -- *.map; v=${{1#a}}; cd - >&2; printf 'tick,value\\n0,%s\\n' ${{v%.map}} > swarm.csv",
        "program": f"exec {current}",
    }
    (root / "run.sh").write_text(scripts[what] + "\n")
    projects.run(root, QUERY)
    assert projects.sql(root, VALUES) == [{"value": 1}]
    assert projects.run(root, QUERY)[0]["executed"] == 0
    current.unlink()
    current.symlink_to(tmp_path / "v2" / place)
    assert projects.run(root, QUERY)[0]["executed"] == 4
    assert projects.sql(root, VALUES) == [{"value": 2}]


ATTACKS = {
    "a listed folder": ("ls {data}/maps | wc -l", "touch {data}/maps/b"),
    "a tested file": ("[ -e {data}/flag ] && echo 1 || echo 0", "rm {data}/flag"),
    "a size": ("stat -c %s {data}/flag", "echo longer > {data}/flag"),
    "a file in a cache": ("cat {cache}/model", "echo 2 > {cache}/model"),
    "a file that is opened for writing too": ("flock {data}/value cat {data}/value", "echo 2 > {data}/value"),
    "a name that is not UTF-8": ("cat {data}/$(printf '\\377')", "echo 2 > {data}/$(printf '\\377')"),
    "a pipe": ("cat {data}/value", "rm {data}/value; mkfifo {data}/value"),
    "a program behind a link": ("{data}/link", "ln -sfn other {data}/link"),
}


@pytest.mark.parametrize("attack", ATTACKS)
def test_each_change_of_what_runs_depend_on_executes_them_again(
    tmp_path: Path, require: Callable[..., str], attack: str
) -> None:
    require("strace")
    data, cache = tmp_path / "data", Path(os.environ["XDG_CACHE_HOME"], "sierra-test")
    read, change = (text.format(data=data, cache=cache) for text in ATTACKS[attack])
    (data / "maps").mkdir(parents=True)
    cache.mkdir(parents=True, exist_ok=True)
    for file in (data / "maps" / "a", data / "flag", data / "value", cache / "model", data / os.fsdecode(b"\377")):
        file.write_text("1\n")
    for name in ("one", "other"):
        (data / name).mkdir()
        (data / name / "program").write_text("#!/bin/sh\ncat $(dirname $(readlink -f $0))/number\n")
        (data / name / "program").chmod(0o755)
        (data / name / "number").write_text(f"{name}\n")
    (data / "current").symlink_to("one")
    (data / "link").symlink_to("one/program")
    if "link" in attack:
        change = f"ln -sfn other/program {data}/link"
    root = project(tmp_path / "project", "sh run.sh {input}")
    (root / "run.sh").write_text(f"(echo value; {read}) > swarm.csv\n")
    projects.run(root, QUERY)
    assert projects.run(root, QUERY)[0]["executed"] == 0
    subprocess.run(["sh", "-c", change], check=True)
    if attack == "a pipe":
        done = projects.quick(root, "run", QUERY, "-n", "--json")
        assert json.loads(done.stdout)["to_execute"] == 4
        return
    assert projects.run(root, QUERY)[0]["executed"] == 4
    assert projects.run(root, QUERY)[0]["executed"] == 0
