"""Tables of `sierra.toml` about models: predictions that are drawn with the data and compared with it."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, model_validator

from sierra.config.field_types import OF_WALL, Argv, Label, ListOfWords, OfStatement, Positive, Reduced

SOURCES = ("expression", "sql", "file", "command")


class Model(Reduced):
    """One model: a prediction of one column, by exactly one of `expression`, `sql`, `file` and `command`."""

    expression: str = Field(
        "",
        description="arithmetic over the variables of the query, as in the values of changes; with `t`, the time, it predicts "
        "values over time",
    )
    sql: str = Field(
        "", description="one SELECT statement whose columns are variables, perhaps the time, and the predicted `column`"
    )
    file: OfStatement = None
    command: Argv = Field(
        (),
        description="program that prints such a table as CSV; `{experiments}` is a CSV file with a row for each experiment, "
        "`{project}` the project's folder, `{python}` the Python that runs SIERRA",
    )
    wall: Annotated[Positive, OF_WALL] = 60.0
    column: Annotated[str, Field(min_length=1)] = Field(description="the predicted column")
    label: Label = ""
    figures: ListOfWords = Field(
        (), description="names of the figures that it is drawn in; default: all figures of the column that fit"
    )

    @model_validator(mode="after")
    def _fitting(self) -> Model:
        given = [name for name in SOURCES if (value := getattr(self, name)) and (not isinstance(value, str) or value.strip())]
        if len(given) != 1:
            raise ValueError(f"give exactly one of {', '.join(SOURCES)}{'; not ' + ' and '.join(given) if given else ''}")
        return self
