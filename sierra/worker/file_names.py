"""Names of files that are the same on every machine, and rules for what is no input of a run at all."""

from __future__ import annotations

import os
import re
from typing import Any, Iterator, Mapping, Sequence

from sierra.worker.changed_names import with_folders
from sierra.worker.file_trace import LISTS, Trace
from sierra.worker.python_files import PYTHON_CACHE, counts_itself, source_of

MOST_REREAD = 1000
TOO_MANY_REREAD = "it wrote and read more than %d files outside its folder" % MOST_REREAD
KERNEL = ("/proc", "/sys", "/dev")
SHARED_MEMORY = "/dev/shm"  # noqa: S108 - what another program has left there may be an input
OWN_ROOTS = {"run": "the run's own folder", "work": "a folder of runs", "store": "the store"}
OF_RUNS = ("project", "work", "store")
"""Folders in which there are no caches, but files that several runs may use."""
UNLISTED = "unlisted"
CACHES = ("/var/cache/fontconfig", "/usr/share/fonts/.uuid", "/usr/lib/fontconfig/cache")
CACHING = ("fontconfig", "matplotlib", "mesa_shader_cache", "mesa_shader_cache_db", "nvidia", "pip", "uv/.lock")
"""Folders in a user's cache that only make programs faster. All else there may be an input: an environment, a model."""
KEPT = (
    r"s?ccache|numba|triton|theano|pycuda|cupy|pocl|pyopencl|keops[\d.]*|jax|ptxas|torchinductor_[^/]*|torch_extensions|"
    r"ComputeCache|GLCache|OptixCache[^/]*|mesa_shader_cache\w*|qtshadercache[\w.-]*|qtpipelinecache[\w.-]*|QtProject|"
    r"gstreamer-\d[\w.]*|huggingface/(?:hub|datasets|modules|xet)|fontconfig|font[\w-]*cache|matplotlib|ksycoca[\w=+-]*|dconf"
)
KEPT_IN_CACHE = re.compile(r"(?:[^/]+/)?(?:%s)(?:/.*)?" % KEPT, re.S)
"""Files that programs keep to be faster, as they are named in a user's cache, perhaps in a program's own folder there."""
KEPT_IN_HOME = re.compile(
    r"\.(?:%s|nv|aesara|pytensor|julia/compiled/v\d+\.\d+|config/(?:dconf|QtProject\.conf))(?:/.*)?" % KEPT, re.S
)
KEPT_IN_TMP = re.compile(r"/(?:var/)?tmp/(?:torchinductor_[^/]*|OptixCache[^/]*|numba_cache|jax_cache|kdecache-[^/]*)/.*", re.S)
KEPT_ANYWHERE = re.compile(r".*/__pycache__/.*|.*\.py[co](?:\.\d+)?", re.S)
CHANNELS = re.compile(r"/dev/shm/(?:sem\.)?(?:fastrtps|fastdds|fast_datasharing|iceoryx|iox)[^/]*", re.S)  # noqa: S108 - no file is made there
"""Memory by which programs talk to each other."""


class Names:
    """Names of files that are the same on every machine, and rules for what is no input at all.

    `roots` maps names to folders, for example project, home, prefix (the virtual environment of the runs' Python), run (the
    run's own folder, with its output and temporary files), work (where runs have their folders), store, cache
    (XDG_CACHE_HOME). A path below a root is named `{root}/…`, by the deepest root. All other paths are their own names. If
    several folders have one name, their keys end in a colon and a word: `project`, `project:given`. No path is named by `work`:
    only files that runs share have names there, and these are different files in each session.

    Left out: what the kernel makes up (/proc, /sys, and /dev except the shared memory in /dev/shm); what is below run, work
    and store, unless a deeper root is not among these (a checkout of the project in the store); what is in a cache only for
    speed (CACHES, and CACHING in cache and in home's `.cache`); and Python's compiled modules (`__pycache__`), if their source
    is there. Python has compared its size and time then, and so the source counts; a compiled module that says that it is not
    to be compared counts itself. Listed folders of a Python's packages are kept: a program may try to import an optional one.
    The existence of roots and of the folders above them is no input, because it depends on where the run's folder is.

    Paths with the name `unlisted` are those that a checkout of the project lacks, for example the template: they do not count
    in a listed folder. If there is `project:given`, the runs are executed in a checkout, where they are not missed either.
    """

    def __init__(self, roots: Mapping[str, str]) -> None:
        named = [(name.partition(":")[0], given) for name, given in roots.items()]
        pairs = {(real(given), name) for name, given in named for real in (os.path.abspath, os.path.realpath)}
        self._unlisted = frozenset(folder for folder, name in pairs if name == UNLISTED)
        self._roots = sorted((pair for pair in pairs if pair[1] != UNLISTED), key=lambda pair: (-len(pair[0]), pair))
        self._lacking = tuple(lacking(roots)) if "project:given" in roots else ()
        folders = [os.fsencode(folder) for folder, _ in self._roots]
        self._above = {"/", *(os.fsdecode(above) for folder in folders for above in with_folders(folder))}
        kept = [folder for folder, name in pairs if name == "cache"]
        kept += [os.path.join(folder, ".cache") for folder, name in pairs if name == "home"]
        self._caches = (*CACHES, *(os.path.join(folder, name) for folder in kept for name in CACHING))
        homes = [(folder, KEPT_IN_HOME) for folder, name in pairs if name == "home"]
        self._keepers = (*((folder, KEPT_IN_CACHE) for folder in kept), *homes)

    def name(self, path: str) -> str:
        """Return the name of an absolute path."""
        for folder, name in self._roots:
            if name != "work" and is_below(path, folder):
                return "{%s}%s" % (name, path[len(folder.rstrip("/")) :])
        return path

    def _root_of(self, path: str) -> str | None:
        return next((name for folder, name in self._roots if is_below(path, folder)), None)

    def left_out(self, path: str) -> str | None:
        """Return what makes a path no input; None if it is one."""
        if any(is_below(path, folder) for folder in KERNEL) and not is_below(path, SHARED_MEMORY):
            return "the kernel"
        root = self._root_of(path)
        if root in OWN_ROOTS:
            return OWN_ROOTS[root]
        if any(is_below(path, folder) for folder in self._caches):
            return "a cache"
        if "/%s/" % PYTHON_CACHE in path + "/" and not (path.endswith(".pyc") and counts_itself(path)):
            return "Python's compiled modules"
        return None

    def is_listed(self, path: str) -> bool:
        """Return whether a path counts in the folder that it is in, if a run lists this folder."""
        return path not in self._unlisted and not self.left_out(path)

    def _is_data(self, path: str) -> bool:
        """Return whether a file that a run wrote and read may have data of another run. Only its own folder is its own."""
        root = self._root_of(path)
        if root == "run" or KEPT_ANYWHERE.fullmatch(path):
            return False
        return root in OF_RUNS or not (self.left_out(path) or self._is_kept(path))

    def _is_kept(self, path: str) -> bool:
        """Return whether a program keeps a file to be faster, or in order to talk to others."""
        if KEPT_IN_TMP.fullmatch(path) or CHANNELS.fullmatch(path):
            return True
        return any(is_below(path, folder) and form.fullmatch(path[len(folder) + 1 :]) for folder, form in self._keepers)

    def inputs(self, trace: Trace) -> Trace:
        """Return a trace without what is left out.

        A Python source of which only the status was requested counts as read: Python has read its compiled copy instead.
        """
        lists = {name: [path for path in getattr(trace, name) if not self.left_out(path)] for name in LISTS}
        sources = {os.path.realpath(path) for path in lists["found"] if path.endswith(".py") and os.path.isfile(path)}
        compiled = {source_of(path) for path in trace.read if path.endswith(".pyc")}
        sources |= {os.path.realpath(path) for path in compiled if path is not None and not self.left_out(path)}
        lists["read"] = sorted((sources | set(lists["read"])) - set(trace.executed))
        lists["missed"] = [path for path in lists["missed"] if not any(is_below(path, absent) for absent in self._lacking)]
        lists["found"] = [path for path in lists["found"] if path not in self._above and os.path.realpath(path) not in sources]
        links = {path: real for path, real in trace.links.items() if not self.left_out(path) and not self.left_out(real)}
        again, new = (list(filter(self._is_data, paths)) for paths in (trace.reread, trace.reread_new))
        reasons = (*trace.reasons, TOO_MANY_REREAD) if max(len(again), len(new)) > MOST_REREAD else trace.reasons
        channels = tuple((self.name(name) if name.startswith("/") else name, use) for name, use in trace.channels)
        kept: dict[str, Any] = {name: tuple(paths) for name, paths in lists.items()}
        kept.update(reread=most_lasting(again), reread_new=most_lasting(new))
        return trace._replace(links=links, channels=channels, reasons=reasons, **kept)


def most_lasting(paths: Sequence[str]) -> tuple[str, ...]:
    """Return as many paths as are recorded, sorted; names that still exist come first, because others may use them, too."""
    if len(paths) <= MOST_REREAD:
        return tuple(paths)
    return tuple(sorted(sorted(paths, key=lambda path: not os.path.lexists(path))[:MOST_REREAD]))


def lacking(roots: Mapping[str, str]) -> Iterator[str]:
    """Yield the paths that a checkout of a project lacks, as they would be in the checkout."""
    for checkout in {os.path.abspath(roots["project"]), os.path.realpath(roots["project"])}:
        for name, path in roots.items():
            if name.partition(":")[0] == UNLISTED:
                yield os.path.join(checkout, os.path.relpath(path, roots["project:given"]))


def is_below(path: str, folder: str) -> bool:
    """Return whether a path is a folder or below it."""
    return path == folder or path.startswith(folder.rstrip("/") + "/")
