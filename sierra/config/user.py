"""A user's own defaults, for all projects: how SIERRA works here, never what a result depends on.

They stand in `$XDG_CONFIG_HOME/sierra/config.toml` (`~/.config/sierra/config.toml` where that is not set). A variable such
as `SIERRA_JOBS` goes before the file, and a command's option before both.
"""

from __future__ import annotations

import os

from pydantic import Field, PositiveInt, ValidationError

from sierra.config import project_file
from sierra.config.project_file import Table
from sierra.errors import ConfigError
from sierra.store.layout import user_settings


class Settings(Table):
    """The file `config.toml` of a user."""

    jobs: PositiveInt | None = Field(None, description="runs at a time; as many as there are usable cores where absent")
    figures: bool = Field(True, description="whether `sierra run` draws figures")


def load() -> Settings:
    """What the user's file and variables say. Raises ConfigError for what is wrong there."""
    file = user_settings()
    settings = project_file.options(Settings, project_file.read_toml(file), str(file)) if file.is_file() else Settings()
    for name in Settings.model_fields:
        variable = f"SIERRA_{name.upper()}"
        if text := os.environ.get(variable):
            settings = _with(settings, name, text, variable)
    return settings


def _with(settings: Settings, name: str, text: str, variable: str) -> Settings:
    try:
        return Settings.model_validate({**settings.model_dump(), name: text})
    except ValidationError as error:
        told = error.errors()[0]["msg"].replace("Input should", "should").split(",")[0]
        raise ConfigError(f"{variable}={text!r}: {told}") from error
