"""The first import of matplotlib, which neither an environment variable nor a file of somebody else's can make fail.

Jupyter sets `MPLBACKEND` to a module that only its kernel has, and matplotlib refuses to be imported with such a value. A
`matplotlibrc` that `MATPLOTLIBRC` or the user's configuration names may have an error, and without a home that can be written
matplotlib reports its temporary folder. So matplotlib is loaded with the settings that it brings along. The user's settings,
as far as they are valid, apply afterwards to what a program draws with matplotlib itself; SIERRA's figures have their own.
"""

from __future__ import annotations

import contextlib
import importlib
import os
import warnings
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

from sierra.errors import ConfigError
from sierra.util.first_import import Load, load_with

NAME = "matplotlib"
BACKEND, FILE = "MPLBACKEND", "MATPLOTLIBRC"
FONTS = ("FONTCONFIG_FILE", "FONTCONFIG_PATH")
"""Settings of fontconfig, which matplotlib asks for fonts. It reports on standard error that such a file does not exist."""
OWN_FILE = "mpl-data/matplotlibrc"
"""The file with matplotlib's own settings, in its folder."""


def prepare() -> None:
    """Have the first import of matplotlib by this process done in this way."""
    load_with(NAME, _load)


def _load(module: ModuleType, load: Load) -> None:
    lost = [name for name in FONTS if name in os.environ and not Path(os.environ[name]).exists()]
    with _quiet(), variables({BACKEND: None, FILE: str(Path(module.__path__[0], OWN_FILE)), **dict.fromkeys(lost)}):
        try:
            load(module)
        except (ValueError, OSError) as error:
            if not (file := Path("matplotlibrc")).exists():
                raise
            raise ConfigError(f"{file.absolute()}: matplotlib cannot read this file: {error}; rename it") from error
        importlib.import_module(f"{NAME}.font_manager")  # finds the folder for its cache
    with _quiet():
        _apply_settings(module)


def _apply_settings(module: ModuleType) -> None:
    """Apply the settings of the user, as far as they are valid."""
    with contextlib.suppress(Exception):
        if Path(file := module.matplotlib_fname()) != Path(module.__path__[0], OWN_FILE):
            module.rc_file(file)
    with contextlib.suppress(Exception):
        if backend := os.environ.get(BACKEND):
            module.rcParams["backend"] = backend


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Report no warning of matplotlib; it uses both ways to report one."""
    import logging

    logger = logging.getLogger(NAME)
    before = logger.level
    logger.setLevel(logging.CRITICAL)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logger.setLevel(before)


@contextlib.contextmanager
def variables(values: dict[str, str | None]) -> Iterator[None]:
    """Set variables of the environment, or remove those that are None."""
    before = {name: os.environ.get(name) for name in values}
    _set(values)
    try:
        yield
    finally:
        _set(before)


def _set(values: dict[str, str | None]) -> None:
    for name, value in values.items():
        os.environ.pop(name, None)
        if value is not None:
            os.environ[name] = value
