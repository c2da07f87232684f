"""The user's own defaults for all projects. They affect how SIERRA works here, but not the results.

The file is `$XDG_CONFIG_HOME/sierra/config.toml` (`~/.config/sierra/config.toml` if that variable is not set). A variable such
as `SIERRA_JOBS` overrides the file, and a command's option overrides both.
"""

from __future__ import annotations

import os
from collections.abc import Mapping

from pydantic import Field, PositiveInt, ValidationError

from sierra.config.field_types import RawTable, Table
from sierra.config.find_project import read_toml
from sierra.config.validate import options
from sierra.errors import ConfigError
from sierra.store.layout import user_settings


class Settings(Table):
    """The user's file `config.toml`."""

    jobs: PositiveInt | None = Field(
        None, description="runs at a time; default: the number of usable cores, within a job of SLURM or PBS those of the job"
    )
    figures: bool = Field(True, description="whether `sierra run` draws figures")
    runners: Mapping[str, RawTable] = Field(
        default_factory=dict, description="clusters for `sierra reproduce --on`, by name, as in `sierra.toml`"
    )


VARIABLES = ("jobs", "figures")
"""The settings that variables override."""


def load() -> Settings:
    """Return the settings of the user's file and variables. Raises ConfigError if they are invalid."""
    file = user_settings()
    settings = options(Settings, read_toml(file), str(file)) if file.is_file() else Settings()
    for name in VARIABLES:
        variable = f"SIERRA_{name.upper()}"
        if text := os.environ.get(variable):
            settings = _with(settings, name, text, variable)
    return settings


def _with(settings: Settings, name: str, text: str, variable: str) -> Settings:
    try:
        return Settings.model_validate({**settings.model_dump(), name: text})
    except ValidationError as error:
        reason = error.errors()[0]["msg"].replace("Input should", "should").split(",")[0]
        raise ConfigError(f"{variable}={text!r}: {reason}") from error
