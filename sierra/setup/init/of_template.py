"""The first settings of a program that reads generated files: one template, or several that name each other."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path

from sierra import templates
from sierra.config import extensions, project_file
from sierra.config.plugin_registry import PLATFORMS
from sierra.model import Set
from sierra.provenance import referenced_files
from sierra.setup.init import arguments, command, environment, folder, named_files, source, variables
from sierra.setup.init.answers import Ask, Options
from sierra.setup.init.environment import SOME
from sierra.setup.init.named_files import Inputs
from sierra.setup.init.write import REPEAT, Guess
from sierra.templates.base import Template


def guess(root: Path, template: str, content: Template, options: Options, ask: Ask | None) -> Guess:
    """Return the guess for a program that reads a generated file, or several."""
    started = command.choose(root, template, options.command, ask)
    inputs, started = _inputs(root, template, options, started)
    if inputs.several:
        content = templates.of_project(project_file.parse({**inputs.settings, "command": "-"}, "sierra init"), root)
    platform_name, platform = command.platform(inputs.settings, started)
    numbers = variables.numbers(content)
    seeds = variables.seeds(numbers)
    by_platform = platform.seed_changes()
    seed = None
    if not by_platform or options.seed is not None:
        check_seed = partial(variables.check_seed, content)
        seed = variables.choose_seed(seeds, options.seed, ask, check_seed, "XPath of the attribute or element")
    elsewhere = bool(by_platform) or seed is not None or options.seed is not None
    started, more = _with_arguments(started, seeded=elsewhere)
    per_run = (*by_platform, *([Set(seed, "{seed}")] if seed else []))
    set_by_seed = variables.seeded(content, per_run, numbers)
    free = {path: value for path, value in numbers.items() if path not in (*set_by_seed, *seeds)}
    named = variables.named(free, platform.criteria())
    likely = {} if platform.criteria() else dict(list(named.items())[:1])
    unset = [path for path in variables.unset(content) if path not in set_by_seed]
    if unset:  # a placeholder without a value is an error
        likely = {name: path for name, path in named.items() if path in unset}
    chosen = variables.choose(named, likely, options.variables, ask, partial(variables.check, content, per_run))
    known = (*named, *chosen, *platform.criteria())
    set_by = _environment(root, started)
    wrong = (*command.warnings(platform, root, inputs.settings, set_by), *command.services(started or ""))
    seeded = bool(by_platform) or "{seed}" in (started or "")
    return Guess(
        template=None if inputs.several else template,
        templates=inputs.several,
        files=inputs.files,
        format=options.format,
        platform=platform_name,
        command=started,
        module_path=command.module_path(started, root),
        seed=seed,
        variables=chosen,
        other_variables={name: path for name, path in named.items() if name not in chosen and path not in chosen.values()}
        | {name: words for name, words in more.items() if not variables.refused(name, known)}
        | {name: f"{REPEAT}{path}" for name, path in variables.repeats(free, known).items()}
        | variables.words(content, known),
        environment=set_by,
        tried=_criteria(chosen, unset),
        source=source.choose(root, inputs.paths, options.source, ask),
        next=variables.first_query(platform, content, chosen),
        unset=tuple(unset),
        ports=variables.ports(free),
        given=options.command is not None or ask is not None,
        doubtful=bool(wrong),
        notes=(
            *wrong,
            *variables.with_comments(content, referenced_files.text(root / template)),
            *variables.warnings(seed, [path for path in seeds if path not in set_by_seed], elsewhere=seeded),
            *folder.warnings(root),
        ),
    )


def _criteria(chosen: Mapping[str, str], unset: Sequence[str]) -> tuple[str, ...]:
    """Return the criteria of the run that is tried: values for placeholders without one; none if a variable is missing."""
    if not set(unset) <= set(chosen.values()):
        return ()
    return tuple(f"{name}={SOME}" for name, path in chosen.items() if path in unset)


def _environment(root: Path, started: str | None) -> dict[str, str]:
    """Return the variable of the environment that tells a program the name of its input, if its command does not."""
    if started is None or "{input" in started or "{run}" in started:
        return {}
    name = environment.of_file(environment.read_by(root, shlex.split(started)))
    return {name: "{input}"} if name else {}


def _with_arguments(started: str | None, *, seeded: bool) -> tuple[str | None, dict[str, str]]:
    """Return the command with `{seed}` as the value of its seed, unless runs have seeds; and its other numbers as variables."""
    if started is None:
        return None, {}
    words = shlex.split(started)
    by_key = {argument.key: argument for argument in arguments.find(words)}
    numbers = arguments.numbers(tuple(by_key.values()))
    seeds = variables.seeds(numbers)
    named = variables.named({key: value for key, value in numbers.items() if key not in seeds}, ())
    more = {name: by_key[key].declared for name, key in named.items()}
    if seeded or not seeds or "{seed}" in started:
        return started, more
    return command.joined(arguments.placed(words, by_key[seeds[0]], ())), more


def _inputs(root: Path, template: str, options: Options, started: str | None) -> tuple[Inputs, str | None]:
    """Return the templates and the files that they name, and the command with the placeholders of all templates."""
    name = extensions.starts().get(Path(template).suffix)
    if name is not None and getattr(PLATFORMS.load(name), "finds_files", False):
        return Inputs(template), started
    words = shlex.split(started or "")
    others = {} if options.command is None or "{input" in options.command else named_files.by_command(root, words)
    inputs = named_files.find(root, template, tuple(dict.fromkeys(others.values())), alone=options.format is not None)
    if started is None:
        return inputs, None
    for number, path in others.items():
        name = words[number].rpartition("=")[2]
        words[number] = words[number].removesuffix(name) + inputs.placeholder(path)
    return inputs, command.joined(word.replace("{input}", inputs.placeholder(template)) for word in words)
