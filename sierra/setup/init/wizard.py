"""The steps of `sierra init`: copying an example, or writing a first `sierra.toml` from the content of a folder.

`find_out` makes a `Guess` from options, the folder and answers; `write` writes it.
"""

from __future__ import annotations

import shutil
from importlib import resources
from pathlib import Path

from sierra.errors import UsageError
from sierra.model import Set
from sierra.setup.init import command, folder, source, variables
from sierra.setup.init.answers import Ask, Options, Question
from sierra.setup.init.write import Guess, write

__all__ = ["Ask", "Guess", "Options", "Question", "copy_example", "find_out", "write"]


def find_out(root: Path, options: Options, ask: Ask | None = None) -> Guess:
    """Return a guess from the options, and for the rest from the folder. If `ask` is given, it asks about uncertain values.

    Raises UsageError for a wrong option, or if there is a `sierra.toml` already; Missing if the folder does not show a value
    and nobody can be asked.
    """
    folder.check(root)
    template, content = folder.template(root, options.template, ask)
    started = command.choose(root, template, options.command, ask)
    platform_name, platform = command.platform(template, started)
    numbers = variables.numbers(content)
    seeds = variables.seeds(numbers)
    by_platform = platform.seed_changes()
    seed = None if by_platform and options.seed is None else variables.choose_seed(content, seeds, options.seed, ask)
    named = variables.named({path: value for path, value in numbers.items() if path not in (seed, *seeds)}, platform.criteria())
    per_run = (*by_platform, *([Set(seed, "{seed}")] if seed else []))
    likely = {} if platform.criteria() else dict(list(named.items())[:1])
    chosen = variables.choose(content, per_run, named, likely, options.variables, ask)
    return Guess(
        template=template,
        platform=platform_name,
        command=started,
        module_path=command.module_path(started, root),
        seed=seed,
        variables=chosen,
        other_variables={name: path for name, path in named.items() if path not in chosen.values()},
        source=source.choose(root, template, options.source, ask),
        next=variables.first_query(platform, content, chosen),
        notes=(
            *command.doubts(platform, root),
            *variables.doubts(seed, seeds, elsewhere=bool(by_platform) or "{seed}" in (started or "")),
            *folder.doubts(root),
        ),
    )


def copy_example(name: str, target: Path) -> list[str]:
    """Copy a bundled example; return the files' names. Raises UsageError for an unknown name or a folder that is not empty."""
    examples = resources.files("sierra.setup") / "examples"
    known = sorted(entry.name for entry in examples.iterdir() if entry.is_dir() and not entry.name.startswith("_"))
    if name not in known:
        raise UsageError(f"no example {name!r}; known are {', '.join(known)}")
    if target.exists() and any(target.iterdir()):
        raise UsageError(f"{target} is not empty; use a new folder")
    target.mkdir(parents=True, exist_ok=True)
    with resources.as_file(examples / name) as example:
        files = sorted(file for file in example.iterdir() if file.is_file())
        for file in files:
            shutil.copyfile(file, target / file.name)
    return [file.name for file in files]
