"""The words that show who made a package or where: names, e-mail addresses, hosts, folders, repositories, affiliations.

They come from `[package]`, the settings of git, the user's account, this machine, and the records. A word that is also common
in code and logs (`root`, `localhost`, the licence) shows nothing, and is not searched.
"""

from __future__ import annotations

import contextlib
import os
import pwd
import re
import socket
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

from sierra.config.field_types import RawTable
from sierra.config.package_table import Package
from sierra.config.project_file import LoadedProject
from sierra.errors import Missing
from sierra.packages.anonymity.redact_rows import HIDDEN
from sierra.provenance.source.git import Git
from sierra.store.store import Store
from sierra.util.lazy_definitions import regex

GENERAL = frozenset(
    (
        *("root", "user", "users", "admin", "administrator", "nobody", "anonymous", "guest", "test", "runner", "home", "git"),
        *("localhost", "localdomain", "local", "localhost.localdomain", "info", "mail", "contact", "noreply", "www", "srv"),
        *("ubuntu", "debian", "fedora", "docker", "podman", "host", "node", "unknown", "builder", "build", "work", "tmp"),
    )
)
"""Names of users and hosts that many machines have."""
FORGES = frozenset(
    (
        *("github.com", "gitlab.com", "bitbucket.org", "codeberg.org", "git.sr.ht", "sourceforge.net", "zenodo.org"),
        *("gmail.com", "outlook.com", "hotmail.com", "yahoo.com", "icloud.com", "proton.me", "protonmail.com", "gmx.de"),
        *("gmx.net", "web.de", "qq.com", "163.com", "users.noreply.github.com", "doi.org", "orcid.org", "ror.org"),
    )
)
"""Hosts that anybody may use."""
PSEUDONYM = regex(r"host-\d+")
"""Names of hosts in records that were rewritten before: see `sierra.packages.anonymity.redact_store`."""
SHORTEST = 2
"""The number of characters of the shortest word that is searched."""
DEPTH = 2
"""The number of parts of a path such as `/home`, which shows nothing."""
ADDRESS = regex(r"(?:[\w.+-]+://)?(?:[^@/\s]*@)?(?P<host>\w[\w.-]*)(?::\d+)?[:/]+(?P<path>[^\s?#]*)")
HOSTS = """
SELECT host FROM executions UNION SELECT host FROM environments UNION SELECT host FROM builds UNION SELECT node FROM attempts
UNION SELECT host FROM robots WHERE host IS NOT NULL ORDER BY ALL
"""
OPERATORS = "SELECT DISTINCT operator FROM all_trials WHERE operator IS NOT NULL ORDER BY ALL"
REMOTES = "SELECT DISTINCT remote FROM sources WHERE remote IS NOT NULL ORDER BY ALL"


class Word(NamedTuple):
    """A text that must not be in an anonymous package, and its kind."""

    text: str
    kind: str
    whole: bool = False
    """True if the text counts only where no letters are beside it."""


def words(project: LoadedProject, store: Store) -> tuple[list[Word], list[str]]:
    """Return the words that identify, each once, and those that are too general to be searched."""
    identifying: dict[str, Word] = {}
    general: dict[str, None] = {}
    for word in _all(project, store):
        key = word.text.strip().casefold()
        if (
            len(key) < SHORTEST
            or key in (*GENERAL, *FORGES, project.config.package.license.casefold())
            or PSEUDONYM.fullmatch(key)
        ):
            general |= {word.text: None} if key else {}
        else:
            identifying.setdefault(key, word._replace(text=word.text.strip()))
    return list(identifying.values()), list(general)


def _all(project: LoadedProject, store: Store) -> Iterator[Word]:
    yield from _of_package(project.config.package)
    yield from _of_git(project.root, store.values(str, REMOTES))
    yield from _of_account()
    for folder in dict.fromkeys((project.root, project.root.resolve(), *project.root.parents, *project.root.resolve().parents)):
        if folder == project.root or len(folder.parts) > DEPTH:
            yield Word(str(folder), "folder of the project")
    for host in dict.fromkeys((socket.gethostname(), os.uname().nodename, *store.values(str, HOSTS))):
        yield from _of_host(host)
    for address in _addresses(project.config.runners.get("robots", {})):
        yield from _of_host(address)
    for operator in store.values(str, OPERATORS):
        if operator != HIDDEN:
            yield from _of_name(operator, "operator")


def _addresses(table: RawTable) -> Iterator[str]:
    """Yield the hosts of a fleet that are names in a domain; other names are only known to a configuration of OpenSSH."""
    fleet = table.get("fleet")
    for robot in fleet.values() if isinstance(fleet, Mapping) else ():
        host = str(robot.get("host", "")) if isinstance(robot, Mapping) else ""
        address = host.rpartition("@")[2].partition(":")[0]
        if "." in address and re.search("[A-Za-z]", address):
            yield address


def _of_package(package: Package) -> Iterator[Word]:
    for author in package.authors:
        yield from _of_name(f"{author.given} {author.family}".strip(), "author")
        for text, kind in ((author.orcid, "ORCID"), (author.affiliation, "affiliation"), (author.ror, "affiliation")):
            if text:
                yield Word(text.removeprefix("https://"), kind)
    for identifier in filter(None, (package.doi, *(publication.identifier for publication in package.related))):
        yield Word(re.sub(r"^https?://", "", identifier), "publication")
    yield from _of_address(package.repository)


def _of_name(name: str, kind: str) -> Iterator[Word]:
    """Yield a full name, and the family name."""
    yield Word(name, kind)
    parts = name.split()
    if len(parts) > 1:
        yield Word(f"{parts[0]} {parts[-1]}", kind)
        yield Word(parts[-1], kind, whole=True)


def _of_git(root: Path, recorded: Iterable[str]) -> Iterator[Word]:
    settings = ""
    with contextlib.suppress(Missing):
        keys = r"^(user|author|committer)\.(name|email)$|^remote\..*\.(push)?url$"
        settings = Git(root)("config", "--get-regexp", keys, optional=True).decode("utf-8", "replace")
    pairs = [line.partition(" ")[::2] for line in settings.splitlines()]
    names = [value for key, value in pairs if key.endswith(".name")]
    mails = [value for key, value in pairs if key.endswith(".email")]
    for name in (*names, *(os.environ.get(f"GIT_{role}_NAME", "") for role in ("AUTHOR", "COMMITTER"))):
        yield from _of_name(name, "name in git")
    for mail in (*mails, *(os.environ.get(f"GIT_{role}_EMAIL", "") for role in ("AUTHOR", "COMMITTER")), _mail()):
        yield from _of_mail(mail)
    for address in (*(value for key, value in pairs if key.startswith("remote.")), *recorded):
        yield from _of_address(address)


def _mail() -> str:
    return os.environ.get("EMAIL", "")


def _of_mail(mail: str) -> Iterator[Word]:
    local, at, domain = mail.rpartition("@")
    if at:
        yield Word(mail, "e-mail address")
        yield Word(local, "e-mail address")
        yield Word(domain, "e-mail address")


def _of_address(address: str) -> Iterator[Word]:
    """Yield the host and the owner in the address of a repository, and the address without its scheme; or an absolute path."""
    address = address.removeprefix("file://")
    match = ADDRESS.fullmatch(address)
    if match is None or address.startswith((".", "/", "~")):
        yield Word(address if address.startswith("/") else "", "address of a repository")
        return
    path = match["path"].removesuffix(".git").strip("/")
    yield Word(match["host"], "host of a repository")
    yield Word(f"{match['host']}/{path}", "address of a repository")
    yield Word(f"{match['host']}:{path}", "address of a repository")
    if "/" in path:
        yield Word(path.partition("/")[0], "owner of a repository")


def _of_account() -> Iterator[Word]:
    account = _account()
    names = [os.environ.get(variable, "") for variable in ("USER", "LOGNAME", "SUDO_USER")]
    homes = [str(Path.home())]
    if account is not None:
        names.append(account.pw_name)
        homes.append(account.pw_dir)
        yield from _of_name(account.pw_gecos.partition(",")[0], "name of the user")
    for name in names:
        yield Word(name, "user name")
    for home in homes:
        if len(Path(home).parts) > 1 and Path(home).name.casefold() not in GENERAL:
            yield Word(home, "home folder")


def _account() -> pwd.struct_passwd | None:
    try:
        return pwd.getpwuid(os.getuid())
    except KeyError:
        return None  # a container may have no entry for its user


def _of_host(host: str) -> Iterator[Word]:
    first, _, domain = host.partition(".")
    yield Word(host, "host name")
    yield Word(first, "host name")
    yield Word(domain, "host name")
