"""The variables of a first `sierra.toml`: their names and paths in the template, and a first query over one of them.

Each path is tested before it is accepted.
"""

from __future__ import annotations

import contextlib
import re
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from decimal import Decimal
from functools import partial
from itertools import count
from typing import TypeVar

from sierra.config.change_tables import PORT_NAMES
from sierra.design.overwritten import SOME_SEED
from sierra.design.platforms.base import Platform
from sierra.design.query import grammar
from sierra.errors import QueryError, SierraError, UsageError
from sierra.model import Change, Set
from sierra.setup.init.answers import NONE, SHOWN, Ask, Question, checked_answer
from sierra.templates.base import Template
from sierra.util.lazy_definitions import regex
from sierra.util.text import few

T = TypeVar("T")

NAME = regex(r"[A-Za-z_][A-Za-z0-9_]*")
NUMBER = regex(r"[+-]?\d+(\.\d+)?")
COMMENTED = regex(r"^[ \t]*([^\s=:;#\[][^=:\n]*?)[ \t]*[=:][ \t]*[+-]?\d+(?:\.\d+)?[ \t]+[;#]", re.MULTILINE)
"""A key with a number and a comment behind it."""
CROWDS = frozenset(
    ["population", "robots", "agents", "swarm", "individuals", "vehicles", "drones", "boids", "ants", "particles"]
)
COUNTS = frozenset(["quantity", "count", "number", "num", "n", "amount"])
BESIDE = frozenset(["size", "of", "total", "model"])
SEEDS = frozenset(["rng", "rngrun", "random_state", "randomstate", "random-state"])
"""Names of seeds without the word."""
GENERIC = frozenset(["value", "val", "default", "data"])
SELDOM = frozenset(["id", "name", "version", "port", "threads", "jobs", "workers", "verbosity", *"xyz", "roll", "pitch", "yaw"])
OF_RUNS = frozenset(["run", "runs", "repetition", "repetitions", "rep", "reps", "replicate", "replicates", "trial", "trials"])
"""Names of numbers of runs, of which SIERRA makes as many as a query asks for."""
OF_TIME = frozenset(["time", "delta", "dt", "step", "steps", "tick", "ticks", "duration", "length", "begin", "end", "start"])
"""Names of numbers that are less likely the first variable of a study."""
CHOICES = frozenset(
    ["controller", "algorithm", "strategy", "policy", "behaviour", "behavior", "mode", "method", "planner", "topology"]
)
ITEM = regex(r"/item\[\d+\]")
WORD = regex(r"[A-Za-z][A-Za-z0-9_-]{0,31}", re.ASCII)
PORT_NUMBERS = range(1024, 65536)
IS_SEED = "gets the seed; vary something else, or use montecarlo.C20 for other seeds"
POPULATION = "population_size"
OF_PLATFORMS = (f"{POPULATION}.Log8", "scale=0.5,1,2")
"""First queries over criteria of platforms, the better one first."""
FEW = 16
"""The largest value that doubling from 1 reaches soon enough."""


def numbers(template: Template) -> dict[str, str]:
    """Return the paths that select one number, with the number; of a text, the paths of all placeholders."""
    found = {path: value.strip() for path, value in template.attributes()}
    return _of_all_items({path: value for path, value in found.items() if _is_text(template) or NUMBER.fullmatch(value)})


def _of_all_items(numbers: Mapping[str, str]) -> dict[str, str]:
    """Return the paths of numbers; one for the items of a list that have the same number, instead of one for each."""
    alike = Counter(ITEM.sub("/item", path) for path in numbers)
    paths: dict[str, str] = {}
    for path, value in numbers.items():
        of_all = ITEM.sub("/item", path)
        paths.setdefault(of_all if alike[of_all] > 1 and len(ITEM.findall(path)) == 1 else path, value)
    return paths


def repeats(numbers: Mapping[str, str], known: Collection[str]) -> dict[str, str]:
    """Return the first items of lists that queries can make more or fewer of, by the name of such a variable."""
    lists = dict.fromkeys(path.partition("/item/")[0] for path in numbers if "/item/" in path)
    items: dict[str, str] = {}
    for path in lists:
        name = path.rpartition("/")[2]
        crowd = set(_words(name)) <= CROWDS and POPULATION not in known
        if (own := POPULATION if crowd else f"number_of_{name}") not in items and refused(own, known) is None:
            items[own] = f"{path}/item[1]"
    return items


def words(template: Template, known: Collection[str]) -> dict[str, str]:
    """Return the paths of words that probably are one of a few, such as the name of a controller, by variable."""
    paths: dict[str, str] = {}
    for path, text in template.attributes():
        short, _ = _called(path)
        name = re.sub(r"\W", "_", short, flags=re.ASCII)
        is_choice = set(_words(short)) & CHOICES or text.strip().lower() in ("true", "false")
        if is_choice and WORD.fullmatch(text.strip()) and refused(name, {*paths, *known}) is None:
            paths[name] = path
    return dict(list(paths.items())[:SHOWN])


def with_comments(template: Template, text: str) -> Iterator[str]:
    """Yield a note on numbers in an INI or properties file that no change can set, because a comment stands behind them."""
    from sierra.templates.ini import IniTemplate, PropertiesTemplate

    commented = COMMENTED.findall(text) if isinstance(template, IniTemplate | PropertiesTemplate) else []
    if commented:
        keys = few(list(dict.fromkeys(commented)), SHOWN)
        yield f"to vary {keys}, write the comment behind the value on a line of its own: programs read such values differently"


def unset(template: Template) -> tuple[str, ...]:
    """Return the paths of placeholders, which have no value."""
    return tuple(path for path, _ in template.attributes()) if _is_text(template) else ()


def _is_text(template: Template) -> bool:
    from sierra.templates.text import TextTemplate

    return isinstance(template, TextTemplate)


def seeds(numbers: Iterable[str]) -> tuple[str, ...]:
    """Return the paths of numbers that are called a seed."""
    called = {path: _called(path)[0] for path in numbers}
    return tuple(
        path for path, name in called.items() if name.lower() in SEEDS or any(w.endswith("seed") for w in _words(name))
    )


def named(numbers: Mapping[str, str], known: Collection[str]) -> dict[str, str]:
    """Return possible variables by name; the first is population_size, unless `known` already has a criterion for it."""
    robots = None if known else _counting(numbers)
    paths = {POPULATION: robots} if robots else {}
    for path in sorted(numbers, key=lambda path: bool(set(_words(_called(path)[0])) & OF_TIME)):
        short, element = _called(path)
        proposed = (re.sub(r"\W", "_", name, flags=re.ASCII) for name in (short, f"{element}_{short}"))
        name = next((name for name in proposed if not refused(name, {*paths, *known})), None)
        counts_runs = set(_words(short)) <= {*OF_RUNS, *BESIDE, *COUNTS, "id"} and set(_words(short)) & OF_RUNS
        seldom = short.lower() in SELDOM or counts_runs or is_port(short, numbers[path])
        if name and path != robots and not seldom and len(paths) <= SHOWN:
            paths[name] = path
    return paths


def ports(numbers: Mapping[str, str]) -> dict[str, str]:
    """Return the paths of ports, with the names of placeholders for them: the same one for the same number."""
    found = {path: value for path, value in numbers.items() if is_port(_called(path)[0], value)}
    names = dict(zip(dict.fromkeys(found.values()), PORT_NAMES, strict=False))
    return {path: names[value] for path, value in found.items() if value in names}


def is_port(name: str, value: str) -> bool:
    """Return whether a value is the number of a port, by its name."""
    return "port" in words_of(name) and value.isdecimal() and int(value) in PORT_NUMBERS


def words_of(name: str) -> set[str]:
    """Return the words in a name, also in one such as `remotePort`."""
    return {part.lower() for part in re.findall(r"[A-Z]?[a-z]+|[A-Z]+", name)}


def named_place(text: str, form: str, example: str) -> tuple[str, str]:
    """Return name and place from NAME=PLACE. Raises UsageError."""
    name, equals, place = (part.strip() for part in text.partition("="))
    if not equals or not name or not place:
        raise UsageError(f'{text!r}: give a variable as {form}, as in "{example}"')
    return name, place


def refused(name: str, known: Iterable[str]) -> str | None:
    """Return why queries or the store cannot have a name, and what would be right; None if they can."""
    if not NAME.fullmatch(name):
        return "this is not a name of letters, digits and _; use a name such as my_name"
    if name.lower() in {other.lower() for other in known}:
        return "this name is used already; use another name"
    try:
        grammar.parse_all([f"{name}=1"])
    except QueryError as error:
        return str(error).rpartition(": ")[2]
    return None


def _counting(numbers: Mapping[str, str]) -> str | None:
    """Return the path that most likely selects the number of robots; None if no path does."""
    counts = [
        (path, set(_words(short)), set(_words(element)))
        for path, value in numbers.items()
        for short, element in [_called(path)]
        if value.isdigit() and set(_words(short)) <= CROWDS | COUNTS | BESIDE
    ]
    likely = [path for path, words, of_element in counts if (words | of_element) & CROWDS]
    return next(iter([*likely, *(path for path, words, _ in counts if words & COUNTS)]), None)


def _called(path: str) -> tuple[str, str]:
    """Return a name for what a path selects, and its element: for `//param[@name='speed']/@value`, the name is speed."""
    element, _, attribute = path.rpartition("/@") if "/@" in path else (path, "", "")
    above = re.search(r"/([^/\[\]]+)/[^/]+$", element) if not attribute else None
    named = re.search(r"\[(?:@\w+|local-name\(\))='(.+)'\]$", element)
    label = named[1] if named else re.split("[/:]", element)[-1]
    attribute = attribute.rpartition(":")[2]
    if label.lower() in GENERIC and (around := re.search(r"\[(?:@\w+|local-name\(\))='([^']+)'\]/[^/]+$", element)):
        label = around[1]
    if above:
        return label, above[1]
    return (label if not attribute or attribute.lower() in GENERIC else attribute), label


def _words(name: str) -> list[str]:
    """Return the words of a name: `numRobots` and `num_robots` are num, robots."""
    return [word.lower() for word in re.findall(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])", name)]


def choose_seed(found: Sequence[str], given: str | None, ask: Ask | None, check: Callable[[str], T], place: str) -> T:
    """Return the place that gets each run's seed, as `check` returns it. `place` says what a place is, for the question."""
    question = Question(f"seed: {place} that gets each run's seed ({NONE} for none)", tuple(found), found[0] if found else "")
    return checked_answer(given, question, ask, check)


def choose(
    named: Mapping[str, str],
    likely: Mapping[str, str],
    given: Sequence[str],
    ask: Ask | None,
    check: Callable[[Mapping[str, str], str], tuple[str, str]],
    form: str = "NAME=XPATH",
) -> dict[str, str]:
    """Return the places of variables by name: the given ones; otherwise the likely ones, changed by the user's answers.

    `named` are suggestions. `check` returns the name and the place in an answer of this `form`, beside the variables so far, or
    raises an error.
    """
    chosen = {} if given else dict(likely)
    for text in given:
        chosen |= [check(chosen, text)]
    while ask is not None and not given:
        so_far = ", ".join(f"{name}={path}" for name, path in chosen.items()) or "none"
        others = [f"{name}={path}" for name, path in named.items() if path not in chosen.values()]
        question = Question(
            f"variables so far: {so_far}\nadd one as {form} ({NONE}NAME removes one, Enter finishes)",
            tuple(others[:SHOWN]),
            "",
        )
        more = ask(question, partial(_one_more, check, chosen))
        if more is None:
            break
        chosen = more
    return chosen


def warnings(seed: str | None, seeds: Sequence[str], *, elsewhere: bool) -> Iterator[str]:
    """Yield warnings about `seeds`, the paths of numbers called so that no run's seed reaches.

    `elsewhere`: whether runs get seeds without a path.
    """
    if seed is None and not elsewhere:
        yield 'all runs of an experiment are the same until they use the seed: set seed = "XPATH", or use {seed} in the command'
    if seed is not None and seeds:
        yield f"these seeds keep the template's value in all runs: {', '.join(seeds)}"


def seeded(template: Template, changes: Sequence[Change], paths: Iterable[str]) -> set[str]:
    """Return the paths among `found` whose value changes with the seed: a path can be written in several ways."""
    before = {path: template.find(path) for path in paths}
    seed = next(number for number in count(SOME_SEED) if all((str(number),) != texts for texts in before.values()))
    try:
        after = template.reread(template.changed(changes, {"seed": seed}).render(), "template")
    except SierraError:  # a platform's changes of the seed may need its other changes
        return {change.path for change in changes if isinstance(change, Set) and change.path in before}
    return {path for path, texts in before.items() if after.find(path) != texts}


def check_seed(template: Template, text: str) -> str | None:
    """Return the path that gets each run's seed; None if there is none. Raises TemplateError."""
    if text in ("", NONE):
        return None
    template.changed((Set(text, "0", why="seed"),), {})
    return text


def check(template: Template, per_run: Sequence[Change], known: Iterable[str], text: str) -> tuple[str, str]:
    """Return name and path from NAME=XPATH. `per_run` is what each run sets later. Raises UsageError, TemplateError."""
    name, equals, path = (part.strip() for part in text.partition("="))
    if not equals or not name or not path or name[0] in "/@":
        raise UsageError(f'{text!r}: give a variable as NAME=XPATH, as in "population_size=//swarm/@count"')
    why = f"variable {name!r}"
    if refusal := refused(name, known):
        raise UsageError(f"{why}: {refusal}")
    others = [Set(other, "0") for other in unset(template)]
    changes = [(*others, Set(path, value, why=why)) for value in ("1", "2")]
    for change in changes:
        template.changed(change, {})
    try:
        texts = [template.changed((*change, *per_run), {"seed": 0}).render() for change in changes]
    except SierraError:  # a platform's changes of the seed may need its other changes
        return name, path
    if texts[0] == texts[1]:
        raise UsageError(f"{why}: {path} {IS_SEED}")
    return name, path


def _one_more(
    check: Callable[[Mapping[str, str], str], tuple[str, str]], chosen: dict[str, str], text: str
) -> dict[str, str] | None:
    """Return the variables after one answer; None if it is empty. If a place is named twice, the last name stays."""
    if not text:
        return None
    if text.startswith(NONE):
        name = text.removeprefix(NONE).strip()
        if name not in chosen:
            raise UsageError(f"there is no variable {name!r}; variables so far: {', '.join(chosen) or 'none'}")
        return {other: path for other, path in chosen.items() if other != name}
    name, new = check(chosen, text)
    return {other: old for other, old in chosen.items() if old != new} | {name: new}


def first_query(platform: Platform, template: Template, variables: Mapping[str, str]) -> str | None:
    """Return a query over the platform's population, or else over the first variable; None if there is neither."""
    for criterion in (grammar.parse(text) for text in OF_PLATFORMS):
        with contextlib.suppress(SierraError):  # the platform finds no population in the template
            if criterion.name not in variables and platform.criterion(criterion, template):
                return grammar.text(criterion)
    if unset(template):  # each placeholder needs a value
        return " ".join(f"{name}=1,2" for name in variables) or None
    return next((around(name, template.find(path)[0].strip()) for name, path in variables.items()), None)


def around(name: str, value: str) -> str:
    """Return a criterion with values around the one that a variable has now."""
    if not re.fullmatch(r"[+-]?\d{1,6}(\.\d{1,6})?", value, re.ASCII):
        return _word(name, value)
    number = Decimal(value)
    if not number:
        return f"{name}=0:1:5" if "." in value else f"{name}=0,1,2"
    if value.isdigit() and (name == POPULATION or number <= FEW):
        return f"{name}.Log8"
    return f"{name}=" + ",".join(f"{(number * times).normalize():f}" for times in (Decimal("0.5"), 1, 2))


def _word(name: str, value: str) -> str:
    """Return a criterion with the word's own value, as an example; with VALUE if a query cannot contain that value."""
    if value.lower() in ("true", "false"):
        return f"{name}=true,false" if value.islower() else f"{name}=True,False"
    try:
        return grammar.text(grammar.parse(f"{name}={value}"))
    except QueryError:
        return f"{name}=VALUE"
