"""The first settings of a program that reads only variables of the environment."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from functools import partial
from pathlib import Path

from sierra.errors import UsageError
from sierra.setup.init import arguments, command, environment, folder, source, variables
from sierra.setup.init.answers import NONE, Ask, Options
from sierra.setup.init.write import ENVIRONMENT, Guess


def guess(
    root: Path, options: Options, ask: Ask | None, started: str, reads: Mapping[str, str], assigned: Collection[str] = ()
) -> Guess:
    """Return the guess for a program that is started like this; `reads` are its variables with their defaults.

    `assigned` are those whose values the user has given.
    """
    seeds = environment.seeds(reads)
    seed = variables.choose_seed(seeds, options.seed, ask, partial(_check_seed, reads), "variable of the environment")
    by_key = {f"/{name.lower()}": name for name in reads}
    values = environment.values({name: default for name, default in reads.items() if name not in seeds})
    named = {name: by_key[key] for name, key in variables.named(values, ()).items()}
    likely = dict(list(named.items())[:1])
    check = partial(_check_variable, reads, seed)
    chosen = variables.choose(named, likely, options.variables, ask, check, "NAME=VARIABLE")
    tried = {name: reads[variable] or environment.SOME for name, variable in chosen.items()}
    rest = [name for name, default in reads.items() if not default and name not in (*seeds, *chosen.values())]
    platform_name, platform = command.platform({}, started)
    wrong = tuple(command.warnings(platform, root, {}))
    return Guess(
        template=None,
        format=None,
        platform=platform_name,
        command=started,
        module_path=command.module_path(started, root),
        seed=None,
        variable_seed=seed or "",
        variables={name: f"{ENVIRONMENT}{variable}" for name, variable in chosen.items()},
        other_variables={
            name: f"{ENVIRONMENT}{variable}" for name, variable in named.items() if variable not in (seed, *chosen.values())
        },
        environment={name: reads[name] for name in assigned if name not in (seed, *chosen.values())},
        tried=arguments.criteria(tried),
        source=source.choose(root, (), options.source, ask),
        next=next((variables.around(name, value) for name, value in tried.items()), None),
        unset=(),
        given=options.command is not None or ask is not None,
        doubtful=bool(wrong),
        notes=(*wrong, *_warnings(seed, rest), *folder.warnings(root)),
    )


def _warnings(seed: str | None, rest: list[str]) -> tuple[str, ...]:
    no_seed = 'all runs of an experiment are the same until they use the seed: set seed = { environment = "SEED" }'
    needed = f"the program reads {', '.join(rest)} too; if they have no defaults, set them under [environment]"
    return (*([] if seed else [no_seed]), *([needed] if rest else []))


def _check_seed(reads: Mapping[str, str], text: str) -> str | None:
    """Return the variable that gets the seed; None for none. Raises UsageError."""
    return None if text in ("", NONE) else _known(reads, text)


def _check_variable(reads: Mapping[str, str], seed: str | None, known: Mapping[str, str], text: str) -> tuple[str, str]:
    """Return the names of a variable of queries and of one of the environment, from NAME=VARIABLE. Raises UsageError."""
    name, variable = variables.named_place(text, "NAME=VARIABLE", "population_size=N_ROBOTS")
    if refusal := variables.refused(name, known):
        raise UsageError(f"variable {name!r}: {refusal}")
    if variable == seed:
        raise UsageError(f"variable {name!r}: {variable} {variables.IS_SEED}")
    return name, _known(reads, variable)


def _known(reads: Mapping[str, str], variable: str) -> str:
    if variable not in reads:
        raise UsageError(f"the program reads no variable {variable!r}; it reads {', '.join(reads)}")
    return variable
