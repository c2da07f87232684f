"""Place a fault at a named point of a `sierra` process or of its worker. Loaded through PYTHONPATH; see tests/soak/faults.py.

Python reports every change to the file system, lock and started process as an audit event. A point is such an event, the
path it concerns, and its number among equal ones: `driver os.rename .sierra/segments/# 1`. No code of SIERRA depends on this.
Paths of the indexes that are being built, which are in the folder for temporary files, begin with TMPDIR.
"""

import errno
import json
import os
import re
import signal
import subprocess
import sys
import threading

EVENTS = ("open", "os.rename", "os.remove", "os.mkdir", "os.rmdir", "os.link", "os.symlink", "os.truncate", "fcntl.flock")
INDEX = "sierra-index-"
RANDOM = re.compile(r"(?<=[.-])[a-z0-9_]{8}(?=$|[./])|[0-9a-f]{8,}|\d+")
WRITES = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC


def install(role, setting):
    """Watch this process; kill it, stop it or refuse the operation at the requested point."""
    roots, log = (setting["root"] + "/", setting["temporary"] + "/"), setting.get("log")
    wanted, action = setting.get("point"), setting.get("action")
    counts, here = {}, threading.local()

    def hook(event, arguments):
        if event not in EVENTS or getattr(here, "inside", False):
            return
        here.inside = True
        try:
            name = _name(role, event, arguments, *roots)
            if name is None:
                return
            counts[name] = counts.get(name, 0) + 1
            point = "%s %d" % (name, counts[name])
            if log:
                with open(log, "a") as file:
                    file.write(point + "\n")
        finally:
            here.inside = False
        if point == wanted:
            _strike(action, setting["struck"], here)

    sys.addaudithook(hook)


def _name(role, event, arguments, root, temporary):
    """Return the name of the point without its number; None for events outside the project and the temporary folder."""
    if event == "open" and not (isinstance(arguments[2], int) and arguments[2] & WRITES):
        return None
    path = arguments[1] if event == "os.rename" else arguments[0]
    if isinstance(path, int):
        try:
            path = os.readlink("/proc/self/fd/%d" % path)
        except OSError:
            return None
        if not path.startswith("/"):  # a pipe or a socket
            return None
    path = os.path.abspath(os.fsdecode(path))
    if path.startswith(root):
        path = path[len(root) :]
    elif path.startswith(temporary + INDEX):
        path = "TMPDIR/" + path[len(temporary) :]
    else:
        return None
    return "%s %s %s" % (role, event, RANDOM.sub("#", path))


def _strike(action, struck, here):
    here.inside = True
    with open(struck, "w") as file:  # report to the test that the fault happened
        file.write(action)
    here.inside = False
    if action == "kill":
        os.kill(os.getpid(), signal.SIGKILL)
    elif action == "interrupt":
        os.kill(os.getpid(), signal.SIGINT)
    else:
        number = getattr(errno, action)
        raise OSError(number, os.strerror(number))


def _index_from(segments):
    """Let this process build an index from so many segments on: the stores of these tests are small."""
    from sierra.store import index_builder

    index_builder.WORTH = segments


def _watch_workers(setting):
    """Make workers, which start without a site module, begin with this file."""
    start = subprocess.Popen.__init__

    def init(self, args, *more, **options):
        if isinstance(args, list | tuple) and len(args) > 3 and args[3].endswith("sierra/worker/__main__.py"):
            args = [*args[:3], __file__, json.dumps(setting), *args[3:]]
        start(self, args, *more, **options)

    subprocess.Popen.__init__ = init


if __name__ == "__main__":
    import runpy

    setting, sys.argv = json.loads(sys.argv[1]), sys.argv[2:]
    install("worker", setting)
    runpy.run_path(sys.argv[0], run_name="__main__")
elif "SIERRA_SOAK" in os.environ and os.path.basename(getattr(sys, "orig_argv", ["", ""])[1:2][0]) == "sierra":
    install("driver", json.loads(os.environ["SIERRA_SOAK"]))
    _watch_workers(json.loads(os.environ["SIERRA_SOAK"]))
    if json.loads(os.environ["SIERRA_SOAK"])["indexes"]:
        _index_from(1)
