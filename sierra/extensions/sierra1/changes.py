"""Changes of `controllers.yaml` as changes of `sierra.toml`, tried on the template one after another.

SIERRA 1.x changes the first match of a path, and only warns if there is none. Here each path must match. So a change that
matches nothing is left out and listed, because it had no effect before. If a path matches several places, `(PATH)[1]` keeps its
meaning.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator, Mapping
from xml.sax.saxutils import quoteattr

from sierra.errors import SierraError
from sierra.extensions.argos.platform import PLACEHOLDER, ROOT
from sierra.extensions.sierra1.yaml_values import Plain
from sierra.model import Add, Change, Remove, Rename, Set, Value
from sierra.templates.base import Template
from sierra.util.lazy_definitions import dataclass, field, regex

SETS = ("attr_change", "attr_add")
RENAMES = ("element_change", "tag_change")
ADDS = ("element_add", "tag_add")
REMOVES = ("element_remove", "tag_remove")
LONGEST = 2000
"""Maximum number of characters of the attributes of an element."""
_TAG = regex(r"[A-Za-z_][\w.-]*")


@dataclass(slots=True)
class Trial:
    """A template with changes that fit it, to which further ones are added."""

    template: Template
    values: Mapping[str, Value]
    changes: list[Change] = field(default_factory=list)

    def count(self, path: str) -> int:
        """Return the number of places that a path selects after the changes. Raises SierraError for an invalid path."""
        return len(self.document().find(path))

    def document(self) -> Template:
        rendered = self.template.changed(self.changes, self.values).render()
        return self.template.reread(rendered, "the changed template")

    def fits(self, change: Change) -> str | None:
        """Add a change; return None if it fits, or else why not."""
        try:
            self.template.changed((*self.changes, change), self.values).render()
        except SierraError as error:
            return str(error)
        self.changes.append(change)
        return None


@dataclass(frozen=True, slots=True)
class Old:
    """One old change: its kind, and its words."""

    where: str
    kind: str
    words: tuple[str, ...]

    def __str__(self) -> str:
        return f"{self.where}: {self.kind} {list(self.words)}"


def listed(section: Plain | None, where: str) -> Iterator[Old | str]:
    """Yield the changes in the section `xml` of a category or a controller, and a message for each that is not understood."""
    if not isinstance(section, dict):
        return
    for kind, items in section.items():
        if kind not in (*SETS, *RENAMES, *ADDS, *REMOVES):
            yield f"{where}: {kind}: unknown kind of change"
            continue
        for item in items if isinstance(items, list) else [items]:
            if isinstance(item, list) and len(item) >= 2 and all(isinstance(word, str) for word in item):
                yield Old(where, kind, tuple(str(word) for word in item))
            else:
                yield f"{where}: {kind}: {str(item)[:120]} is not a list of texts"


def translated(old: Old, trial: Trial, controller: str) -> Change | str:
    """Return the new form of a change and add it to the trial, or return why it cannot be carried over."""
    try:
        made = _converted(old, trial, controller)
    except SierraError as error:
        return f"{old}: {error}"
    if isinstance(made, str):
        return f"{old}: {made}"
    return f"{old}: {wrong}" if (wrong := trial.fits(made)) else made


def xpath(path: str, controller: str) -> str:
    """Return an XPath for a path of ElementTree, which begins at the root element; the placeholder becomes the controller."""
    path = path.replace(PLACEHOLDER, controller)
    if path in (".", ""):
        return ROOT
    if path.startswith(".//"):
        return path[1:]
    return f"{ROOT}/{path.removeprefix('./')}"


def _converted(old: Old, trial: Trial, controller: str) -> Change | str:
    path, second, *rest = old.words
    if "__UUID__" in path:
        return "__UUID__ stands for each robot; add one change for each"
    parent = xpath(path, controller)
    if old.kind in SETS:
        return _set(trial, parent, second, rest, must_exist=old.kind == "attr_change")
    second = second.replace(PLACEHOLDER, controller)
    if not _TAG.fullmatch(second):
        return f"{second!r} is not a tag"
    if old.kind in ADDS:
        return _add(trial, parent, second, rest)
    where = first(trial, f"{parent}/{second}")
    if where is None:
        if old.kind in RENAMES and trial.count(f"{parent}/@{second}"):
            return f"{second!r} is an attribute, not a tag, so it had no effect; was attr_change meant?"
        return _nothing(trial, f"{parent}/{second}")
    if old.kind in REMOVES:
        return Remove(where)
    if len(rest) != 1 or not _TAG.fullmatch(rest[0]):
        return "it needs a path, a tag and a new tag"
    return Rename(where, rest[0])


def first(trial: Trial, path: str) -> str | None:
    """Return an XPath of the first place that a path selects; None if there is none."""
    count = trial.count(path)
    return None if not count else path if count == 1 else f"({path})[1]"


def _nothing(trial: Trial, path: str) -> str:
    if trial.template.find(path):
        return "another change removes this part before, for example the visualization"
    return "it matches nothing in the template, so it had no effect"


def _set(trial: Trial, parent: str, attribute: str, rest: list[str], *, must_exist: bool) -> Change | str:
    if len(rest) != 1 or not _TAG.fullmatch(attribute):
        return "it needs a path, an attribute and a value"
    place = first(trial, parent)
    if place is None:
        return _nothing(trial, parent)
    exists = trial.count(f"{place}/@{attribute}")
    if must_exist and not exists:
        return f"the template has no attribute {attribute!r} there, so it had no effect"
    return Set(place, literal(rest[0]), attribute=attribute)


def _add(trial: Trial, parent: str, tag: str, rest: list[str]) -> Change | str:
    place = first(trial, parent)
    if place is None:
        return _nothing(trial, parent)
    attributes = _attributes(rest[0] if rest else "{}")
    if attributes is None:
        return "its attributes are not a plain list of names and values"
    written = "".join(f" {name}={quoteattr(literal(value))}" for name, value in attributes.items())
    return Add(place, f"<{tag}{written}/>")


def _attributes(text: str) -> dict[str, str] | None:
    """Return the names and values of a literal dictionary; nothing is evaluated."""
    if len(text) > LONGEST:
        return None
    try:
        evaluated: object = ast.literal_eval(text)
    except (ValueError, SyntaxError, MemoryError, RecursionError):
        return None
    if not isinstance(evaluated, dict):
        return None
    pairs = {str(name): str(value) for name, value in evaluated.items() if isinstance(value, str | int | float)}
    return pairs if len(pairs) == len(evaluated) and all(_TAG.fullmatch(name) for name in pairs) else None


def literal(text: str) -> str:
    """Return a text in which braces are no expressions."""
    return text.replace("{", "{{").replace("}", "}}")
