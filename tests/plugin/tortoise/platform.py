"""The platform `tortoise`: a simulator whose configuration has the names `steps`, `seed` and `tortoises`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

from pydantic import Field, PositiveInt

from sierra.plugin import Axis, Change, Criterion, Point, Project, Set, Table, TemplateError, TemplateView, values

WHY = "platform tortoise"


class TortoiseOptions(Table):
    """The options of the simulator."""

    steps: PositiveInt = Field(10, description="steps of each tortoise")


class Tortoise:
    """The platform `tortoise`."""

    contract = 1
    Options: ClassVar[type[Table]] = TortoiseOptions

    def __init__(self, project: Project, options: TortoiseOptions) -> None:
        self._command = project.command or ("python3", "tortoise.py", "{input}")
        self._options = options

    def changes(self, template: TemplateView) -> tuple[Change, ...]:
        return (Set("steps", str(self._options.steps), why=f"{WHY}: steps"),)

    def seed_changes(self) -> tuple[Change, ...]:
        return (Set("seed", "{seed}", why=f"{WHY}: the seed"),)

    def criterion(self, criterion: Criterion, template: TemplateView) -> tuple[Axis, tuple[Point, ...]] | None:
        if criterion.name != "herd":
            return None
        axis = Axis("herd", values(criterion.scale), "Herd", "tortoises")
        return axis, tuple(Point(count, (Set("tortoises", str(count), why=f"{WHY}: herd"),)) for count in axis.values)

    def criteria(self) -> Mapping[str, str]:
        return {"herd": "how many tortoises walk"}

    def check(self, document: TemplateView, template: TemplateView) -> None:
        for count in document.find("tortoises"):
            if not count.isdigit() or int(count) == 0:
                raise TemplateError(f"tortoises is {count!r}; there must be one or more")

    def command(self) -> tuple[str, ...]:
        return self._command

    def files(self, document: bytes) -> tuple[tuple[str, bytes], ...]:
        return (("herd.conf", document),)

    def environment(self) -> Mapping[str, str]:
        return {}
