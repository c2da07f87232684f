"""The first settings of a program that reads only its arguments."""

from __future__ import annotations

import shlex
from functools import partial
from pathlib import Path

from sierra.setup.init import arguments, command, environment, folder, of_environment, source, variables
from sierra.setup.init.answers import Ask, Options
from sierra.setup.init.write import Guess


def guess(root: Path, options: Options, ask: Ask | None) -> Guess:
    """Return the guess for a program that reads only its arguments."""
    line = command.choose(root, None, options.command, ask) or ""
    words = shlex.split(line)
    own = arguments.find(words)
    if not own and not arguments.placeholders(words) and (reads := environment.read_by(root, words)):
        return of_environment.guess(root, options, ask, line, reads)
    numbers = arguments.numbers(own)
    by_key = {each.key: each for each in own}
    seeds = [by_key[key].name for key in variables.seeds(numbers)]
    if any("{seed}" in word for word in words) and options.seed is None:
        seed = None
    else:
        seed = variables.choose_seed(seeds, options.seed, ask, partial(arguments.check_seed, own), "argument")
    free = {key: value for key, value in numbers.items() if by_key[key].name not in seeds}
    named = {name: by_key[key].name for name, key in variables.named(free, ()).items()}
    used = arguments.placeholders(words)
    likely = {} if used else dict(list(named.items())[:1])
    check = partial(arguments.check_variable, own, seed)
    chosen = variables.choose(named, likely, options.variables, ask, check, "NAME=ARGUMENT")
    by_name = {each.name: each for each in own}
    removed = {name: by_name[argument] for name, argument in chosen.items()}
    started = command.joined(arguments.placed(words, seed, removed.values()))
    values = {name: each.value for name, each in removed.items()}
    places = {name: f"{{{name}}}" for name in used} | {name: each.declared for name, each in removed.items()}
    first = next((variables.around(name, value) for name, value in values.items()), None)
    platform_name, platform = command.platform({}, started)
    wrong = (*command.warnings(platform, root, {}), *command.services(started))
    return Guess(
        template=None,
        format=None,
        platform=platform_name,
        command=started,
        module_path=command.module_path(started, root),
        seed=None,
        variables=places,
        other_variables={
            name: by_name[argument].declared
            for name, argument in named.items()
            if argument not in chosen.values() and (seed is None or argument != seed.name)
        },
        tried=arguments.criteria({**dict.fromkeys(used, environment.SOME), **values}),
        source=source.choose(root, (), options.source, ask),
        next=" ".join(f"{name}=1,2" for name in used) or first,
        unset=tuple(f"{{{name}}}" for name in used),
        given=options.command is not None or ask is not None,
        doubtful=bool(wrong),
        notes=(*wrong, *arguments.warnings(started, seeds, seed), *folder.warnings(root)),
    )
