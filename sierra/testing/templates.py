"""Conformance suite for template formats, as functions that a plug-in's author calls in tests.

    from sierra.testing import templates as conformance

    def test_it_is_a_template_format():
        conformance.check(lambda data, name: MyTemplate(data, name, MyOptions()), data, ["speed", "robots.count"])

The factory makes a template from the bytes of a file. `data` is such a file. `places` are two or more paths in it; each selects
one value that can become any number. The first two can also become any word. Each claim is one function of a `Trial`, and can
be called alone. A broken claim raises AssertionError with one line, even if Python runs with `-O`.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence

from sierra.errors import ConfigError, SierraError, TemplateError
from sierra.model import Set, Value
from sierra.templates.base import ARGUMENTS, Document, Files, Rendered, Template
from sierra.templates.same_number import same
from sierra.testing.assertions import holds, is_one_line, says_what_its_options_are
from sierra.util.lazy_definitions import dataclass, regex

Make = Callable[[bytes, str], Template]
NAME = "the template of a trial"
WHY = "the change of a trial"
MARK = "aWordThatNoTemplateHas"
NUMBERS = ("7", "-2.5", "1e-05", "12345678901234567890")
TEXTS = ("two words", " blanks ", "it's", '"q"', "<a>&amp;", "a=b", "#c; d", "x\\n", "ü€", "{{braces}}", "line\nline", "", "\t")
"""Texts that a format must keep as they are, or refuse."""
GARBAGE = (b"", b"\0", b"\xff\xfe\x00", b"<", b"{", b"[" * 10_000, b"=\n=", b"\xef\xbb\xbf", bytes(range(256)))
NOWHERE = ("no_path_of_a_template_is_called_so", "//no_path_of_a_template_is_called_so", "")
_FILE = regex(r"[A-Za-z0-9_][A-Za-z0-9_.-]*")


@dataclass(frozen=True, slots=True)
class Trial:
    """A format to test, a file of it, and paths in that file."""

    make: Make
    data: bytes
    places: Sequence[str]

    @property
    def template(self) -> Template:
        return self.make(self.data, NAME)

    def changed(self, *changes: Set, **values: Value) -> Document:
        return self.template.changed(changes, values)

    def after(self, *changes: Set, **values: Value) -> Template:
        """Return the rendered document after changes, read again."""
        return self.template.reread(self.changed(*changes, **values).render(), NAME)


def check(make: Make, data: bytes, places: Sequence[str]) -> None:
    """Check all claims."""
    holds(len(places) > 1, "name at least two places")
    trial = Trial(make, data, places)
    for claim in CLAIMS:
        claim(trial)


def set_to(place: str, value: str, expect: int | None = None) -> Set:
    return Set(place, value, expect=expect, why=WHY)


def has_the_hash_of_its_file(trial: Trial) -> None:
    says_what_its_options_are(trial.template)
    holds(trial.template.sha256 == hashlib.sha256(trial.data).hexdigest(), "sha256 is not the SHA-256 of the file")


def renders_the_same_again(trial: Trial) -> None:
    """Check that rendering gives the same bytes again, also if the document is read again without changes."""
    first = trial.changed().render()
    holds(trial.changed().render() == first, "the input differs when it is rendered again")
    holds(trial.after().changed((), {}).render() == first, "the input differs when the template is read and rendered again")


def renders_safe_files(trial: Trial) -> None:
    """Check that several files have safe and different names, which do not depend on values, and that arguments are texts."""
    rendered, other = (trial.changed(set_to(trial.places[0], value)).render() for value in NUMBERS[:2])
    if isinstance(rendered, bytes):
        holds(isinstance(other, bytes), "the number of files changes from one to several")
        return
    names = [name for name, _ in rendered]
    holds(names == [name for name, _ in _files(other)], "the file names depend on values")
    different = {name.lower() for name in names}
    holds(0 < len(different) == len(names), f"no files, or two files with the same name: {names}")
    for name, content in rendered:
        holds(not name or bool(_FILE.fullmatch(name)), f"{name!r} is not a safe file name; use letters, digits, _ - and .")
        if name == ARGUMENTS:
            words = json.loads(content)
            texts = isinstance(words, list) and all(isinstance(word, str) for word in words)
            holds(texts, f"{words!r} is not a list of arguments")


def finds_values(trial: Trial) -> None:
    """Check that each place has one value, and that a path that selects nothing gives none or is refused in one line."""
    for path in trial.places:
        values = trial.template.find(path)
        holds(len(values) == 1, f"{path!r} selects {len(values)} values, not one")
        holds(all(isinstance(text, str) for text in values), f"{path!r} returns {values!r}, which are not texts")
    for path in NOWHERE:
        try:
            holds(trial.template.find(path) == (), f"{path!r} selects something, but should select nothing")
        except TemplateError as error:
            is_one_line(str(error))


def lists_values(trial: Trial) -> None:
    """Check that the paths of `attributes` select one value each."""
    for path, value in trial.template.attributes():
        holds(trial.template.find(path) == (value,), f"{path!r} selects {trial.template.find(path)!r}, not {value!r}")


def sets_one_value(trial: Trial) -> None:
    """Check that a value is set in its place alone, and that the template stays as it is."""
    for path in trial.places:
        for value in NUMBERS:
            template = trial.template
            before = {other: template.find(other) for other in trial.places}
            changed = template.reread(template.changed([set_to(path, value)], {}).render(), NAME)
            values = changed.find(path)
            holds(len(values) == 1 and same(values[0], value), f"{path!r} was set to {value!r}, but is {values!r}")
            others = [other for other in trial.places if other != path and changed.find(other) != before[other]]
            holds(not others, f"setting {path!r} also changes {others}")
            holds({other: template.find(other) for other in trial.places} == before, "a change alters the template itself")


def keeps_texts(trial: Trial) -> None:
    """Check that any text is kept as it is, or refused in one line; a plain word stands in the rendered bytes."""
    path = trial.places[0]
    for text in TEXTS:
        try:
            values = trial.after(set_to(path, text)).find(path)
        except SierraError as error:
            is_one_line(str(error))
            continue
        wanted = text.replace("{{", "{").replace("}}", "}")
        holds(values == (wanted,), f"{wanted!r} became {values!r}")
    files = _files(trial.changed(set_to(path, MARK)).render())
    holds(any(MARK.encode() in content.replace(b"\0", b"") for _, content in files), f"{MARK} is not in the rendered bytes")


def fills_expressions(trial: Trial) -> None:
    """Check that expressions are filled with values, and that later changes see the results of earlier ones."""
    one, other = trial.places[:2]
    made = trial.after(set_to(one, "{a * 2}"), set_to(other, "{b}"), set_to(one, "{a + 1}"), a=4, b="word")
    holds(made.find(one) == ("5",), f"{{a + 1}} with a = 4 became {made.find(one)!r}, not '5'; the last change wins")
    holds(made.find(other) == ("word",), f"{{b}} became {made.find(other)!r}")
    _is_refused(lambda: trial.changed(set_to(one, "{c}"), a=4), ConfigError, "an expression with an unknown name")


def refuses_changes_that_do_not_fit(trial: Trial) -> None:
    """Check that a change that selects nothing, or another number than expected, is refused and named."""
    for place in NOWHERE:
        _is_refused(lambda place=place: trial.changed(set_to(place, "1")), TemplateError, f"a change of {place!r}")  # type: ignore[misc]
    _is_refused(lambda: trial.changed(set_to(trial.places[0], "1", expect=2)), TemplateError, "a change that expects two")


def makes_inputs_of_runs(trial: Trial) -> None:
    """Check that the function for inputs of runs gives what the changes give, whatever it was called with before."""
    first, other = trial.places[:2]
    document = trial.changed(set_to(other, "3"))
    changes = [set_to(first, "{seed + run}")]
    render = document.per_run(changes)
    for seed in (7, 100, 7):
        expected = trial.changed(set_to(other, "3"), *changes, seed=seed, run=1).render()
        holds(render({"seed": seed, "run": 1}) == expected, "the input of a run differs from the result of the same changes")
    every = trial.changed(*(set_to(path, "3") for path in trial.places))
    holds(every.per_run([])({"seed": 1}) == every.render(), "the input without changes per run differs from the document")
    _is_refused(lambda: document.per_run([set_to(NOWHERE[0], "{seed}")]), TemplateError, "a change of runs, at once,")


def refuses_garbage(trial: Trial) -> None:
    """Check that bytes of another format are refused in one line that names the template, or read."""
    for data in GARBAGE:
        try:
            trial.make(data, NAME).changed((), {}).render()
        except TemplateError as error:
            is_one_line(str(error))
            holds(NAME in str(error), f"{str(error)!r} does not name the template")


def _is_refused(attempt: Callable[[], object], wanted: type[SierraError], what: str) -> None:
    try:
        attempt()
    except wanted as error:
        is_one_line(str(error))
        holds(WHY in str(error), f"{str(error)!r} does not name the origin of the change (Change.why)")
        return
    raise AssertionError(f"{what} did not raise {wanted.__name__}")


def _files(rendered: Rendered) -> Files:
    return (("", rendered),) if isinstance(rendered, bytes) else rendered


CLAIMS: tuple[Callable[[Trial], None], ...] = (
    has_the_hash_of_its_file,
    renders_the_same_again,
    renders_safe_files,
    finds_values,
    lists_values,
    sets_one_value,
    keeps_texts,
    fills_expressions,
    refuses_changes_that_do_not_fit,
    makes_inputs_of_runs,
    refuses_garbage,
)
