"""The steps of `sierra init`: copying an example, or writing a first `sierra.toml` from the content of a folder.

`find_out` makes a `Guess` from options, the folder and answers; `write` writes it.
"""

from __future__ import annotations

from pathlib import Path

from sierra.model import Set
from sierra.setup.init import command, folder, source, variable_names, variables
from sierra.setup.init.answers import Ask, Options, Question
from sierra.setup.init.example import copy_example
from sierra.setup.init.first_query import first_query
from sierra.setup.init.write import Guess, write

__all__ = ["Ask", "Guess", "Options", "Question", "copy_example", "find_out", "write"]


def find_out(root: Path, said: Options, ask: Ask | None = None) -> Guess:
    """Return a guess from the options, and for the rest from the folder. If `ask` is given, it asks about uncertain values.

    Raises UsageError for a wrong option, or if there is a `sierra.toml` already; Missing if the folder does not show a value
    and nobody can be asked.
    """
    folder.check(root)
    template, content = folder.template(root, said.template, ask)
    started = command.choose(root, template, said.command, ask)
    platform_name, platform = command.platform(template, started)
    numbers = variable_names.numbers(content)
    seeds = variable_names.seeds(numbers)
    by_platform = platform.seed_changes()
    seed = None if by_platform and said.seed is None else variables.choose_seed(content, seeds, said.seed, ask)
    named = variable_names.named(
        {path: value for path, value in numbers.items() if path not in (seed, *seeds)}, platform.criteria()
    )
    per_run = (*by_platform, *([Set(seed, "{seed}")] if seed else []))
    likely = {} if platform.criteria() else dict(list(named.items())[:1])
    chosen = variables.choose(content, per_run, named, likely, said.variables, ask)
    return Guess(
        template=template,
        platform=platform_name,
        command=started,
        module_path=command.module_path(started, root),
        seed=seed,
        variables=chosen,
        other_variables={name: path for name, path in named.items() if path not in chosen.values()},
        source=source.choose(root, template, said.source, ask),
        next=first_query(platform, content, chosen),
        notes=(
            *command.doubts(platform, root),
            *variables.doubts(seed, seeds, elsewhere=bool(by_platform) or "{seed}" in (started or "")),
            *folder.doubts(root),
        ),
    )
