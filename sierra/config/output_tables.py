"""Tables of `sierra.toml` about what runs write: outputs, success, tolerances, equivalence."""

from __future__ import annotations

import contextlib
import fnmatch
import re
import signal
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from pydantic import (
    AfterValidator,
    ConfigDict,
    Field,
    ModelWrapValidatorHandler,
    PositiveInt,
    Strict,
    StrictInt,
    StrictStr,
    StringConstraints,
    ValidationInfo,
    WithJsonSchema,
    model_validator,
)

from sierra.config import extensions
from sierra.config.field_types import (
    Alpha,
    Finite,
    Inside,
    Name,
    NotNegative,
    Positive,
    Reduced,
    Table,
    regular_expression,
)
from sierra.model import Measure
from sierra.store.layout import RUN_STDOUT
from sierra.util.lazy_definitions import dataclass, regex

SAME_FORMAT = {"tsv": "csv", "ndjson": "jsonl"}
"""Endings of output files with the format that another ending is named after."""
AUTOMATIC = ("csv", "parquet", "jsonl")
"""The formats that need not be named."""
FILE_FORMAT = "file"
"""The format of outputs that are kept as files and become no table."""
NAMED_FORMATS = ("json", "xml", *extensions.every("outputs"))
"""Formats that are only read if they are named, because such files were kept as files before there was a reader."""
PLACEHOLDER = regex(r"\{([A-Za-z_][A-Za-z0-9_]*)\}")
"""A name in braces that stands for a number in the name of an output file."""
ROTATION = "{rotation}"
"""The end of a name that stands for the parts of a rotated file."""
PART = regex(r"(?:[.]([0-9]{1,6})|[-._]([0-9]{4}-?[0-9]{2}-?[0-9]{2}(?:[-_T]?[0-9]{2}){0,3}))?(?:[.](?:gz|zst))?")
"""The ends of the names of the older parts of a file: `.1`, `.2.gz`, `-20240501.gz`, `.2024-05-01_13`."""
_OLDER = regex(f"(.+?){PART.pattern}")
_IN_ARCHIVE = regex(r"(?:\./)?(.*?\.(?:tar(?:\.(?:gz|xz|bz2|zst))?|tgz|txz|zip))/.+", re.IGNORECASE)
ELEMENTS = regex(r"(//?(\*|[^\W\d][\w.:-]*))+")
"""A path of elements in XML."""
CSV_KEYS = ("skip", "comment", "header_lines", "units_row", "decimal", "widths")
KEYS_OF_FORMATS: Mapping[str, tuple[str, ...]] = {
    **dict.fromkeys(CSV_KEYS, ("csv",)),
    "rows": ("json", "xml"),
    **dict.fromkeys(("flatten", "unnest"), ("json", "jsonl")),
}
"""Keys of `[outputs.NAME]` that are only for certain formats, besides those of extensions that have them in `Output.takes`."""
ROTATED_FORMATS = ("csv", "jsonl")
NOT_WITH_LINES = ("format", "delimiter", "header", "columns", "skip", "comment", "header_lines", "units_row", "widths")
"""Keys of `[outputs.NAME]` that contradict `lines`, whose groups are the columns."""
LATER_KEYS = (*KEYS_OF_FORMATS, "na", "time_order", "lines")
"""Keys of `[outputs.NAME]` that were added after rules had been recorded."""
Comment = str | Annotated[tuple[Annotated[str, Field(min_length=1)], ...], Field(min_length=1)]
Delimiter = Annotated[str, StringConstraints(pattern=r"^(.|blanks)?$|^[\t\n]$")]


def _once(names: tuple[str, ...]) -> tuple[str, ...]:
    if len({name.lower() for name in names}) < len(names):
        raise ValueError("column names should be unique; SQL ignores upper and lower case")
    return names


class Tolerance(Table):
    """The largest difference of a replayed number from the recorded one; one of these limits must be met."""

    abs: NotNegative = Field(0.0, description="maximum absolute difference, in the column's unit")
    rel: NotNegative = Field(0.0, description="maximum difference divided by the absolute value of the recorded number")
    ulp: NotNegative = Field(0.0, description="maximum difference in units in the last place of a double")


@cache
def _numbered(file: str) -> re.Pattern[str]:
    """Return the regular expression for the names of files in which names in braces stand for whole numbers."""
    literals = PLACEHOLDER.split(file)[::2]
    return re.compile("([0-9]{1,18})".join(map(re.escape, literals)))


Key = str | bool | int | Sequence[str] | Mapping[str, str]
Keys = Mapping[str, Key]
"""Keys of `[outputs.NAME]`."""


@cache
def archive_of(file: str) -> str:
    """Return the part of a path that names an archive, such as `out.zip` of `out.zip/data.csv`; "" if there is none."""
    found = _IN_ARCHIVE.fullmatch(file)
    return found[1] if found else ""


@dataclass(frozen=True, slots=True)
class Proposal:
    """A table that a file can make, or the reason why it makes none."""

    what: str
    """The part of the file, in words."""
    name: str
    keys: Keys
    """The keys that make the table, without `file`."""
    usual: Keys
    """More keys that suit such a table."""
    lacking: str = ""
    """The reason why this part makes no table; empty if it does."""


class Output(Table):
    """One kind of file that runs write, and the table that it becomes."""

    file: Inside = Field(
        min_length=1,
        description="path or glob, from the run's output folder; `{tick}` in `floor-{tick}.csv` is a number and a column; "
        "`data.csv{rotation}` is a file with its older parts, such as `data.csv.1` and `data.csv.2.gz`, as one table; "
        "`out.zip/data.csv` is a file in an archive (`.zip`, `.tar`, `.tar.gz`, `.tgz`, `.tar.xz`, `.txz`, `.tar.bz2`, "
        "`.tar.zst`); `stdout` is the standard output of the run",
    )
    format: (
        Annotated[
            str,
            WithJsonSchema(
                {
                    "type": "string",
                    "enum": ["csv", "parquet", "jsonl", "json", "xml", *extensions.added("outputs"), FILE_FORMAT],
                }
            ),
        ]
        | None
    ) = Field(
        None,
        description="format; `file` is stored but does not become a table; default: by the file's extension, "
        "if it is csv, parquet or jsonl",
    )
    delimiter: Delimiter = Field(
        "",
        description="separator between the columns of a CSV file; `blanks`: one or more blanks or tabs; cells between `|` lose "
        "the blanks around them; default: detected",
    )
    header: bool = Field(True, description="whether the first line of a CSV file contains the column names")
    columns: Annotated[tuple[Name, ...], AfterValidator(_once)] = Field(
        (), description="column names of a CSV file without a header"
    )
    skip: int = Field(0, ge=0, description="number of lines at the beginning of a CSV file that are not read")
    comment: Comment = Field(
        "", description="beginning of lines of a CSV file that are not read, such as `#`, or a list of several"
    )
    header_lines: int = Field(
        1, ge=1, description="number of lines of a CSV file that make up the column names; their texts are joined by a dot"
    )
    units_row: bool = Field(False, description="whether a line with units follows the column names of a CSV file")
    decimal: Literal[".", ","] = Field(".", description="decimal separator of a CSV file")
    na: tuple[StrictStr | StrictInt | Annotated[Finite, Strict()], ...] = Field(
        (),
        description="what stands for a missing value: texts such as `NA`, and numbers such as `-1`, however they are written; "
        "in a CSV file, a text that is a number matches only cells that are written in the same way; values within lists stay, "
        "and so do indices, dimensions, topics and times of receipt",
    )
    widths: tuple[PositiveInt, ...] = Field(
        (), description="number of characters of each column of a text file without separators (fixed width)"
    )
    rows: str = Field(
        "",
        description="part of a file that has the rows: in JSON, keys such as `results.steps`; in XML, `//NAME` or `/A/B`; "
        "in GraphML, `nodes`, `edges`, or `graph` for both; in SQLite, a table or a SELECT statement; "
        "in HDF5, the path of a dataset or group; in NetCDF, variables separated by commas",
    )
    lines: str = Field(
        "",
        description="regular expression for lines of a text file, such as `step=(?P<step>\\d+) score=(?P<score>\\S+)`: each "
        "line in which it matches is a row, and its named groups are the columns; without look-around and back-references; "
        "several outputs may have different `lines` of the same file",
    )
    flatten: bool | None = Field(
        None, description="whether objects in JSON become columns such as `pose.x`; default: yes in `json`, no in `jsonl`"
    )
    unnest: str = Field("", description="list in each JSON object whose items become rows, such as `robots`")
    time: str = Field("", description="column that is the time axis; default: the row number")
    time_order: Literal["ascending", "any"] = Field(
        "ascending",
        description="if the time goes back within the rows of one file and robot: `ascending` fails the run, `any` takes the "
        "rows in the order of their times",
    )
    ticks_per_second: Positive | Annotated[str, Field(min_length=1)] | None = Field(
        None,
        description="ticks per second, if the time column counts ticks: a number, or the XPath of one in the runs' inputs; "
        "figures over time then show seconds; needs `time`",
    )
    required: bool = Field(True, description="whether a run fails without this output")
    min_rows: int = Field(0, ge=0, description="minimum number of rows; a run with fewer rows fails")
    mismatch: Literal["strict", "ragged"] = Field(
        "strict",
        description="if row count or columns differ from those of sibling runs: `strict` fails the run, `ragged` keeps it "
        "and reports n",
    )
    units: Mapping[str, str] = Field(default_factory=dict, description="unit of each column in figures")
    rates: Annotated[tuple[str, ...], AfterValidator(_once)] = Field(
        (),
        description="columns of 0 and 1 whose mean is a rate, so that its interval is Wilson's; columns of false and true need "
        "not be named",
    )
    tolerance: Mapping[str, Tolerance] = Field(
        default_factory=dict,
        description="maximum difference between replay and record, by column (`*`: all other columns): abs, rel or ulp",
    )
    ordered: bool = Field(True, description="whether a replay compares the order of rows")
    volatile: tuple[str, ...] = Field(
        (), description="not compared by a replay: columns of a table; for other files, regular expressions that match lines"
    )

    takes: ClassVar[tuple[str, ...]] = ()
    """Keys of `KEYS_OF_FORMATS` that this format has too."""
    endings: ClassVar[Mapping[str, str]] = {}
    """The endings of files of this format, each with the keys that make a table of such a file, for messages."""
    most_searched: ClassVar[int] = 1 << 24
    """The largest number of bytes of a file that is searched for its tables."""
    needs: ClassVar[tuple[str, str, str] | None] = None
    """The package that reading needs: the format in words, the package, and the extra that installs it."""

    @model_validator(mode="wrap")
    @classmethod
    def _of_format(cls, data: object, handler: ModelWrapValidatorHandler[Output], info: ValidationInfo) -> Output:
        """Validate the keys of a format of an extension by its own class, as strictly as the others."""
        if cls is not Output or not isinstance(data, Mapping):
            return handler(data)
        name, strict = str(data.get("format")), bool(info.context)
        if extensions.absent("outputs", name):
            return AbsentOutput.model_validate(data, strict=strict, context=info.context)
        own: type[Output] = extensions.load("outputs", name) if name in extensions.added("outputs") else cls
        data = {key: value for key, value in data.items() if key in own.model_fields or not _is_default_of_others(key, value)}
        for key in [key for key in data if key not in own.model_fields]:
            if formats := _having(key):
                known = handler({key: value for key, value in data.items() if key in cls.model_fields})
                raise ValueError(f"{key} needs {_formats(formats)}, but the format is {known.kind!r}")
        return handler(data) if own is cls else own.model_validate(data, strict=strict, context=info.context)

    @model_validator(mode="after")
    def _fitting(self) -> Output:
        for key, known in KEYS_OF_FORMATS.items():
            if getattr(self, key) and key not in (*self.unused_later_keys, *self.takes) and self.kind not in known:
                formats = _formats((*known, *(name for name, own in of_extensions().items() if key in own.takes)))
                raise ValueError(f"{key} needs {formats}, but the format is {self.kind!r}")
        if self.na and self.kind == FILE_FORMAT:
            raise ValueError(f'na needs a format that makes a table, but the format is "{FILE_FORMAT}"')
        if not self.header and (self.units_row or self.header_lines > 1):
            raise ValueError(f"{'units_row' if self.units_row else 'header_lines'} needs header = true")
        if self.kind == "xml" and not ELEMENTS.fullmatch(self.rows):
            raise ValueError(f'format = "xml" needs rows, a path of element names such as "//tripinfo", not {self.rows!r}')
        self.check_own_keys()
        if self.archive:
            if self.rotated:
                raise ValueError(f"file: {ROTATION} is not supported in an archive: {self.file!r}")
            if self.kind == FILE_FORMAT or (self.format is None and not self.lines and self.kind not in AUTOMATIC):
                raise ValueError(
                    f'file: {self.file!r} in an archive needs the format of a table, such as format = "csv"; '
                    f'to keep a file as it is, declare its archive: file = "{self.archive}"'
                )
        if self.rotated:
            if self.kind not in ROTATED_FORMATS:
                raise ValueError(f"file: {ROTATION} needs one of the formats {', '.join(ROTATED_FORMATS)}, not {self.kind!r}")
            if any(character in self.base for character in "*?[") or PLACEHOLDER.search(self.base):
                raise ValueError(f"file: {ROTATION} excludes other names in braces and * ? [: {self.file!r}")
        elif ROTATION in self.file:
            raise ValueError(f"file: {ROTATION} must be the end, as in data.csv{ROTATION}: {self.file!r}")
        if self.ticks and any(character in self.file for character in "*?["):
            raise ValueError(f"file: {{{self.ticks[0]}}} and the characters * ? [ exclude each other: {self.file!r}")
        if len(set(map(str.lower, self.ticks))) < len(self.ticks):
            raise ValueError(f"file: a name in braces occurs twice: {self.file!r}")
        if self.ticks_per_second is not None and not self.time:
            raise ValueError('ticks_per_second needs time = "COLUMN"')
        if self.lines:
            if given := [key for key in NOT_WITH_LINES if key not in _unused(self, NOT_WITH_LINES)]:
                raise ValueError(f"lines and {given[0]} exclude each other: lines makes the columns; remove {given[0]}")
            from sierra.config import line_patterns

            line_patterns.check(self.lines)
        elif self.is_stdout and self.format is None:
            raise ValueError(
                'file = "stdout" needs format, such as "csv", or lines, a regular expression for lines that are rows'
            )
        if self.widths and self.delimiter:
            raise ValueError("widths and delimiter exclude each other")
        if self.decimal == "," == self.delimiter:
            raise ValueError('decimal = "," needs another delimiter')
        return self

    @property
    def unused_later_keys(self) -> frozenset[str]:
        """Return the keys of `LATER_KEYS` that have their default; hashes of rules do not contain them, and stay the same."""
        return _unused(self, (*LATER_KEYS, *self.own_keys))

    @property
    def own_keys(self) -> Mapping[str, Any]:
        """Return the keys that only outputs of this format have, with their values."""
        return {key: getattr(self, key) for key in type(self).model_fields if key not in Output.model_fields}

    @property
    def series(self) -> str:
        """Return the column that tells series of rows apart that have times of their own, as topics of a bag have; or "".

        A file of such a format may belong to several outputs, each of which makes a table of another part.
        """
        return extensions.every("series").get(self.kind, "")

    @property
    def shares_file(self) -> bool:
        """Return True if several such outputs may read parts of the same file."""
        return bool(self.series or self.lines or self.kind == "xml")

    @property
    def is_stdout(self) -> bool:
        """Return True if the file is the standard output of the run."""
        return self.file.removeprefix("./") == RUN_STDOUT

    @property
    def own_columns(self) -> tuple[str, ...]:
        """Return the names of columns that keys of this format declare."""
        return ()

    def check_own_keys(self) -> None:
        """Check what this format needs. Raises ValueError."""

    def with_files(self, root: Path) -> Output:
        """Return the output with the content of those files of the project that its keys name. Raises ValueError."""
        del root
        return self

    @classmethod
    def proposals(cls, content: Callable[[], bytes | None], name: str) -> Sequence[Proposal]:
        """Return the tables that a file can make; none if it cannot be read. `content` reads it, or returns None."""
        return ()

    def doubt(self) -> str:
        """Return a warning about runs on robots, whose outputs are read only when the robots have moved; "" for none."""
        return "robots have no common standard output; let each robot write a file" if self.is_stdout else ""

    @property
    def rotated(self) -> bool:
        """Return True if the table is made of a file and its older parts."""
        return self.file.endswith(ROTATION)

    @property
    def base(self) -> str:
        """Return the name of its file; of a rotated file, that of the newest part."""
        return self.file.removeprefix("./").removesuffix(ROTATION)

    @property
    def ticks(self) -> tuple[str, ...]:
        """Return the names of the numbers in the names of its files, such as `tick` in `floor-{tick}.csv`."""
        return tuple(PLACEHOLDER.findall(self.file.removesuffix(ROTATION)))

    @property
    def numbered(self) -> re.Pattern[str]:
        """The regular expression for the paths of its files, in which names in braces stand for whole numbers."""
        return re.compile(re.escape(self.base) + PART.pattern) if self.rotated else _numbered(self.base)

    def ticks_of(self, path: str) -> tuple[int, ...] | None:
        """Return the numbers in the name of a file; None if the file does not belong to this output."""
        found = self.numbered.fullmatch(path) or (_numbered(self.archive).fullmatch(path) if self.archive else None)
        return None if found is None else () if self.rotated else tuple(map(int, found.groups()))

    def matches(self, path: str) -> bool:
        """Return True if a file of the output folder belongs to this output, by its name or as a glob; `*` matches slashes.

        An archive belongs to the outputs of the files in it.
        """
        return self.opens(path) or self.names(path)

    def names(self, path: str) -> bool:
        """Return True if the whole pattern fits a path, in an archive or not."""
        if self.ticks or self.rotated:
            return self.numbered.fullmatch(path) is not None
        file = self.file.removeprefix("./")
        return path == file or fnmatch.fnmatchcase(path, file)

    @property
    def archive(self) -> str:
        """Return the part of `file` that names an archive, such as `out.zip` of `out.zip/data.csv`; "" if there is none."""
        return archive_of(self.file)

    def opens(self, path: str) -> bool:
        """Return True if a file is an archive in which files of this output may be."""
        archive = self.archive
        return bool(archive) and bool(fnmatch.fnmatchcase(path, archive) or _numbered(archive).fullmatch(path))

    @property
    def kind(self) -> str:
        """Return the name of its format: as declared, or from the ending of the file. There may be no reader of that name.

        Lines that are rows are written as a CSV before they are read.
        """
        if self.lines:
            return "csv"
        ending = self.base.rsplit(".", 1)[-1].lower()
        return self.format or (FILE_FORMAT if ending in NAMED_FORMATS else SAME_FORMAT.get(ending, ending))


class AbsentOutput(Output):
    """An output in the format of an extension that is not installed. It cannot be read, and its keys are kept as they are."""

    model_config = ConfigDict(extra="allow")
    takes: ClassVar[tuple[str, ...]] = tuple(KEYS_OF_FORMATS)


@cache
def of_extensions() -> Mapping[str, type[Output]]:
    """Return the classes of the outputs of extensions by format."""
    return {name: extensions.load("outputs", name) for name in extensions.added("outputs")}


def _having(key: str) -> list[str]:
    """Return the formats of extensions that have a key of their own."""
    return [name for name, own in of_extensions().items() if key in own.model_fields]


def _is_default_of_others(key: str, value: object) -> bool:
    """Return whether a key that only formats of extensions have says what it says by default; it may then be anywhere."""
    return any(value == of_extensions()[name].model_fields[key].default for name in _having(key))


def _formats(names: Iterable[str]) -> str:
    return " or ".join(f'format = "{name}"' for name in names)


def _unused(table: Table, keys: Iterable[str]) -> frozenset[str]:
    return frozenset(key for key in keys if getattr(table, key) == type(table).model_fields[key].default)


NEWEST = (2, 0, "")
"""The place of the newest part, as `part_of` returns it."""
NUMBERED = 1
"""The first number in the place of a part that has a number."""


def part_of(base: str, path: str) -> tuple[int, int, str] | None:
    """Return the place of a part of a rotated file by its age, the oldest first; None if the path is no part of it.

    A higher number is older, and so is an earlier date. The file itself is the newest part.
    """
    match = PART.fullmatch(path.removeprefix(base)) if path.startswith(base) else None
    if match is None:
        return None
    number, date = match[1], match[2]
    return (0, 0, re.sub("[^0-9]", "", date)) if date else (NUMBERED, -int(number), "") if number else NEWEST


def with_rotation(path: str, others: Iterable[str]) -> str:
    """Return the path of a file, with `{rotation}` if older parts of it are among the others."""
    return path + ROTATION if any((part_of(path, other) or NEWEST) < NEWEST for other in others) else path


def newest_of(path: str) -> str | None:
    """Return the name of the newest part of a rotated file, if a path has the name of an older part; else None."""
    found = _OLDER.fullmatch(path)
    return found[1] if found and (found[2] or found[3]) else None


def file_once(outputs: Mapping[str, Output]) -> Mapping[str, Output]:
    """Check that no two outputs have the same file, unless each makes a table of another part. Raises ValueError."""
    owners: dict[str, str] = {}
    for name, output in outputs.items():
        file = output.file.removeprefix("./")
        first = owners.setdefault(file, name)
        share = outputs[first].kind == output.kind and outputs[first].shares_file and output.shares_file
        if first != name and not share:
            both = f"{first!r} and {name!r} have the same file {file!r}"
            raise ValueError(f"{both}; a file becomes one table, unless each output has other lines or rows of it")
    return outputs


Columns = Mapping[str, tuple[str, ...]]
"""Names of columns by output."""


def volatile_and_rates(outputs: Mapping[str, Output]) -> tuple[Columns, Columns]:
    """Return the declared volatile columns, and the declared rates, of the outputs that have some."""
    volatile = {name: output.volatile for name, output in outputs.items() if output.volatile}
    return volatile, {name: output.rates for name, output in outputs.items() if output.rates}


SHELL = 128
"""The number that a shell adds to the signal that has ended a program."""
STATUSES = range(-64, 256)
"""The exit statuses of programs; those below 0 are signals."""


END = regex(r"exit (\d{1,3})|signal (?:SIG)?([A-Z][A-Z0-9+]*|\d{1,2})")
"""An end of a program that is no success, as `accept` names it."""


def end_of(text: str) -> str:
    """Return an end in its usual form: `exit 3`, `signal ABRT`. Raises ValueError for what is no end."""
    match = END.fullmatch(text)
    if match and match[1] and int(match[1]) in range(256):
        return f"exit {int(match[1])}"
    if match and match[2]:
        known = {each.name.removeprefix("SIG"): each for each in signal.Signals}
        with contextlib.suppress(KeyError, ValueError):
            number = signal.Signals(int(match[2])) if match[2].isdigit() else known[match[2]]
            return f"signal {number.name.removeprefix('SIG')}"
    raise ValueError(f'{text!r} is no end of a program; write "exit 3" (from 0 to 255) or "signal ABRT"')


class Success(Table):
    """Conditions for a successful run, in addition to its required outputs."""

    marker: Inside = Field("", description="a file in the output folder (or `stdout`, `stderr`) that must exist")
    contains: str = Field("", description="text that the marker file must contain")
    exit_status: tuple[int, ...] = Field(
        (0,), min_length=1, description="exit statuses that mean success; 139 and -11 both mean an end by signal 11"
    )
    accept: tuple[Annotated[str, AfterValidator(end_of)], ...] = Field(
        (),
        description="ends that are results although they are no successes: `exit 3`, `signal ABRT` (also the exit status 134); "
        "such a run has this outcome and is not executed again; required outputs and the marker are not asked of it, and its "
        "rows are in tables of their own, `NAME_accepted`",
    )
    stderr: Annotated[str, AfterValidator(regular_expression)] = Field(
        "",
        description="what a run must not print on standard error: `empty` fails each run that prints something, any other text "
        "is a regular expression that fails a run if a line matches",
    )
    leftovers: Literal["end", "fail"] = Field(
        "end",
        description="processes that still run when the command has ended: they are ended, and the run counts (`end`) or fails "
        "(`fail`)",
    )

    @property
    def statuses(self) -> frozenset[int]:
        """Return the exit statuses that mean success, with both spellings of each signal: 139 and -11."""
        return both_spellings(self.exit_status)

    @property
    def accepted_statuses(self) -> frozenset[int]:
        """Return the exit statuses of the ends in `accept`, with both spellings of each signal."""
        return both_spellings(map(_status, self.accept))

    def accepted(self, status: int | None) -> str | None:
        """Return the end in `accept` with which a program has ended; None if it is none of these.

        `status` is its exit status, negative for a signal.
        """
        return next((end for end in self.accept if status in both_spellings([_status(end)])), None)

    @model_validator(mode="after")
    def _distinct_ends(self) -> Success:
        for end in self.accept:
            if _status(end) in self.statuses:
                raise ValueError(f'accept: "{end}" is a success by exit_status; remove it from one of them')
        return self

    @property
    def unused_later_keys(self) -> frozenset[str]:
        """Return the later keys that have their default; hashes of rules do not contain them, and stay the same."""
        return _unused(self, ("stderr", "leftovers", "accept"))


def both_spellings(statuses: Iterable[int]) -> frozenset[int]:
    """Return exit statuses with both numbers of each signal: 139 and -11."""
    known = tuple(statuses)
    return frozenset({*known, *(SHELL - one for one in known if one < 0 or one > SHELL)})


def _status(end: str) -> int:
    """Return the exit status of an end, negative for a signal."""
    kind, value = end.split()
    return int(value) if kind == "exit" else -signal.Signals[f"SIG{value}"]


class Equivalence(Reduced):
    """A metric by which a replay compares nondeterministic runs, over all runs of an experiment."""

    table: str = Field(description="name of the output or derived table")
    column: str = Field(description="column of the table")
    measure: Measure = Field("final", description="how a run is reduced to one number, as in figures")
    margin: Positive | None = Field(
        None, description="maximum difference between means that are still equivalent, in the column's unit"
    )
    relative: Positive | None = Field(None, description="the margin as a fraction of the recorded mean (0.05: 5 %)")
    alpha: Alpha = 0.05

    @model_validator(mode="after")
    def _fitting(self) -> Equivalence:
        if (self.margin is None) == (self.relative is None):
            raise ValueError('give either "margin" or "relative"')
        return self
