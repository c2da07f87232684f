"""Start the nodes of a launch file of ROS 2 in XML where there is no `ros2 launch`: `python3 ros2_launcher.py LAUNCH`.

It needs Python 3.10 or newer, and PyYAML, which comes with rclpy. The elements, substitutions and arguments of nodes mean what
they mean to `launch_xml` and `launch_ros` (https://github.com/ros2/launch, https://github.com/ros2/launch_ros), and the lines
that it prints are theirs. Everything else is refused, with its line, before any node starts.

It differs in two things: a node is called by its own name with its namespace, as in `robot0/walker-1`, and when all nodes have
ended, it still waits for a signal.

Nodes end by SIGINT as soon as it gets SIGINT or SIGTERM; those that do not, by SIGTERM and SIGKILL.
"""

from __future__ import annotations

import ctypes
import os
import selectors
import shlex
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any
from xml.parsers import expat

import yaml

GRACE = ((signal.SIGINT, 5.0), (signal.SIGTERM, 5.0), (signal.SIGKILL, 5.0))  # signals to nodes, and seconds after each
TICK_S = 0.05
CHUNK = 1 << 16
DRAINED = 20  # reads of the last output of a node
ATTRIBUTES = {
    "launch": {"version"},
    "arg": {"name", "default", "description"},
    "let": {"name", "value"},
    "group": {"scoped"},
    "push_ros_namespace": {"namespace"},
    "set_env": {"name", "value"},
    "set_parameter": {"name", "value"},
    "include": {"file"},
    "node": {"pkg", "exec", "name", "namespace", "args", "ros_args", "output"},
}
"""The attributes of elements, besides `if` and `unless`."""
OLDER = {"push-ros-namespace": "push_ros_namespace"}
INSIDE = {
    "node": {"param": {"name", "value", "from", "type"}, "remap": {"from", "to"}, "env": {"name", "value"}},
    "include": {"arg": {"name", "value"}, "let": {"name", "value"}},
    "arg": {"choice": {"value"}},
    "param": {"param": {"name", "value", "type"}},
}
"""The elements in others, with their attributes."""
TYPES: dict[str, Any] = {"str": str, "int": int, "float": float, "bool": lambda text: truth(text)}
NEEDED = "needs the real ros2 launch, which is not on PATH"
DEEPEST = 20
RESERVED = ("ros_namespace", "ros_remaps", "global_params", "launch-prefix", "launch-prefix-filter")
LIBC, PR_SET_PDEATHSIG = ctypes.CDLL(None), 1


class Refused(Exception):
    """The launch file cannot be started; the message begins with the line, or with the file if it `is_named`."""

    def __init__(self, message: str, *, is_named: bool = False) -> None:
        super().__init__(message)
        self.is_named = is_named


@dataclass
class Element:
    """An element of a launch file."""

    tag: str
    attributes: dict[str, str]
    line: int
    children: list[Element] = field(default_factory=list)

    def refused(self, why: str) -> Refused:
        return Refused(f"line {self.line}: <{self.tag}> {why}")


@dataclass
class Scope:
    """The values that count at a place of a launch file."""

    variables: dict[str, str]
    environment: dict[str, str]
    read: list[Path]
    """The launch files in the order in which they were read: in `launch`, `$(dirname)` stays that of an included file."""
    namespace: str = ""
    parameters: tuple[str, ...] = ()
    """The words that give parameters to all nodes."""

    def copy(self) -> Scope:
        return replace(self, variables=dict(self.variables), environment=dict(self.environment))


@dataclass
class Node:
    """A node to be started."""

    name: str
    words: list[str]
    environment: dict[str, str]


def read(path: Path) -> Element:
    """Return the root of a launch file. Raises Refused if it is no XML that is understood."""
    top = Element("", {}, 0)
    open_elements = [top]
    parser = expat.ParserCreate()

    def start(tag: str, attributes: dict[str, str]) -> None:
        element = Element(OLDER.get(tag, tag), attributes, parser.CurrentLineNumber)
        open_elements[-1].children.append(element)
        open_elements.append(element)

    def text(content: str) -> None:
        if content.strip():
            raise open_elements[-1].refused(f"has the text {content.strip()!r}, which means nothing")

    def refuse(*_: object) -> None:
        raise Refused(f"line {parser.CurrentLineNumber}: a document type is not read")

    parser.StartElementHandler = start
    parser.EndElementHandler = lambda _: open_elements.pop()
    parser.CharacterDataHandler = text
    parser.StartDoctypeDeclHandler = refuse
    try:
        parser.Parse(path.read_bytes(), True)
    except OSError as error:
        raise Refused(f"cannot be read: {error.strerror}") from error
    except expat.ExpatError as error:
        raise Refused(f"line {error.lineno}: is not XML: {expat.ErrorString(error.code)}") from error
    if top.children[0].tag != "launch":
        raise top.children[0].refused("is the root, where <launch> is needed")
    return top.children[0]


def truth(text: str) -> bool:
    """Return a condition. Raises ValueError for another text than true, false, 1 or 0."""
    values = {"true": True, "1": True, "false": False, "0": False}
    if text.strip().lower() not in values:
        raise ValueError(f"{text!r} is neither true nor false")
    return values[text.strip().lower()]


def joined(base: str, name: str) -> str:
    """Return a namespace within another, with a slash at its beginning; empty for none."""
    parts = name if name.startswith("/") else f"{base}/{name}"
    return "/" + parts.strip("/") if parts.strip("/") else ""


def prefix(package: str, environment: dict[str, str]) -> Path:
    """Return the folder where a package is installed. Raises ValueError if it is unknown."""
    folders = [Path(folder) for folder in environment.get("AMENT_PREFIX_PATH", "").split(os.pathsep) if folder]
    for folder in folders:
        if (folder / "share" / "ament_index" / "resource_index" / "packages" / package).is_file():
            return folder
    raise ValueError(f"the package {package!r} is unknown; packages or setup in sierra.toml name where it is")


class Substitutions:
    """The substitutions in one attribute: `$(var speed)`. Texts that `launch` would understand otherwise are refused."""

    def __init__(self, text: str, scope: Scope, folder: Path) -> None:
        if "\\" in text:
            raise ValueError(f"{text!r} has a backslash, which {NEEDED}")
        self.text, self.scope, self.folder = text, scope, folder
        self.at = 0

    def whole(self) -> str:
        """Return the text with all values. Raises ValueError."""
        return "".join(self._parts(""))

    def words(self) -> list[str]:
        """Return the words of a command line: a value is never split. Raises ValueError."""
        if "$(" not in self.text:
            return shlex.split(self.text)
        if any(quote in self.text for quote in "'\"") or self.text != " ".join(self.text.split()):
            raise ValueError(f"{self.text!r} has quotes or several blanks beside a substitution, which {NEEDED}")
        return shlex.split("".join(self._parts("", shlex.quote)))

    def _parts(self, end: str, quoted: Callable[[str], str] = str) -> Iterator[str]:
        """Yield the texts and values up to one of these characters, which is not read."""
        while self.at < len(self.text) and self.text[self.at] not in end:
            if self.text.startswith("$(", self.at):
                self.at += 2
                yield quoted(self._value())
            else:
                yield self.text[self.at]
                self.at += 1

    def _value(self) -> str:
        begin = self.at
        words = ["".join(self._parts(" )"))]
        while self.text.startswith(" ", self.at):
            self.at += 1
            words.append("".join(self._parts(" )")))
        inner = self.text[begin : self.at]
        if not self.text.startswith(")", self.at) or not all(words) or any(character in inner for character in "'\"\t\n"):
            raise ValueError(f"the substitution $({inner} {NEEDED}")
        self.at += 1
        return self._result(*words)

    def _result(self, name: str, *words: str) -> str:
        if name == "var" and len(words) == 1:
            if words[0] not in self.scope.variables:
                raise ValueError(f"$(var {words[0]}) has no value; declare it by <arg> or <let>")
            return self.scope.variables[words[0]]
        if name == "env" and len(words) in (1, 2):
            if words[0] not in self.scope.environment and len(words) == 1:
                raise ValueError(f"$(env {words[0]}) has no value")
            return self.scope.environment.get(words[0], words[-1])
        if name in ("find-pkg-share", "find-pkg-prefix") and len(words) == 1:
            folder = prefix(words[0], self.scope.environment)
            return str(folder / "share" / words[0] if name == "find-pkg-share" else folder)
        if name == "dirname" and not words and self.folder == self.scope.read[-1].parent:
            return str(self.folder)
        raise ValueError(f"$({' '.join([name, *words])}) {NEEDED}")


@dataclass
class Use:
    """An element with the values that count where it is."""

    element: Element
    scope: Scope
    file: Path
    """The launch file with the element."""

    def refused(self, why: str) -> Refused:
        return self.element.refused(why)

    def has(self, name: str) -> bool:
        return name in self.element.attributes

    def text(self, name: str, default: str | None = None) -> str:
        """Return an attribute with its substitutions. Raises Refused without one, if there is no default."""
        raw = self.element.attributes.get(name, default)
        if raw is None:
            raise self.refused(f"lacks the attribute {name}")
        try:
            return Substitutions(raw, self.scope, self.file.parent).whole()
        except ValueError as error:
            raise self.refused(f"{name}: {error}") from error

    def words(self, name: str) -> list[str]:
        """Return the words of an attribute; a value is never split."""
        try:
            return Substitutions(self.element.attributes.get(name, ""), self.scope, self.file.parent).words()
        except ValueError as error:
            raise self.refused(f"{name}: {error}") from error

    def truth(self, name: str, *, default: bool) -> bool:
        try:
            return truth(self.text(name, str(default)))
        except ValueError as error:
            raise self.refused(f"{name}: {error}") from error

    def counts(self) -> bool:
        """Return whether the conditions of the element hold."""
        return self.truth("if", default=True) and not self.truth("unless", default=False)

    def typed(self) -> object:
        """Return the value of a parameter, of its type, or as YAML reads it."""
        raw, text, kind = self.element.attributes.get("value", ""), self.text("value"), self.element.attributes.get("type")
        if "$(" in raw and any(quote in raw for quote in "'\""):
            raise self.refused(f'value: {raw!r} has quotes beside a substitution, which {NEEDED}; type="str" makes a text')
        try:
            value = yaml.safe_load(text or "''") if kind is None else TYPES[kind](text)
        except (KeyError, ValueError, yaml.YAMLError) as error:
            raise self.refused(f"value: {text!r} is not of the type {kind or 'of a parameter'}") from error
        kinds = {type(item) for item in value} if isinstance(value, list) else {type(value)}
        if len(kinds) == 1 and kinds <= {bool, int, float, str}:
            return value
        raise self.refused(f"value: {text!r} is no value of a parameter; quote a text that looks like something else")

    def word(self) -> str:
        """Return the value of a parameter that all nodes get, as a word of a command line."""
        value = self.typed()
        if isinstance(value, list) or value == "" or (str(value) != self.text("value") and not isinstance(value, bool)):
            raise self.refused(f"value: {self.text('value')!r} {NEEDED}; a plain number or text is passed as it is")
        return str(value)

    def inside(self, *tags: str) -> list[Use]:
        """Return the elements in the element that have one of these tags, and that count. Raises Refused for unknown ones."""
        known = INSIDE.get(self.element.tag, {})
        for child in self.element.children:
            if child.tag not in known:
                raise child.refused(f"in <{self.element.tag}> {NEEDED}")
            check_attributes(child, known[child.tag])
        uses = [Use(child, self.scope, self.file) for child in self.element.children if child.tag in tags]
        return [use for use in uses if use.counts()]


def check_attributes(element: Element, known: set[str]) -> None:
    """Raise Refused if an element has an attribute that is not known."""
    if unknown := sorted(element.attributes.keys() - known - {"if", "unless"}):
        raise element.refused(f"has the attribute {unknown[0]}, which {NEEDED}")


class Reader:
    """A reader of launch files, which collects the nodes that they start."""

    def __init__(self, folder: Path) -> None:
        self.nodes: list[Node] = []
        self.folder = folder
        """The folder for files of parameters."""

    def read(self, file: Path, scope: Scope, depth: int = 0) -> None:
        """Add the nodes of a launch file. Raises Refused."""
        scope.read.append(file)
        try:
            for child in read(file).children:
                self._read(child, scope, file, depth)
        except Refused as error:
            raise error if error.is_named else Refused(f"{file.name}, {error}", is_named=True) from error

    def _read(self, element: Element, scope: Scope, file: Path, depth: int, *, nested: bool = False) -> None:
        if element.tag not in ATTRIBUTES:
            raise element.refused(NEEDED)
        check_attributes(element, ATTRIBUTES[element.tag])
        use = Use(element, scope, file)
        if not use.counts():
            return
        if element.tag == "group":
            if "$(" in element.attributes.get("scoped", ""):
                raise use.refused(f"has a substitution in scoped, which {NEEDED}")
            inner = scope.copy() if use.truth("scoped", default=True) else scope
            for child in element.children:
                self._read(child, inner, file, depth, nested=True)
            return
        use.inside()
        if element.tag == "arg":
            declare(use)
        elif element.tag == "let":
            scope.variables[own_name(use)] = use.text("value")
        elif element.tag == "set_env":
            scope.environment[use.text("name")] = use.text("value")
        elif element.tag == "push_ros_namespace":
            scope.namespace = joined(scope.namespace, use.text("namespace"))
        elif element.tag == "set_parameter" and not nested:
            scope.parameters += ("-p", f"{use.text('name')}:={use.word()}")
        elif element.tag == "set_parameter":
            raise use.refused(f"in a group {NEEDED}, which may also give it to nodes behind the group")
        elif element.tag == "include":
            self._include(use, depth)
        else:
            self.nodes.append(self._node(use))

    def _include(self, use: Use, depth: int) -> None:
        file = absolute(use, "file")
        if depth == DEEPEST:
            raise use.refused(f"is the {DEEPEST}th file in another; it seems to include itself")
        if not file.name.endswith((".xml", ".launch")):
            raise use.refused(f"names {file.name}, which is not XML: it {NEEDED}")
        for given in use.inside("arg", "let"):
            if "$(dirname" in given.element.attributes.get("value", ""):
                raise given.refused(f"has $(dirname), which is the folder of the included file, and {NEEDED}")
            use.scope.variables[own_name(given)] = given.text("value")
        self.read(file, use.scope, depth + 1)

    def _node(self, use: Use) -> Node:
        scope, name = use.scope, use.text("name", "")
        namespace = joined(scope.namespace, use.text("namespace", ""))
        words = [program(use), *use.words("args"), "--ros-args", *use.words("ros_args")]
        words += ["-r", f"__node:={name}"] if name else []
        words += ["-r", f"__ns:={namespace}"] if namespace else []
        words += scope.parameters
        for param in use.inside("param"):
            words += ["--params-file", self._parameters(param, f"{namespace}/{name}" if name and namespace else "/**")]
        for remap in use.inside("remap"):
            words += ["-r", f"{remap.text('from')}:={remap.text('to')}"]
        environment = scope.environment | {env.text("name"): env.text("value") for env in use.inside("env")}
        shown = f"{namespace}/{name or use.text('exec')}".lstrip("/")
        return Node(f"{shown}-{len(self.nodes) + 1}", words, environment)

    def _parameters(self, param: Use, node: str) -> str:
        """Return the path of a file with the parameters of an element."""
        if not param.has("from"):
            return self._file(node, parameters(param))
        file = absolute(param, "from")
        if not file.is_file():
            raise param.refused(f"from: {file} does not exist")
        return str(file)

    def _file(self, node: str, values: dict[str, object]) -> str:
        """Write parameters of nodes into a file, as `launch_ros` does; return its path."""
        number, path = tempfile.mkstemp(suffix=".yaml", dir=self.folder)
        with os.fdopen(number, "w") as file:
            yaml.dump({node: {"ros__parameters": values}}, file, default_flow_style=False)
        return path


def absolute(use: Use, name: str) -> Path:
    """Return the path in an attribute. Raises Refused for a relative one, which `launch` looks for in the working directory."""
    file = Path(use.text(name))
    if not file.is_absolute():
        raise use.refused(f"{name}: {file} is relative; write $(dirname)/{file}, or $(find-pkg-share PACKAGE)/...")
    return file


def own_name(use: Use) -> str:
    """Return the name of a variable. Raises Refused for those by which `launch` keeps settings of its own."""
    name = use.text("name")
    if name in RESERVED:
        raise use.refused(f"sets {name}, which {NEEDED}")
    return name


def declare(use: Use) -> None:
    """Give an argument its default, if it has no value."""
    name = own_name(use)
    if name not in use.scope.variables:
        if not use.has("default"):
            raise use.refused(f"{name} has no value; give it a default")
        use.scope.variables[name] = use.text("default")
    choices = [choice.text("value") for choice in use.inside("choice")]
    if choices and use.scope.variables[name] not in choices:
        raise use.refused(f"{name} is {use.scope.variables[name]!r}, and none of {', '.join(choices)}")


def parameters(param: Use) -> dict[str, object]:
    """Return a parameter, or those in it, by name."""
    nested = param.inside("param")
    if not nested:
        return {param.text("name"): param.typed()}
    if param.has("value"):
        raise param.refused("has a value, and parameters in it")
    values: dict[str, object] = {}
    for child in nested:
        values |= parameters(child)
    return {param.text("name"): values}


def program(use: Use) -> str:
    """Return the path of the program of a node. Raises Refused if there is none that can be executed."""
    package, name = use.text("pkg"), use.text("exec")
    try:
        file = prefix(package, use.scope.environment) / "lib" / package / name
    except ValueError as error:
        raise use.refused(f"pkg: {error}") from error
    if not file.is_file() or not os.access(file, os.X_OK):
        raise use.refused(f"exec: the package {package} has no executable file {name}")
    return str(file)


class Running:
    """The nodes that run."""

    def __init__(self) -> None:
        self.processes: dict[str, subprocess.Popen[bytes]] = {}
        self.selector = selectors.DefaultSelector()
        self.lines: dict[str, bytes] = {}

    def start(self, node: Node) -> None:
        try:
            process = subprocess.Popen(
                node.words,
                env=node.environment,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                preexec_fn=end_with_parent,
            )
        except OSError as error:
            say(f"[ERROR] [{node.name}]: Unable to launch {node.words[0]}: {error.strerror}")
            return
        self.processes[node.name] = process
        if process.stdout is not None:
            os.set_blocking(process.stdout.fileno(), False)
            self.selector.register(process.stdout, selectors.EVENT_READ, node.name)
        say(f"[INFO] [{node.name}]: process started with pid [{process.pid}]")

    def copy(self, seconds: float) -> bool:
        """Copy lines that nodes print, within a time; return whether there were any."""
        events = self.selector.select(seconds)
        for key, _ in events:
            chunk = os.read(key.fd, CHUNK)
            *lines, self.lines[key.data] = (self.lines.get(key.data, b"") + chunk).split(b"\n")
            if not chunk:
                self.selector.unregister(key.fileobj)
                lines += [line] if (line := self.lines.pop(key.data)) else []
            for line in lines:
                say(f"[{key.data}] {line.decode('utf-8', 'replace')}")
        return bool(events)

    def report(self) -> None:
        """Report the nodes that have ended."""
        for name, process in list(self.processes.items()):
            if process.poll() is None:
                continue
            for _ in range(DRAINED):
                self.copy(0.0)
            del self.processes[name]
            if process.returncode:
                say(f"[ERROR] [{name}]: process has died [pid {process.pid}, exit code {process.returncode}].")
            else:
                say(f"[INFO] [{name}]: process has finished cleanly [pid {process.pid}]")

    def end(self) -> None:
        """End all nodes."""
        for number, seconds in GRACE:
            for process in self.processes.values():
                process.send_signal(number)
            deadline = time.monotonic() + seconds
            while self.processes and time.monotonic() < deadline:
                self.copy(TICK_S)
                self.report()


def end_with_parent() -> None:
    """Let the kernel kill a node if the launcher is killed."""
    LIBC.prctl(PR_SET_PDEATHSIG, int(signal.SIGKILL))


def say(line: str) -> None:
    print(line, flush=True)


def main() -> None:
    """Start all nodes of a launch file, and follow them until a signal comes."""
    told: list[int] = []
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda number, frame: told.append(number))
    launch, running, parent = Path(sys.argv[1]).resolve(), Running(), os.getppid()
    with tempfile.TemporaryDirectory(prefix="ros2-") as folder:
        reader = Reader(Path(folder))
        try:
            reader.read(launch, Scope({}, dict(os.environ), []))
        except Refused as error:
            sys.exit(f"Unable to launch {error}")
        try:
            for node in reader.nodes:
                running.start(node)
            while not told and os.getppid() == parent:
                running.copy(TICK_S)
                running.report()
        finally:
            running.end()


if __name__ == "__main__":
    main()
