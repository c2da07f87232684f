"""Paths into the template for the seed and the variables; each is tested before it is accepted."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import partial

from sierra.errors import UsageError
from sierra.model import Change, Set
from sierra.setup.init.answers import NONE, SHOWN, Ask, Question, settled
from sierra.setup.init.variable_names import mistaken
from sierra.templates.base import Template


def choose_seed(template: Template, found: Sequence[str], given: str | None, ask: Ask | None) -> str | None:
    """Return the path that gets each run's seed; None if there is none. Raises TemplateError."""
    question = Question(
        f"seed: XPath of the attribute or element that gets each run's seed ({NONE} for none)",
        tuple(found),
        found[0] if found else "",
    )
    return settled(given, question, ask, partial(_check_seed, template))


def choose(
    template: Template,
    per_run: Sequence[Change],
    named: Mapping[str, str],
    likely: Mapping[str, str],
    given: Sequence[str],
    ask: Ask | None,
) -> dict[str, str]:
    """Return the variables by name: the given ones; otherwise the likely ones, changed by the user's answers.

    `named` are suggestions. `per_run` is what each run sets after all variables. Raises UsageError, TemplateError.
    """
    chosen = {} if given else dict(likely)
    for text in given:
        chosen |= [_check(template, per_run, chosen, text)]
    while ask is not None and not given:
        so_far = ", ".join(f"{name}={path}" for name, path in chosen.items()) or "none"
        others = [f"{name}={path}" for name, path in named.items() if path not in chosen.values()]
        question = Question(
            f"variables so far: {so_far}\nadd one as NAME=XPATH ({NONE}NAME removes one, Enter finishes)",
            tuple(others[:SHOWN]),
            "",
        )
        more = ask(question, partial(_one_more, template, per_run, chosen))
        if more is None:
            break
        chosen = more
    return chosen


def doubts(seed: str | None, seeds: Sequence[str], *, elsewhere: bool) -> Iterator[str]:
    """Yield warnings about seeds.

    `seeds` are the paths of all numbers that are called a seed. `elsewhere`: whether runs also get their seeds without a path.
    """
    if seed is None and not elsewhere:
        yield 'all runs of an experiment are the same until they use the seed: set seed = "XPATH", or use {seed} in the command'
    others = [path for path in seeds if path != seed]
    if seed is not None and others:
        yield f"these seeds keep the template's value in all runs: {', '.join(others)}"


def _check_seed(template: Template, text: str) -> str | None:
    if text in ("", NONE):
        return None
    template.changed((Set(text, "0", why="seed"),), {})
    return text


def _check(template: Template, per_run: Sequence[Change], known: Iterable[str], text: str) -> tuple[str, str]:
    """Return name and path from NAME=XPATH. Raises UsageError."""
    name, equals, path = (part.strip() for part in text.partition("="))
    if not equals or not name or not path or name[0] in "/@":
        raise UsageError(f'{text!r}: give a variable as NAME=XPATH, as in "population_size=//swarm/@count"')
    why = f"variable {name!r}"
    if said := mistaken(name, known):
        raise UsageError(f"{why}: {said}")
    one, two = (template.changed((Set(path, value, why=why), *per_run), {"seed": 0}).render() for value in ("1", "2"))
    if one == two:
        raise UsageError(f"{why}: {path} gets the seed; vary something else, or use montecarlo.C20 for other seeds")
    return name, path


def _one_more(template: Template, per_run: Sequence[Change], chosen: dict[str, str], text: str) -> dict[str, str] | None:
    """Return the variables after one answer; None if it is empty. If a path is named twice, the last name stays."""
    if not text:
        return None
    if text.startswith(NONE):
        name = text.removeprefix(NONE).strip()
        if name not in chosen:
            raise UsageError(f"there is no variable {name!r}; variables so far: {', '.join(chosen) or 'none'}")
        return {other: path for other, path in chosen.items() if other != name}
    name, path = _check(template, per_run, chosen, text)
    return {other: place for other, place in chosen.items() if place != path} | {name: path}
