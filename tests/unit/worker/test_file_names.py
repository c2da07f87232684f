"""Names of files that are the same on every machine, and what is no input."""

from __future__ import annotations

from pathlib import Path

import pytest

from sierra.worker import file_names
from sierra.worker.file_names import Names
from sierra.worker.file_trace import Trace
from tests.strace_logs import calls


def reread(roots: dict[str, str], *paths: str) -> tuple[str, ...]:
    """Return those of the paths that are noted if a run opens them for both."""
    opened = 'openat(AT_FDCWD</w>, "{0}", O_RDWR|O_CREAT, 0666) = 3<{0}>'
    return Names({"run": "/r", **roots}).inputs(calls(*map(opened.format, paths))).reread


def test_caches_are_no_data_of_a_run_where_caches_lie() -> None:
    roots = {"home": "/h", "cache": "/c", "project": "/h/.p", "work": "/h/.p/.sierra/work/s", "store": "/h/.p/.sierra"}
    caches = ("/h/.cache/mesa_shader_cache/index", "/c/numba/a", "/c/app/qtshadercache-x86_64/a", "/h/.nv/ComputeCache/c")
    caches += ("/h/.julia/compiled/v1.10/A/b.ji", "/h/.theano/compiledir_Linux/tmp/mod.so", "/tmp/torchinductor_me/a")
    caches += ("/var/tmp/OptixCache_me/optix7cache.db", "/h/.cache/huggingface/hub/models--a/refs/main", "/c/keops2.1/a")
    caches += ("/x/__pycache__/a.nbi", "/x/a.pyc.12", "/h/.p/__pycache__/a.pyc", "/dev/shm/fastrtps_port7411")
    data = ("/h/numba/a", "/h/jax/a", "/h/.cache/jax-swarm/a", "/h/.cache/a/b/numba/c", "/h/.p/.triton/a", "/h/.p/ccache/a")
    data += ("/h/.p/.sierra/a", "/h/.p/.sierra/work/a", "/h/.p/.sierra/work/s/a", "/h/.p/.sierra/work/s/numba/a")
    data += ("/tmp/matplotlib/a", "/tmp/a/torchinductor_b/c", "/x/triton_v2/a", "/x/compiled/v1.2/a", "/x/.cache/numba/a")
    assert reread(roots, *caches, *data, "/r/home/.cache/numba/a", "/h/.p/.sierra/work/s/r/a") == tuple(
        sorted((*data, "/h/.p/.sierra/work/s/r/a"))
    )
    assert Names(roots).name("/h/.p/.sierra/work/s/a") == "{store}/work/s/a"


def test_names_that_still_exist_are_recorded_first_if_there_are_too_many(tmp_path: Path) -> None:
    (tmp_path / "z").write_text("x")
    many = [f"{tmp_path}/{number:04}" for number in range(file_names.MOST_REREAD)]
    trace = Trace("strace", reread=(*many, f"{tmp_path}/z"))
    cut = Names({}).inputs(trace)
    assert (cut.reread, cut.complete) == ((*many[:-1], f"{tmp_path}/z"), False)
    whole = Names({}).inputs(trace._replace(reread=tuple(many)))
    assert (whole.reread, whole.complete) == (tuple(many), True)


def test_a_checkout_in_the_store_is_the_project() -> None:
    names = Names({"store": "/p/.sierra", "project": "/p/.sierra/work/1/source", "run": "/p/.sierra/work/1/7"})
    trace = names.inputs(Trace("strace", executed=("/p/.sierra/work/1/source/sim", "/p/.sierra/work/1/7/x", "/p/.sierra/y")))
    assert [names.name(path) for path in trace.executed] == ["{project}/sim"]


def names(tmp_path: Path) -> Names:
    roots = {"project": "p", "run": "p/.sierra/work/1/7", "store": "p/.sierra", "home": "h", "prefix": "venv"}
    return Names({name: str(tmp_path / folder) for name, folder in roots.items()})


def test_names_are_the_same_on_every_machine(tmp_path: Path) -> None:
    given = names(tmp_path)
    assert given.name(f"{tmp_path}/p/a b") == "{project}/a b"
    assert given.name(f"{tmp_path}/p") == "{project}"
    assert given.name(f"{tmp_path}/px") == f"{tmp_path}/px"
    assert given.name(f"{tmp_path}/p/.sierra/work/1/7/output/x") == "{run}/output/x"
    assert (
        given.name(f"{tmp_path}/venv/lib/python3.11/site-packages/numpy/x.py")
        == "{prefix}/lib/python3.11/site-packages/numpy/x.py"
    )
    assert given.name("/usr/lib/x.so") == "/usr/lib/x.so"


def test_names_know_roots_behind_links(tmp_path: Path) -> None:
    (tmp_path / "real").mkdir()
    (tmp_path / "link").symlink_to("real")
    given = Names({"project": str(tmp_path / "link")})
    assert given.name(f"{tmp_path}/link/x") == given.name(f"{tmp_path.resolve()}/real/x") == "{project}/x"


def test_what_is_no_input_is_left_out(tmp_path: Path) -> None:
    given = names(tmp_path)
    for path in ("/proc/self/maps", "/dev/null", "/sys/x", "/var/cache/fontconfig/x"):
        assert given.left_out(path)
    for path in ("h/.cache/fontconfig/x", "p/.sierra/x", "p/.sierra/work/1/7/home/.config"):
        assert given.left_out(f"{tmp_path}/{path}")
    for path in ("p/x", "h/.config/x", "h/.cached", "h/.cache/model.bin", "venv/x.pyc"):
        assert given.left_out(f"{tmp_path}/{path}") is None
    assert given.left_out("/dev/shm/x") is None


def test_a_checkout_in_the_store_has_the_names_of_the_project(tmp_path: Path) -> None:
    checkout, project = tmp_path / "p/.sierra/work/1/source", tmp_path / "p"
    given = Names({"project": str(checkout), "project:given": str(project), "store": str(project / ".sierra"), "home": "/root"})
    for folder in (checkout, project):
        assert given.name(f"{folder}/sim.py") == "{project}/sim.py"
        assert given.left_out(f"{folder}/sim.py") is None
    assert given.left_out(f"{tmp_path}/p/.sierra/work/1/journal.jsonl")


def test_a_run_in_a_checkout_does_not_miss_what_no_checkout_has(tmp_path: Path) -> None:
    roots = {"project": str(tmp_path / "checkout"), "unlisted:0": f"{tmp_path}/p/.git", "unlisted:1": f"{tmp_path}/p/in.xml"}
    missed = tuple(f"{tmp_path}/checkout/{name}" for name in (".git", ".git/HEAD", ".gitx", "in.xml", "plugin.so"))
    inputs = Names({**roots, "project:given": str(tmp_path / "p")}).inputs(Trace("strace", missed=missed))
    assert [Path(path).name for path in inputs.missed] == [".gitx", "plugin.so"]
    assert Names(roots).inputs(Trace("strace", missed=missed)).missed == missed


def test_the_existence_of_folders_above_a_run_is_no_input(tmp_path: Path) -> None:
    given = Names({"project": str(tmp_path / "p"), "run": "/scratch/s/runs/7", "work": "/scratch/s"})
    found = (
        "/",
        "/scratch",
        "/scratch/other",
        "/scratch/s",
        "/scratch/s/runs",
        str(tmp_path),
        f"{tmp_path}/p",
        f"{tmp_path}/p/x",
    )
    assert given.inputs(Trace("strace", found=found)).found == ("/scratch/other", f"{tmp_path}/p/x")


def test_a_compiled_module_stands_for_its_source(tmp_path: Path) -> None:
    module = tmp_path.resolve() / "p" / "m.py"
    (module.parent / "__pycache__").mkdir(parents=True)
    module.touch()
    compiled = module.parent / "__pycache__" / "m.cpython-311.pyc"
    orphan = module.parent / "__pycache__" / "gone.cpython-311.pyc"
    trace = Trace("strace", read=(str(compiled), str(orphan)), found=(str(module),), written=(f"{compiled}.123",))
    inputs = names(tmp_path.resolve()).inputs(trace)
    assert inputs.read == (str(orphan), str(module))
    assert inputs.found == inputs.written == ()


@pytest.mark.parametrize(("flags", "counts"), [(0, False), (3, False), (1, True)])
def test_a_compiled_module_that_python_does_not_compare_counts_itself(tmp_path: Path, flags: int, *, counts: bool) -> None:
    module = tmp_path.resolve() / "p" / "m.py"
    (module.parent / "__pycache__").mkdir(parents=True)
    module.touch()
    compiled = module.parent / "__pycache__" / "m.cpython-311.pyc"
    compiled.write_bytes(b"\xa7\r\r\n" + flags.to_bytes(4, "little") + bytes(8))
    inputs = names(tmp_path.resolve()).inputs(Trace("strace", read=(str(compiled),)))
    assert (str(compiled) in inputs.read) is counts


def test_that_roots_and_the_folders_above_them_exist_is_left_out(tmp_path: Path) -> None:
    place = tmp_path.resolve()
    trace = Trace("strace", found=(str(place), str(place / "h"), str(place / "p" / "x"), "/usr"))
    assert names(place).inputs(trace).found == (str(place / "p" / "x"), "/usr")
