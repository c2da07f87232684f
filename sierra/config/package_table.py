"""The table `[package]` of `sierra.toml`: the description of a reproduction package, from which all metadata files are made."""

from __future__ import annotations

import re
from collections.abc import Callable
from datetime import datetime
from typing import Annotated, Literal

from pydantic import AfterValidator, BeforeValidator, Field, StringConstraints

from sierra.config.field_types import Size, Table
from sierra.util.lazy_definitions import regex

Relation = Literal[
    "isSupplementTo",
    "isCitedBy",
    "cites",
    "isDerivedFrom",
    "isNewVersionOf",
    "isPreviousVersionOf",
    "isPartOf",
    "hasPart",
    "isDocumentedBy",
    "documents",
    "isReferencedBy",
    "references",
    "requires",
    "isSourceOf",
]
"""Relations of DataCite and Zenodo between this package (first) and the other object."""
DOI = regex(r"10\.\d{4,9}/\S+")
Line = Annotated[str, StringConstraints(strip_whitespace=True, min_length=1, pattern=r"^[^\r\n]*$")]
Sha256 = Annotated[str, StringConstraints(pattern=r"^[0-9a-f]{64}$")]
OneLine = Annotated[str, StringConstraints(strip_whitespace=True, pattern=r"^[^\r\n]*$")]


def _unless_empty(check: Callable[[str], str]) -> AfterValidator:
    """Return a validator of a text that may be empty."""
    return AfterValidator(lambda text: check(text) if text else text)


def _address(text: str) -> str:
    if not re.fullmatch(r"https?://[^\s/]+\S*", text):
        raise ValueError(f"{text!r} should be an address, as https://example.org/data")
    return text


def _orcid(text: str) -> str:
    """Return the sixteen digits of an ORCID, whose last one is a checksum (ISO 7064, MOD 11-2)."""
    digits = text.removeprefix("https://orcid.org/")
    if not re.fullmatch(r"\d{4}-\d{4}-\d{4}-\d{3}[\dX]", digits):
        raise ValueError(f"{text!r} should be an ORCID, as 0000-0002-1825-0097")
    total = 0
    for digit in digits.replace("-", "")[:-1]:
        total = (total + int(digit)) * 2
    if "0123456789X"[(12 - total % 11) % 11] != digits[-1]:
        raise ValueError(f"{text!r} is no ORCID: its last digit does not fit the others")
    return digits


def _ror(text: str) -> str:
    """Return the address of an organization in the Research Organization Registry."""
    name = text.removeprefix("https://ror.org/")
    if not re.fullmatch(r"0[a-hj-km-np-tv-z0-9]{6}[0-9]{2}", name):
        raise ValueError(f"{text!r} should be a ROR id, as https://ror.org/017zqws13")
    return f"https://ror.org/{name}"


def _licence(text: str) -> str:
    """Return a licence expression in SPDX's spelling."""
    from packaging.licenses import InvalidLicenseExpression, canonicalize_license_expression

    try:
        return str(canonicalize_license_expression(text))
    except InvalidLicenseExpression as error:
        raise ValueError(f"{text!r} should be an SPDX licence, as MIT or CC-BY-4.0: {error}") from error


def _identifier(text: str) -> str:
    """Return a DOI without its resolver, or an address."""
    doi = re.sub(r"^(https?://(dx\.)?doi\.org/|doi:)", "", text, flags=re.IGNORECASE)
    if not DOI.fullmatch(doi) and not re.fullmatch(r"https?://\S+", text):
        raise ValueError(f"{text!r} should be a DOI, as 10.5555/12345678, or an address")
    return doi if DOI.fullmatch(doi) else text


def _moment(value: object) -> object:
    """Return the text of a date that TOML has parsed."""
    return value.isoformat() if hasattr(value, "isoformat") else value


def _date(text: str) -> str:
    try:
        datetime.fromisoformat(text)
    except ValueError as error:
        raise ValueError(f"{text!r} should be a date, as 2026-11-23") from error
    return text


class Author(Table):
    """A person who made the package."""

    name: Line = Field(description="the name, as `Jane Doe` or `Doe, Jane`")
    orcid: Annotated[str, AfterValidator(_orcid)] | None = Field(None, description="ORCID, as 0000-0002-1825-0097")
    affiliation: Line | None = Field(None, description="name of the organization")
    ror: Annotated[str, AfterValidator(_ror)] | None = Field(
        None, description="the organization in the Research Organization Registry, as https://ror.org/017zqws13"
    )

    @property
    def given(self) -> str:
        """The given names; "" if the name has one word."""
        last, comma, first = self.name.partition(",")
        return first.strip() if comma else " ".join(last.split()[:-1])

    @property
    def family(self) -> str:
        last, comma, _ = self.name.partition(",")
        return last.strip() if comma else last.split()[-1]


class Related(Table):
    """Another object to which the package belongs, for example the paper."""

    identifier: Annotated[str, AfterValidator(_identifier)] = Field(description="DOI, as 10.5555/12345678, or address")
    relation: Relation = Field("isSupplementTo", description="relation of the package to it, as Zenodo and DataCite name them")


class ExternalData(Table):
    """Data that the runs need, and that are not in the package."""

    name: Line = Field(description="the file's path in the project")
    url: Annotated[str, AfterValidator(_address)] = Field(description="address to download it from")
    sha256: Sha256 = Field(description="its SHA-256, as 64 digits")
    description: str = Field("", description="what it is, and its licence")


class Package(Table):
    """The description of reproduction packages, from which CITATION.cff is made."""

    title: OneLine = Field("", description="title of the package")
    description: str = Field("", description="what the package contains, in a few sentences")
    authors: tuple[Author, ...] = Field((), description="authors, in the order of the paper")
    license: Annotated[str, _unless_empty(_licence)] = Field("", description="SPDX licence, as MIT or CC-BY-4.0")
    keywords: tuple[Line, ...] = Field((), description="keywords")
    version: OneLine = Field("", description="version of the package; default: none")
    date: Annotated[str, BeforeValidator(_moment), _unless_empty(_date)] = Field(
        "", description="date of publication, as 2026-11-23; default: the date of the newest packed record"
    )
    doi: Annotated[str, _unless_empty(_identifier)] = Field("", description="DOI of the package, once it has one")
    repository: Annotated[str, _unless_empty(_address)] = Field("", description="address of the project's repository")
    related: tuple[Related, ...] = Field((), description="the paper and other related objects")
    history: bool = Field(True, description="whether packages have the history of the recorded commits, as a git bundle")
    max_file: Size = Field(
        100_000_000, description="maximum size of a packed file, in bytes or as in `100 MB`; a larger file must be confirmed"
    )
    no_secrets: tuple[Line, ...] = Field(
        (),
        description="files and variables that only look as if they contained a secret: names as `sierra package` reports them; "
        "`*` matches any characters",
    )
    data: tuple[ExternalData, ...] = Field((), description="data that the runs need, and that the package does not contain")
