"""Tables of `sierra.toml` about models: predictions that are drawn with the data and compared with it."""

from __future__ import annotations

from typing import Annotated

from pydantic import BeforeValidator, Field, model_validator

from sierra.config.field_types import OF_RUN, Argv, Finite, InProject, Positive, Table, Words
from sierra.model import Measure

SOURCES = ("expression", "sql", "file", "command")


class Model(Table):
    """One model: a prediction of one column, by exactly one of `expression`, `sql`, `file` and `command`."""

    expression: str = Field(
        "",
        description="arithmetic over the variables of the query, as in the values of changes; with `t`, the time, it predicts "
        "values over time",
    )
    sql: str = Field(
        "", description="one SELECT statement whose columns are variables, perhaps the time, and the predicted `column`"
    )
    file: InProject | None = Field(None, description="file of the project that contains the statement")
    command: Argv = Field(
        (),
        description="program that prints such a table as CSV; `{experiments}` is a CSV file with a row for each experiment, "
        "`{project}` the project's folder, `{python}` the Python that runs SIERRA",
    )
    wall: Positive = Field(60.0, description="time limit of the command, in seconds")
    column: Annotated[str, Field(min_length=1)] = Field(description="the predicted column")
    table: str = Field("", description="name of its output or derived table; may be omitted if only one has the column")
    measure: Measure | None = Field(
        None,
        description=f"the predicted number of a run, if it is not predicted over time: {OF_RUN}; default: `final`, or `mean` "
        "in a table of events",
    )
    threshold: Finite | None = Field(
        None, description="for `time_to`: the value that must be reached or exceeded, in the column's unit"
    )
    label: str = Field("", description="name in figures; default: the model's name with blanks for underscores")
    figures: Annotated[
        tuple[str, ...], BeforeValidator(lambda v: (v,) if isinstance(v, str) else v, json_schema_input_type=Words)
    ] = Field((), description="names of the figures that it is drawn in; default: all figures of the column that fit")

    @model_validator(mode="after")
    def _fitting(self) -> Model:
        given = [name for name in SOURCES if (value := getattr(self, name)) and (not isinstance(value, str) or value.strip())]
        if len(given) != 1:
            raise ValueError(f"give exactly one of {', '.join(SOURCES)}{'; not ' + ' and '.join(given) if given else ''}")
        if (self.measure == "time_to") != (self.threshold is not None):
            raise ValueError('measure "time_to" and "threshold" must be used together')
        return self
