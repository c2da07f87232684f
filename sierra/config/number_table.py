"""The tables `[numbers.NAME]` and `[paper]` of `sierra.toml`: numbers in the text of a paper, and its folder."""

from __future__ import annotations

from pathlib import PurePosixPath
from typing import Annotated, Literal

from pydantic import AfterValidator, Field, StringConstraints, model_validator

from sierra.config.deliverable_tables import Bound
from sierra.config.field_types import Experiments, InProject, ListOfWords, Reduced, Table
from sierra.store.layout import PAPER

SOURCES = ("claim", "comparison", "statistic", "sql")
Letters = Annotated[str, StringConstraints(pattern=r"^[A-Za-z]+$")]
"""A name that TeX takes for a macro."""


def _format(text: str) -> str:
    try:
        format(1.5, text)
    except ValueError as error:
        raise ValueError(f"{text!r} is not a format of numbers, such as .2f, .3g or .1%") from error
    return text


def _folder(path: str) -> str:
    if not PurePosixPath(path).parts:
        raise ValueError("the folder of a paper is one within the project, such as paper/sierra")
    return str(PurePosixPath(path))


class Paper(Table):
    """The folder of a paper, for `sierra paper`."""

    folder: Annotated[InProject, AfterValidator(_folder)] = Field(
        PAPER, description="folder for the files of `sierra paper` alone; it is not part of the source of runs"
    )
    prefix: Letters = Field("sierra", description="beginning of the names of macros: `[numbers.best]` is \\sierrabest")
    siunitx: bool = Field(False, description="write numbers by \\num and \\qty of the LaTeX package siunitx")
    package: str = Field(
        "", description="reproduction package of the paper, a zip or its extracted folder: \\sierrapackage is its id"
    )


class NumberInText(Reduced):
    """One number in the text of a paper, from exactly one of `claim`, `comparison`, `statistic` and `sql`.

    `table`, `column`, `measure`, `threshold` and `experiments` say where a `statistic` comes from.
    """

    query: Bound = ()
    claim: str = Field("", description="name of a claim in `claims`")
    comparison: str = Field("", description="name of a comparison in `comparisons` that is bound to queries")
    groups: ListOfWords = Field((), description="with `comparison`: the two groups; the difference is second minus first")
    statistic: str = Field("", description="statistic over the runs of one experiment, as in `sierra stats --statistic`")
    experiments: Experiments = ""
    sql: str = Field("", description="a SELECT statement with one row and one column; each table has a column `batch`")
    value: Literal["estimate", "interval", "p", "verdict", "registered"] = Field(
        "estimate",
        description="part that is printed: the number, its 95 % interval, the p value, the verdict of a claim, or `registered` "
        "for the word planned or exploratory",
    )
    format: Annotated[str, AfterValidator(_format)] = Field(
        "", description="format as in Python: `.2f`, `.3g`, `.1%`; default: as many digits as the interval allows"
    )
    unit: str = Field("", description="unit after the number, for LaTeX; with `siunitx`, one of its units")

    @model_validator(mode="after")
    def _fitting(self) -> NumberInText:
        given = [name for name in SOURCES if getattr(self, name)]
        if len(given) != 1:
            raise ValueError(f"give exactly one of {', '.join(SOURCES)}{'; not ' + ' and '.join(given) if given else ''}")
        [source] = given
        own = source in ("claim", "comparison")
        if own and self.query:
            raise ValueError(f'the {source} has its own query; leave out "query"')
        if not own and len(self.query) != 1 and (source == "statistic" or not self.query):
            raise ValueError(f'"{source}" needs one "query"')
        if self.value in ("verdict", "registered") and source != "claim":
            raise ValueError(f'value = "{self.value}" needs a "claim"')
        if self.value == "p" and not own:
            raise ValueError('value = "p" needs a "claim" or a "comparison"')
        if self.groups and (source != "comparison" or len(self.groups) != 2):
            raise ValueError('"groups" are the two groups of a "comparison"')
        if source != "statistic" and (wrong := [name for name in OF_STATISTIC if name in self.model_fields_set]):
            raise ValueError(f'"{wrong[0]}" needs "statistic"')
        return self


OF_STATISTIC = ("table", "column", "measure", "threshold", "experiments")
"""The keys that belong to `statistic`."""
