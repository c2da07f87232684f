"""The program at the root of a reproduction package: checks all of its files, and unpacks it safely.

It is one file that needs only the standard library (Python 3.8 or newer), so that a package can be checked where nothing is
installed:

    python3 reproduce.py [PACKAGE] [--unpack FOLDER] [--execute]

PACKAGE is a zip, or the folder of an extracted package. Without PACKAGE, it is the folder of this program or the working
folder, whichever has a manifest; otherwise the only zip in the working folder.

Without `--execute`, it reaches level 1 of 3: the package is complete, and each file has the SHA-256 of `manifest-sha256.txt`.
It then executes nothing of the package, and states what levels 2 (execute the runs) and 3 (values and claims) need. The exit
status is 0 if all files are as listed, 1 if any is not, 2 for wrong arguments, 3 if a file or space that is needed is missing,
and 130 after Ctrl-C.

With `--execute`, it verifies the package and then reaches the highest level that this machine allows, after one question:

* Level 3 by the command `sierra reproduce`: SIERRA is installed here, or the package has wheels for this Python, from which a
  virtual environment is made without network.
* Level 2 by `execution/execute_runs.py`: the runs are executed, and the bytes of their outputs are compared.

The exit status is then that of these programs: 0 if all is reproduced, 1 if something differs, 3 if something is missing.

A package may come from anybody. SIERRA itself reads packages with these functions (`sierra.packages.archive`): safe and
different names, regular files only, exactly the members of the manifest, no more bytes than a zip states. They use this
Python's Unicode tables: a Python that is older than a character refuses names with it. In an extracted package, the folder
`reproduction` is for what an evaluator makes: files in it need not be listed.

The hashes prove that the files belong together, not who made them. Therefore the program prints the package's id, which its
authors can publish.
"""

from __future__ import annotations

import sys

if __name__ == "__main__" and not (sys.flags.isolated or getattr(sys.flags, "safe_path", False)):
    sys.path.pop(0)  # this program's folder: a package could bring its own zipfile.py

import argparse
import collections
import contextlib
import errno
import hashlib
import io
import itertools
import json
import os
import platform
import re
import shlex
import shutil
import stat
import struct
import subprocess
import sysconfig
import unicodedata
import zipfile
import zlib
from functools import partial
from pathlib import Path
from typing import IO, Any, Callable, Iterable, Iterator, NamedTuple

MANIFEST = "manifest-sha256.txt"
ABOUT = "package.json"
CREATED = "reproduction"  # the folder for what an evaluator makes; files below it need not be listed
EXECUTOR = "execution/execute_runs.py"
WHEELS, OWN_WHEEL = "environment/wheels/", "environment/sierra/"
LOCK = "environment/requirements.lock"
ENGINES = ("podman", "apptainer")
HOST = "host"
LEVELS = 3
USAGE = "python3 reproduce.py [PACKAGE] [--unpack FOLDER] [--execute] [--yes]"
DURATION = re.compile(r"(\d+(?:\.\d+)?)([smh])")
SECONDS = {"s": 1, "m": 60, "h": 3600}

MOST = 1_000_000  # members
LONGEST = 1024  # bytes of a name
LARGEST_MANIFEST = 256 << 20
LARGEST_ABOUT = 64 << 20
CHUNK = 1 << 20
SHOWN = 200  # characters of a text, and faults, that are printed
NAMED = 10  # batches that are printed
METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
LOCAL_HEADER = 30  # bytes before each member of a zip, without its name
EXECUTABLE = 0o100755
LINE = re.compile(r"([0-9a-f]{64})  (\S.*)")
DEVICE = re.compile(r"(con|prn|aux|nul|com[0-9]|lpt[0-9])(\..*)?", re.IGNORECASE)
FORBIDDEN = frozenset('\\:*?"<>|')
SHORT = 10  # digits of an id for display
WHEEL = re.compile(r"([^-]+)-[^-]+(?:-[0-9][^-]*)?-([^-]+)-([^-]+)-([^-]+)\.whl")
GLIBC = {"manylinux1": (2, 5), "manylinux2010": (2, 12), "manylinux2014": (2, 17)}  # PEP 600
NOT_A_ZIP = (
    zipfile.BadZipFile,
    zlib.error,
    struct.error,
    EOFError,
    NotImplementedError,
    OverflowError,
    RuntimeError,
    ValueError,
)
"""Errors of `zipfile` for a damaged file, in any version of Python."""


class Stop(Exception):
    """The reason why the program ends, in one line, and its exit status."""

    def __init__(self, reason: str, status: int) -> None:
        super().__init__(reason)
        self.status = status


def damaged(reason: str) -> Stop:
    return Stop(reason, 1)


def missing(path: Path, error: OSError) -> Stop:
    if error.errno == errno.EINVAL:  # a damaged zip names a place before its beginning
        return damaged(f"{path} is damaged: it names a place outside itself")
    return Stop(f"{path}: {error.strerror or error}", 3)


def printable(text: object) -> str:
    """Return a text for the terminal: one line without control characters."""
    return "".join(character if character.isprintable() else "?" for character in str(text))


def clean(text: object) -> str:
    """Return a text that a package may have made, for the terminal: not a long line, without control characters."""
    line = str(text)
    return printable(line if len(line) <= SHOWN else line[:SHOWN] + "...")


# Names and the manifest


def check_names(names: Iterable[str], what: str = "the package", *, portable: bool = True) -> None:
    """Raise Stop unless all names are safe and different. `portable`: they can be unpacked on any system."""
    seen: dict[str, str] = {}
    folders: dict[str, str] = {}
    for count, name in enumerate(names, 1):
        problem = (name_problem if portable else place_problem)(name) if count <= MOST else f"at most {MOST:,} are accepted"
        if problem:
            raise damaged(f"{what} has a member {name[:100]!r}, but {problem}")
        same = folded(name)
        if same in seen:
            raise damaged(f"{what} has two members with one name on some systems: {seen[same]!r} and {name!r}")
        seen[same] = name
        for end in (at for at, character in enumerate(same) if character == "/"):
            folders.setdefault(same[:end], name)
    for same in sorted(seen.keys() & folders.keys()):
        raise damaged(f"{what} has the member {seen[same]!r}, which is a folder of {folders[same]!r}")


def place_problem(name: str) -> str:
    """Return the reason why a name may mean a place elsewhere, or none; "" if it does not."""
    parts = name.split("/")
    if not name.isprintable() or "\\" in name:
        return "names have only printable characters, without \\"
    if name.startswith("/") or ".." in parts:
        return "names must stay inside it"
    if "" in parts or "." in parts:
        return "a part of the name is empty or a dot"
    return f"names have at most {LONGEST} bytes" if len(name.encode()) > LONGEST else ""


def name_problem(name: str) -> str:
    """Return the reason why a name is not safe on all systems; "" if it is."""
    parts = name.split("/")
    problem = place_problem(name)
    if problem:
        return problem
    if FORBIDDEN.intersection(name):
        return 'names have only printable characters, without \\ : * ? " < > |'
    if any(part[-1] in ". " or part[0] == " " for part in parts):
        return "a part of the name begins or ends with a blank or a dot"
    if any(map(DEVICE.fullmatch, parts)):
        return "that is a device on Windows"
    if any(part.casefold() == ".git" for part in parts):
        return "git would execute what such a folder says"
    return ""


def folded(name: str) -> str:
    """Return a text that is the same for names that are one name on some systems."""
    return unicodedata.normalize("NFC", unicodedata.normalize("NFD", name).casefold())


def read_manifest(content: bytes) -> dict[str, str]:
    """Return the SHA-256 of each member by name. Raises Stop unless the content is as SIERRA writes it."""
    try:
        lines = content.decode().splitlines()
    except UnicodeDecodeError:
        raise damaged(f"{MANIFEST} is not UTF-8 text") from None
    hashes: dict[str, str] = {}
    for number, line in enumerate(lines, 1):
        parts = LINE.fullmatch(line)
        if parts is None:
            raise damaged(f"{MANIFEST}, line {number}: {line[:80]!r} is not a SHA-256 and a name")
        hashes[parts.group(2)] = parts.group(1)
    check_names([*hashes, MANIFEST])
    if "".join(f"{hashes[name]}  {name}\n" for name in sorted(hashes)).encode() != content:
        raise damaged(f"{MANIFEST} is not in the form that SIERRA writes: names in order, each once")
    return hashes


def package_id(hashes: dict[str, str]) -> str:
    """Return the identity of a package. The names have no character that JSON escapes, so this JSON is canonical (RFC 8785)."""
    fields = {"format": 1, "members": [[name, hashes[name]] for name in sorted(hashes)], "sierra": "package"}
    return hashlib.sha256(json.dumps(fields, separators=(",", ":"), ensure_ascii=False).encode()).hexdigest()


# The two forms of a package


class Zip:
    """A package in one file. Raises Stop if its list of members is not safe; contents are checked when they are read."""

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            if not path.is_file():
                path.stat()
                raise damaged(f"{path} is no regular file")
            self.file = zipfile.ZipFile(path)
        except OSError as error:
            raise missing(path, error) from None
        except NOT_A_ZIP as error:
            raise damaged(f"{path} is no package, or not all of it: {error}") from None
        infos = self.file.infolist()
        check_names(info.orig_filename for info in infos)
        check_apart(self.file)
        for info in infos:
            check_member(info)
        self.infos = {info.orig_filename: info for info in infos}
        if MANIFEST not in self.infos:
            raise damaged(f"{path} is no package of SIERRA: it has no {MANIFEST}")

    def names(self) -> Iterable[str]:
        """Return the names of all members."""
        return self.infos

    def size(self, name: str) -> int:
        return self.infos[name].file_size

    def blocks(self, name: str) -> Iterator[bytes]:
        """Yield the content of a member, not more than its stated size. Raises Stop if it is damaged."""
        try:
            yield from member_blocks(self.file, self.infos[name])
        except OSError as error:
            raise missing(self.path, error) from None

    def is_program(self, name: str) -> bool:
        return self.infos[name].external_attr >> 16 == EXECUTABLE


class Folder:
    """An extracted package. Links are not followed."""

    created = CREATED + "/"

    def __init__(self, path: Path) -> None:
        self.path = path
        self.sizes: dict[str, int] = {}
        self.irregular: list[str] = []
        """A line for each entry that is neither a file nor a folder."""
        try:
            self._scan()
        except OSError as error:
            raise missing(Path(error.filename or path), error) from None
        if MANIFEST not in self.sizes:
            raise damaged(f"{path} is no extracted package: it has no {MANIFEST}")

    def _scan(self) -> None:
        folders = [(self.path, "")]
        while folders:
            folder, before = folders.pop()
            with os.scandir(folder) as entries:
                for entry in entries:
                    name = before + entry.name
                    if entry.is_dir(follow_symlinks=False):
                        folders.append((folder / entry.name, name + "/"))
                    elif entry.is_file(follow_symlinks=False):
                        self.sizes[name] = entry.stat(follow_symlinks=False).st_size
                    elif not name.startswith(self.created):  # below it are virtual environments, which have links
                        self.irregular.append(f"{name!r} is a link or a device: only files and folders are accepted")

    def names(self) -> Iterable[str]:
        return self.sizes

    def size(self, name: str) -> int:
        return self.sizes[name]

    def blocks(self, name: str) -> Iterator[bytes]:
        """Yield the content of a file. Raises Stop if it cannot be read."""
        try:
            with (self.path / name).open("rb", buffering=0) as file:
                yield from pieces(file)
        except OSError as error:
            raise missing(self.path / name, error) from None


def pieces(file: IO[bytes]) -> Iterator[bytes]:
    """Yield the content of a file in blocks."""
    return iter(lambda: file.read(CHUNK), b"")


def check_member(info: zipfile.ZipInfo) -> None:
    """Raise Stop for a member of a zip that is not accepted."""
    problem = ""
    if info.is_dir() or stat.S_IFMT(info.external_attr >> 16) not in (0, stat.S_IFREG):
        problem = "is no regular file: links, folders and devices are refused"
    elif info.flag_bits & 0x1:
        problem = "needs a password"
    elif info.compress_type not in METHODS:
        problem = "is compressed by a method other than deflate"
    elif info.filename != info.orig_filename:
        problem = "has a name with a character that systems treat differently"
    if problem:
        raise damaged(f"member {info.orig_filename!r} {problem}")


def check_apart(file: zipfile.ZipFile) -> None:
    """Raise Stop if members of a zip overlap, which makes a small file unpack to a huge one."""
    end = 0
    for info in sorted(file.infolist(), key=lambda info: info.header_offset):
        if info.header_offset < end:
            raise damaged(f"member {info.orig_filename!r} overlaps another one")
        end = info.header_offset + LOCAL_HEADER + info.compress_size


def member_blocks(file: zipfile.ZipFile, info: zipfile.ZipInfo) -> Iterator[bytes]:
    """Yield the content of a member, not more than its stated size. Raises Stop if it is damaged, and OSError."""
    name, left = info.orig_filename, info.file_size
    try:
        with file.open(info) as member:
            for block in pieces(member):
                left -= len(block)
                if left < 0:
                    raise damaged(f"member {name!r} is longer than it says")
                yield block
    except NOT_A_ZIP as error:
        raise damaged(f"member {name!r} is damaged: {str(error) or type(error).__name__}") from None
    if left:
        raise damaged(f"member {name!r} is shorter than it says")


# Level 1


class Checked(NamedTuple):
    """A package with a safe manifest."""

    package: Zip | Folder
    hashes: dict[str, str]
    faults: list[str]
    """A line for each difference between the files that are present and those that are listed."""


def listed(package: Zip | Folder) -> Checked:
    """Compare the names of a package with its manifest. Raises Stop if the manifest is not safe."""
    if package.size(MANIFEST) > LARGEST_MANIFEST:
        raise damaged(f"{MANIFEST} is too large")
    hashes = read_manifest(b"".join(package.blocks(MANIFEST)))
    present = set(package.names()) - {MANIFEST}
    lost = [f"{name!r} is missing, but {MANIFEST} lists it" for name in sorted(hashes.keys() - present)]
    extra = [f"{name!r} is not listed in {MANIFEST}" for name in sorted(present - hashes.keys()) if not created(package, name)]
    irregular = sorted(package.irregular) if isinstance(package, Folder) else []
    return Checked(package, hashes, irregular + lost + extra)


def created(package: Zip | Folder, name: str) -> bool:
    """Check whether a file need not be listed, because an evaluator has made it in an extracted package."""
    return isinstance(package, Folder) and name.startswith(package.created)


def verified(checked: Checked, name: str) -> Iterator[bytes]:
    """Yield the content of a member. Raises Stop at the end if it is not that of the manifest."""
    digest = hashlib.sha256()
    for block in checked.package.blocks(name):
        digest.update(block)
        yield block
    if digest.hexdigest() != checked.hashes[name]:
        raise damaged(f"{name!r} is not what {MANIFEST} says: its SHA-256 is {digest.hexdigest()[:10]}...")


def content_faults(checked: Checked, use: Callable[[str, Iterator[bytes]], object]) -> Iterator[str]:
    """Give all listed files that are present to `use`; yield a line for each one that is wrong or cannot be read."""
    for name in sorted(checked.hashes.keys() & set(checked.package.names())):
        try:
            use(name, verified(checked, name))
        except Stop as fault:
            yield str(fault)


def read_only(name: str, blocks: Iterator[bytes]) -> None:
    """Read the content of a member."""
    collections.deque(blocks, maxlen=0)


def report(faults: Iterable[str]) -> int:
    """Print a line for each fault, at most SHOWN of them; return their number."""
    count = 0
    for count, fault in enumerate(faults, 1):
        if count <= SHOWN:
            print(f"fault: {clean(fault)}")
    if count > SHOWN:
        print(f"fault: {count - SHOWN:,} more")
    return count


def verify(checked: Checked, target: Path | None) -> int:
    """Print all faults of a package; return their number. `target`: the folder to unpack it to, if there are none."""
    if checked.faults and isinstance(checked.package, Zip):
        return report(checked.faults)  # it was made to deceive, or is damaged: its contents are not read
    if target is None or isinstance(checked.package, Folder):
        return report(itertools.chain(checked.faults, content_faults(checked, read_only)))
    return unpack(checked, checked.package, target)


# Unpacking


def unpack(checked: Checked, package: Zip, target: Path) -> int:
    """Write all members of a zip to a new folder, which appears complete or not at all; return the number of faults."""
    needed, free = sum(map(package.size, checked.hashes)), shutil.disk_usage(target.parent).free
    if needed > free:
        raise Stop(f"{target.parent} has {free:,} bytes of free space, but {needed:,} are needed", 3)
    unfinished = target.parent / f".{target.name}.{os.getpid()}"
    unfinished.mkdir()
    try:
        faults = report(
            content_faults(checked, lambda name, blocks: write(unfinished / name, blocks, package.is_program(name)))
        )
        if not faults:
            write(unfinished / MANIFEST, package.blocks(MANIFEST), False)
            check_new(target)
            unfinished.rename(target)
        return faults
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)


def write(path: Path, blocks: Iterator[bytes], is_program: bool) -> None:
    """Write a file, which has its name only after `blocks` has checked its content."""
    path.parent.mkdir(parents=True, exist_ok=True)
    unchecked = path.with_name(f".unchecked.{os.getpid()}")
    try:
        with unchecked.open("xb") as file:
            file.writelines(blocks)
        if is_program:
            unchecked.chmod(0o755)
        check_new(path)
        unchecked.rename(path)
    finally:
        with contextlib.suppress(FileNotFoundError):
            unchecked.unlink()


def check_new(path: Path) -> None:
    """Raise Stop if there is a file or folder of this name."""
    if os.path.lexists(path):
        raise Stop(f"{path} exists already; choose a new folder", 2)


# The description and the next levels


def describe(checked: Checked) -> None:
    """Print the id of a package, and the title, date and batches that it states."""
    print(f"  id:      {package_id(checked.hashes)} (of all names and hashes: compare it with the one that the authors state)")
    try:
        about = stated(checked)
    except (Stop, ValueError, RecursionError):
        print(f"  {ABOUT} cannot be read: title, date and batches are unknown")
        return
    for key in ("title", "date"):
        if about.get(key):
            print(f"  {key + ':':9}{clean(about[key])}")
    if about.get("redacted") is True:
        print("  redacted: for double-blind review: hosts, folders, commits and times in the records are not the original ones")
    batches = about.get("batches", [])
    for batch in batches[:NAMED]:
        print(f"  batch:   {clean(text_of(batch, 'batch'))[:SHORT]} {clean(text_of(batch, 'query'))}")
    if len(batches) > NAMED:
        print(f"  and {len(batches) - NAMED:,} batches more")


def stated(checked: Checked) -> dict[str, Any]:
    """Return the object in a package's description; an empty one if there is none. Raises ValueError or Stop."""
    if ABOUT not in checked.hashes:
        return {}
    if checked.package.size(ABOUT) > LARGEST_ABOUT:
        raise ValueError(f"{ABOUT} is too large")
    about = json.loads(b"".join(verified(checked, ABOUT)))
    if not isinstance(about, dict) or not isinstance(about.get("batches", []), list):
        raise ValueError(f"{ABOUT} is no description of a package")
    return about


def text_of(batch: object, key: str) -> str:
    """Return a text about a batch in a package's description; "?" if there is none."""
    return str(batch.get(key, "?")) if isinstance(batch, dict) else "?"


def next_levels(checked: Checked, folder: Path | None) -> None:
    """Print what the levels above this one need, and the command. `folder`: where the package is extracted, if it is."""
    print(f"Level 1 of {LEVELS} reached: the files are verified. Nothing of the package was executed.")
    engines = [name for name in ENGINES if shutil.which(name)]
    print("Level 2 (execute the runs, compare their bytes) needs the project's programs, or podman or apptainer for its image:")
    print(f"  {' and '.join(engines) or 'neither podman nor apptainer'} found on this machine")
    print("Level 3 (values, figures and claims) needs SIERRA, or wheels of it for this Python:")
    for line in installation(set(checked.hashes)):
        print(f"  {line}")
    if folder is None:
        print("The next levels need an extracted package: give --unpack FOLDER.")
    else:
        program = printable(shlex.quote(str(folder / Path(__file__).name)))
        print(f"Next: python3 {program} --execute (it asks before it executes programs of the package)")


def installation(names: set[str]) -> Iterator[str]:
    """Yield lines that state whether SIERRA is installed, and whether the package has wheels for this Python."""
    yield f"SIERRA found: {printable(sierra())}" if sierra() else "SIERRA is not installed for this Python, and not on the PATH"
    wheels = wheels_of(names)
    lacking = unusable(wheels)
    version = f"Python {platform.python_version()} on {platform.system()} {platform.machine()}"
    if not wheels:
        yield f"the package has no wheels in {WHEELS}"
    elif lacking:
        yield f"the package has no wheel for {version} of {clean(', '.join(lacking))}"
    else:
        yield f"the package has {len(wheels)} wheels in {WHEELS}, and they fit {version}"


def sierra() -> str:
    """Return the program that starts SIERRA on this machine, in the PATH or beside this Python; "" if there is none."""
    return shutil.which("sierra") or shutil.which("sierra", path=sysconfig.get_path("scripts")) or ""


# Levels 2 and 3


def executed(checked: Checked, folder: Path, options: argparse.Namespace) -> int:
    """Execute the runs of a verified package at the requested level, or at the highest possible one; return the exit status."""
    if os.name != "posix":
        raise Stop("runs are executed on Linux and macOS; on Windows, use WSL", 3)
    names = set(checked.hashes)
    work = Path(options.work).absolute() if options.work else folder / CREATED
    level = options.level or (3 if wheels_fit(names) or can_reproduce(sierra()) else 2)
    if level == 2:
        return level_2(checked, folder, work, options)
    if options.runs is not None:
        raise Stop("--runs is for level 2; give --level 2, or --budget instead", 2)
    program = sierra() if can_reproduce(sierra()) else ""
    if not program and not wheels_fit(names):
        lines = "; ".join(installation(names))
        raise Stop(f"level 3 needs SIERRA with the command reproduce, or wheels of it for this Python: {lines}", 3)
    installs = "" if program else "installs SIERRA from the package's wheels without network, and "
    confirm(f"Level 3 {installs}executes the programs of the package on this machine.", yes=options.yes)
    command = [program or installed(names, folder, work), "reproduce", str(folder), "--yes", "--into", str(work / "level-3")]
    command += ["--engine", options.engine.replace(HOST, "none")] if options.engine else []
    command += ["--budget", options.budget] if options.budget else []
    print(f"Level 3 by {printable(' '.join(map(shlex.quote, command)))}")
    status = waited_for(command, home=work)
    print(f"Level {LEVELS if status in (0, 1) else 1} of {LEVELS} reached.")
    return status


def level_2(checked: Checked, folder: Path, work: Path, options: argparse.Namespace) -> int:
    """Start the program of the package that executes its runs; return its exit status."""
    if EXECUTOR not in checked.hashes:
        raise Stop(f"the package has no {EXECUTOR}, which level 2 needs", 3)
    if Path(__file__).resolve().parent != folder.resolve():  # else this program came in the package too
        confirm(f"Level 2 starts {EXECUTOR} of the package, which asks again before it executes the runs.", yes=options.yes)
    command = [sys.executable, "-I", str(folder / EXECUTOR), str(folder), str(work), f"--id={package_id(checked.hashes)}"]
    limit = seconds(options.budget) if options.budget else None
    given = {"runs": options.runs, "seconds": limit, "engine": options.engine}
    command += [f"--{name}={value}" for name, value in given.items() if value is not None]
    return waited_for([*command, *(["--yes"] if options.yes else [])])


def waited_for(command: list[str], home: Path | None = None) -> int:
    """Execute a command that handles Ctrl-C itself; return its exit status. `home`: the home of a user who has none."""
    sys.stdout.flush()
    environment = {**os.environ, "HOME": str(home)} if home is not None and not has_home() else None
    process = subprocess.Popen(command, env=environment)
    while True:
        with contextlib.suppress(KeyboardInterrupt):
            status = process.wait()
            return status if status >= 0 else 128 - status


def has_home() -> bool:
    """Check whether this user has a home."""
    try:
        return bool(Path.home())
    except RuntimeError:
        return False


def confirm(text: str, *, yes: bool) -> None:
    """Print what would be executed, and ask. Raises Stop unless the answer is yes."""
    print(text)
    if yes:
        return
    if not sys.stdin.isatty():
        raise Stop("nothing was executed: nobody can be asked here; give --yes to execute the runs", 3)
    if input("Execute them? [y/N] ").strip().lower() not in ("y", "yes"):
        raise Stop("nothing was executed", 3)


def can_reproduce(program: str) -> bool:
    """Check whether a program is a SIERRA that has the command for packages."""
    if not program:
        return False
    done = subprocess.run([program, "reproduce", "--help"], stdin=subprocess.DEVNULL, capture_output=True, check=False)
    return done.returncode == 0


def wheels_of(names: Iterable[str]) -> list[str]:
    """Return the names of the wheels in a package."""
    return [name[len(WHEELS) :] for name in names if name.startswith(WHEELS) and name.endswith(".whl")]


def wheels_fit(names: Iterable[str]) -> bool:
    """Check whether a package has wheels, and each distribution has one for this Python."""
    wheels = wheels_of(names)
    return bool(wheels) and not unusable(wheels)


def installed(names: set[str], folder: Path, work: Path) -> str:
    """Make a virtual environment from the wheels of a package, without network; return its SIERRA. Raises Stop."""
    venv = work / "venv"
    program, complete = venv / "bin" / "sierra", venv / "complete"
    if complete.exists():
        return str(program)
    pip = next((name for name in sorted(wheels_of(names)) if name.startswith("pip-")), None)
    run([sys.executable, "-I", "-m", "venv", "--clear", *(["--without-pip"] if pip else []), str(venv)])
    words = [str(folder / WHEELS / pip / "pip")] if pip else ["-m", "pip"]
    sources = [word for name in (WHEELS, OWN_WHEEL) for word in ("--find-links", str(folder / name))]
    wanted = ["--require-hashes", "-r", str(folder / LOCK)] if LOCK in names else ["sierra-experiments"]
    options = ["--isolated", "--no-input", "--disable-pip-version-check", "--quiet", "--no-cache-dir", "--no-index"]
    run([str(venv / "bin" / "python"), *words, "install", *options, *sources, *wanted])
    if not program.exists():
        raise Stop(f"the wheels of the package do not install SIERRA: there is no {program}", 3)
    complete.touch()
    return str(program)


def run(command: list[str]) -> None:
    """Execute a command that prepares level 3. Raises Stop with its last line if it fails."""
    done = subprocess.run(command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, check=False)
    if done.returncode:
        lines = done.stdout.decode("utf-8", "replace").strip().splitlines() or ["it printed nothing"]
        raise Stop(f"{' '.join(command[:5])} has failed: {lines[-1]}", 3)


def seconds(duration: str) -> float:
    """Return the seconds of a text such as 90s, 30m or 2h."""
    parts = DURATION.fullmatch(duration)
    if parts is None:
        raise Stop(f"--budget {duration}: give a time such as 90s, 30m or 2h", 2)
    return float(parts.group(1)) * SECONDS[parts.group(2)]


# Wheels


def unusable(wheels: Iterable[str]) -> list[str]:
    """Return the names of the distributions of which no wheel fits this Python. A name is compared as PEP 427 writes it."""
    fits: dict[str, bool] = {}
    for wheel in wheels:
        parts = WHEEL.fullmatch(wheel)
        name = parts.group(1) if parts else wheel
        fits[name] = fits.get(name, False) or bool(parts and fits_here(*parts.groups()[1:]))
    return sorted(name for name in fits if not fits[name])


def fits_here(pythons: str, abis: str, platforms: str) -> bool:
    """Check the compressed tags of a wheel (PEP 425). pip has the last word: macOS versions, for example, are not compared."""
    python_fits = any(abi_fits(python, abi) for python in pythons.split(".") for abi in abis.split("."))
    return python_fits and any(map(platform_fits, platforms.split(".")))


def abi_fits(python: str, abi: str) -> bool:
    major, minor = sys.version_info[:2]
    parts = re.fullmatch(r"(py|cp)(\d)(\d*)", python)
    if not parts or int(parts.group(2)) != major:
        return False
    older = int(parts.group(3) or 0) <= minor
    if parts.group(1) == "py":
        return older and abi == "none"
    if sys.implementation.name != "cpython":
        return False
    flags = getattr(sys, "abiflags", "")
    return (abi == "abi3" and older and "t" not in flags) or (
        parts.group(3) == str(minor) and abi in ("none", f"cp{major}{minor}{flags}")
    )


def platform_fits(tag: str) -> bool:
    own = sysconfig.get_platform().replace("-", "_").replace(".", "_")  # linux_x86_64, macosx_11_0_arm64, win_amd64
    machine = platform.machine()
    if tag in ("any", own):
        return True
    if own.startswith("macosx"):
        return tag.startswith("macosx") and tag.endswith((machine, "universal2"))
    parts = re.fullmatch(rf"(manylinux\d+|manylinux_(\d+)_(\d+))_{re.escape(machine)}", tag)
    if parts is None:
        return False
    needed = (int(parts.group(2)), int(parts.group(3))) if parts.group(2) else GLIBC.get(parts.group(1), (9, 9))
    return needed <= glibc()


def glibc() -> tuple[int, int]:
    """Return the version of the GNU C library; (0, 0) if there is another one."""
    version = re.fullmatch(r"(\d+)\.(\d+).*", platform.libc_ver()[1] if platform.libc_ver()[0] == "glibc" else "")
    return (int(version.group(1)), int(version.group(2))) if version else (0, 0)


# The command


def find(given: str | None) -> Zip | Folder:
    """Return the package of the command line, or the one nearby. Raises Stop if there is none, or more than one."""
    if given is not None:
        path = Path(given)
        return Folder(path) if path.is_dir() else Zip(path)
    for folder in (Path(__file__).resolve().parent, Path.cwd()):
        if os.path.lexists(folder / MANIFEST):
            return Folder(folder)
    zips = sorted(Path.cwd().glob("*.zip"))
    if len(zips) != 1:
        reason = f"there are {len(zips)} zips here" if zips else f"there is neither a {MANIFEST} nor a zip here"
        raise Stop(f"{reason}; name the package: {USAGE}", 2)
    return Zip(zips[0])


def parsed(arguments: list[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="reproduce.py",
        usage=USAGE,
        description="Check that a reproduction package is complete and unchanged, and unpack it safely. Nothing of the package "
        "is executed without --execute, and no network is used.",
        epilog="Exit status: 0 if all files are as the manifest lists them (with --execute: if all is reproduced), 1 if any is "
        "not (or something differs), 2 for wrong arguments, 3 if something that is needed is missing, 130 after Ctrl-C.",
    )
    parser.add_argument("package", nargs="?", metavar="PACKAGE", help="a zip, or the folder of an extracted package")
    parser.add_argument("--unpack", metavar="FOLDER", help="write the files of a zip to this new folder, if all are as listed")
    parser.add_argument("--execute", action="store_true", help="execute the runs again and compare, after one question")
    parser.add_argument("--yes", action="store_true", help="with --execute: answer the question with yes")
    parser.add_argument("--level", type=int, choices=(2, 3), help="with --execute: default is the highest possible level")
    parser.add_argument("--engine", choices=(HOST, *ENGINES), help="with --execute: where runs are executed")
    parser.add_argument("--runs", type=int, metavar="N", help="with --execute: only the first N runs of each experiment")
    parser.add_argument("--budget", metavar="TIME", help="with --execute: as many runs as fit into 90s, 30m or 2h")
    parser.add_argument("--work", metavar="FOLDER", help=f"with --execute: folder to write to (default: PACKAGE/{CREATED})")
    given = parser.parse_args(arguments)
    if not given.execute and any((given.yes, given.level, given.engine, given.runs is not None, given.budget, given.work)):
        parser.error("--yes, --level, --engine, --runs, --budget and --work need --execute")
    if given.runs is not None and (given.runs < 1 or given.budget):
        parser.error("--runs needs a number from 1, and excludes --budget")
    return given


def reproduce(options: argparse.Namespace) -> int:
    """Verify a package, unpack and execute it if that is requested, and print the next levels; return the exit status."""
    if options.budget:
        seconds(options.budget)  # refused before anything else
    package = find(options.package)
    target = None if options.unpack is None else Path(options.unpack).absolute()
    if target and isinstance(package, Folder):
        raise Stop(f"--unpack needs a zip, but {package.path} is a folder", 2)
    if target:
        check_new(target)
    if options.execute and target is None and isinstance(package, Zip):
        raise Stop("--execute needs an extracted package; add --unpack FOLDER", 2)
    checked = listed(package)
    if verify(checked, target):
        return not_verified()
    print(f"VERIFIED: {clean(package.path)} has {len(checked.hashes):,} files, all as {MANIFEST} lists them")
    describe(checked)
    if target:
        print(f"Unpacked to {clean(target)}")
    folder = target or (package.path.absolute() if isinstance(package, Folder) else None)
    if options.execute and folder:
        return executed(checked, folder, options)
    next_levels(checked, folder)
    return 0


def not_verified(fault: str = "") -> int:
    """Print a fault that is not printed yet, and the verdict on a package with faults; return the exit status."""
    report([fault] if fault else ())
    print(f"NOT VERIFIED: this is not what its authors packed. Level 0 of {LEVELS} reached; do not use its files.")
    return 1


def main(arguments: list[str]) -> int:
    return status_of(partial(reproduce, parsed(arguments)), clean, not_verified)


def status_of(program: Callable[[], int], shown: Callable[[str], str], damaged: Callable[[str], int] | None = None) -> int:
    """Execute a program, and return its exit status. If it ends early, print the reason, or let `damaged` report a fault."""
    try:
        status = program()
        sys.stdout.flush()  # fails here, and not at the end of Python
        return status
    except Stop as stop:
        reason, status = str(stop), stop.status
        if damaged and status == 1:
            return damaged(reason)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # nobody reads on; Python flushes once more at its end
        return 1
    except OSError as error:
        reason, status = f"{error.filename or 'a file'}: {error.strerror or error}", 3
    except MemoryError:
        reason, status = "the memory of this machine is too small for the package", 3
    except (KeyboardInterrupt, EOFError):
        reason, status = "interrupted", 130
    print(f"reproduce.py: {shown(reason)}", file=sys.stderr, flush=True)
    return status


if __name__ == "__main__":
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # a terminal without UTF-8 can print all names
    sys.exit(main(sys.argv[1:]))
