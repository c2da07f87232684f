"""Files whose bytes on disk differ from those that git would restore, because a conversion of git's has lost something.

The source's id is that of what git commits. Line endings (`text=auto` over a file with CRLF), `ident`, an encoding and a clean
filter change a file before it is committed, and so two different files may have one id. Runs read the file on disk. Therefore
the SHA-256 of such a file's bytes is recorded with the programs of executions, and only equal bytes are reused.

Only files to which such an attribute applies, or all files with core.autocrlf, are looked at. Where git restores what it has
committed, the file's own hash shows whether it is the same. For the others, one call of git restores all of them into a
temporary folder. A pointer of git-lfs has the SHA-256 of its data. A cache beside SIERRA's index keeps the answers as long as a
file's status, its attributes and git's settings are the same. 50,000 files with an attribute take half a second then.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import tempfile
import time
from collections.abc import Iterator, Mapping, Set
from pathlib import Path

from sierra.provenance.source.git import Git
from sierra.provenance.source.lfs import POINTER
from sierra.provenance.source.manifest import Files, git_hash, parts, read, written
from sierra.util.fs import RACY_NS, read_sealed, state, write_whole
from sierra.util.hashing import sealed, sha256, sha256_file
from sierra.util.lazy_definitions import dataclass

ATTRIBUTES = ("text", "eol", "crlf", "filter", "ident", "working-tree-encoding")
CONVERTED = f":(exclude,attr:{' '.join(f'!{name}' for name in ATTRIBUTES)})"
"""The files for which any of these attributes is specified."""
SETTINGS = (b"core.autocrlf", b"core.eol", b"filter.")
"""The beginnings of the settings by which git converts files."""
ABSENT, OFF, LFS = ("unspecified", "unset"), ("false", "no", "off", "0"), "lfs"
CHUNK = 1 << 20


@dataclass(frozen=True, slots=True)
class Rules:
    """The rules by which git converts the files of an index: its settings, and the attributes of these files."""

    wanted: Mapping[bytes, bytes]
    """The files that may be converted."""
    settings: bytes
    attributes: bytes
    """The output of `git check-attr -z`."""

    @property
    def id(self) -> str:
        return sha256(self.settings + self.attributes)

    def kept(self) -> bytes:
        """Return the rules in the form in which they are kept beside SIERRA's index: hashes, and the attributes of files."""
        return b"%s %s " % (self.id.encode(), sha256(self.settings).encode()) + written(self._by_path())

    def are(self, kept: bytes) -> bool:
        """Return True if exactly these rules, for the same files, were kept."""
        return kept.startswith(self.id.encode())

    def differ(self, kept: bytes, files: Files, fresh: Set[bytes]) -> bool:
        """Return True if files of an index were read by other rules, which were kept, except those that are `fresh`."""
        _, settings, attributes = kept.split(b" ", 2)
        was, now = read(attributes), self._by_path()
        changed = (path for path in was.keys() | now.keys() if was.get(path) != now.get(path))
        return settings != sha256(self.settings).encode() or any(path in files and path not in fresh for path in changed)

    def _by_path(self) -> dict[bytes, bytes]:
        """Return the attributes that each file has."""
        found = {
            path: " ".join(f"{name}={value}" for name, value in values.items() if value != ABSENT[0]).encode()
            for path, values in _by_path(self.attributes).items()
        }
        return {path: values for path, values in found.items() if values}


def rules(git: Git, files: Files, index: Path | None = None) -> Rules:
    """Return the rules for these files. `index` has them, by default the user's index. Raises Missing if git fails."""
    settings = b"\0".join(line for line in git.settings if line.startswith(SETTINGS))
    autocrlf = _last(settings, b"core.autocrlf")
    pathspecs = () if autocrlf and autocrlf not in OFF else (CONVERTED,)
    listed = read(git("ls-files", "--stage", "-z", "--", *pathspecs, index=index))
    wanted = {path: files[path] for path, what in listed.items() if what[:3] == b"100" and files.get(path) == what[:-2]}
    given = b"".join([path + b"\0" for path in wanted])
    attributes = git("check-attr", "--stdin", "-z", *ATTRIBUTES, index=index, given=given) if wanted else b""
    return Rules(wanted, settings, attributes)


def find(git: Git, files: Files, index: Path | None = None, by: Rules | None = None) -> dict[bytes, str]:
    """Return the SHA-256 of the bytes on disk of each of these files that git would restore with other bytes.

    `index` has the files, by default the user's index; `by` are the rules for them. Raises Missing if git fails.
    """
    by = by or rules(git, files, index)
    wanted, settings, attributes = by.wanted, by.settings, by.attributes
    if not wanted:
        return {}
    memory = _Memory(git, by.id)
    seen = {path: b"%s %s" % (now, what) for path, what in wanted.items() if (now := _state(git.root, path))}
    answers = {path: known for path, now in seen.items() if (known := memory.get(path, now)) is not None}
    if len(answers) < len(seen):
        autocrlf = _last(settings, b"core.autocrlf")
        crlf = autocrlf not in (None, "input", *OFF) or _last(settings, b"core.eol") == "crlf"
        unknown = {path: parts(wanted[path])[1] for path in seen.keys() - answers.keys()}
        answers.update(_Restored(git, index, _by_path(attributes), unknown, crlf=crlf).answers())
        memory.save(answers, seen)
    return {path: answer for path, answer in sorted(answers.items()) if answer}


def _last(settings: bytes, name: bytes) -> str | None:
    """Return the value of a setting of git; the last one counts."""
    values = [value for key, _, value in (line.partition(b"\n") for line in settings.split(b"\0")) if key == name]
    return values[-1].decode("utf-8", "replace").lower() if values else None


def _by_path(attributes: bytes) -> dict[bytes, dict[str, str]]:
    """Parse the output of `git check-attr -z`."""
    found: dict[bytes, dict[str, str]] = {}
    fields = attributes.split(b"\0")[:-1]
    for path, name, value in zip(fields[::3], fields[1::3], fields[2::3], strict=True):
        found.setdefault(path, {})[name.decode()] = value.decode("utf-8", "replace")
    return found


def _state(root: Path, path: bytes) -> bytes:
    """Return the status of a file; nothing if it is not checked out."""
    try:
        return b"%d %d %d %d %d" % tuple(state(b"%s/%s" % (os.fsencode(root), path)))
    except OSError:
        return b""


class _Restored:
    """The comparison of files with the bytes that git would restore."""

    def __init__(
        self,
        git: Git,
        index: Path | None,
        attributes: Mapping[bytes, Mapping[str, str]],
        blobs: Mapping[bytes, str],
        *,
        crlf: bool,
    ) -> None:
        self._git, self._index, self._blobs = git, index, blobs
        self._attributes, self._crlf = attributes, crlf

    def answers(self) -> Iterator[tuple[bytes, str]]:
        """Yield for each file the SHA-256 of its bytes on disk, or an empty text if git would restore the same bytes."""
        filtered: dict[bytes, str] = {}
        for path, blob in self._blobs.items():
            with contextlib.suppress(OSError):  # the file has just been removed
                digest, stored = self._stored(path, "sha1" if len(blob) == 40 else "sha256")
                if self._is_restored_unchanged(path):
                    yield path, "" if stored == blob else digest
                elif stored == blob and self._attributes[path]["filter"] == LFS:
                    yield path, ""
                else:
                    filtered[path] = digest
        yield from self._filtered(filtered)

    def _stored(self, path: bytes, algorithm: str) -> tuple[str, str]:
        """Return the SHA-256 of a file, and git's hash of it; of data that git-lfs manages, git's hash of its pointer."""
        digest = hashlib.sha256()
        with open(os.path.join(self._git.root, os.fsdecode(path)), "rb", buffering=0) as file:  # noqa: PTH118, PTH123 - for speed
            size = os.fstat(file.fileno()).st_size
            blob = hashlib.new(algorithm, b"blob %d\0" % size, usedforsecurity=False)
            while content := file.read(CHUNK):
                digest.update(content)
                blob.update(content)
        hashed = digest.hexdigest()
        if self._attributes[path]["filter"] == LFS:
            return hashed, git_hash(b"blob", POINTER + b"oid sha256:%s\nsize %d\n" % (hashed.encode(), size), algorithm)
        return hashed, blob.hexdigest()

    def _is_restored_unchanged(self, path: bytes) -> bool:
        """Return True if git would restore exactly what it has stored."""
        values = self._attributes[path]
        changing = any(values[name] not in ABSENT for name in ("filter", "ident", "working-tree-encoding"))
        return not changing and not self._crlf and values["eol"] != "crlf"

    def _filtered(self, digests: Mapping[bytes, str]) -> Iterator[tuple[bytes, str]]:
        """Compare files with those that git writes into a temporary folder. A file that a filter cannot restore differs."""
        if not digests:
            return
        with tempfile.TemporaryDirectory(prefix="sierra-") as folder:
            given = b"".join([self._git.prefix + path + b"\0" for path in digests])
            words = ("checkout-index", "-q", "-z", "--stdin")
            self._git(*words, index=self._index or self._git.index, into=Path(folder), given=given, optional=True)
            for path, digest in digests.items():
                restored = Path(folder, os.fsdecode(self._git.prefix + path))
                yield path, "" if restored.is_file() and sha256_file(restored) == digest else digest


class _Memory:
    """A cache of answers by path, valid for the same status and blob of the file, and for the same `settings`."""

    def __init__(self, git: Git, settings: str) -> None:
        self._file = git.folder / "sierra" / f"converted-{sha256(git.prefix)[:16]}"
        self._settings = settings.encode()
        self._began = time.time_ns()
        self._known: dict[bytes, bytes] = {}
        known = read_sealed(self._file)
        if known.startswith(self._settings):
            self._known = read(known.removeprefix(self._settings))

    def get(self, path: bytes, seen: bytes) -> str | None:
        known, _, answer = self._known.get(path, b"").rpartition(b" ")
        return answer.decode() if known == seen else None

    def save(self, answers: Mapping[bytes, str], seen: Mapping[bytes, bytes]) -> None:
        """Keep the answers, except for files that were changed so recently that another change may not be visible."""
        settled = self._began - RACY_NS
        known = ((path, seen[path], answer) for path, answer in answers.items())
        kept = {path: b"%s %s" % (now, answer.encode()) for path, now, answer in known if _changed(now) < settled}
        with contextlib.suppress(OSError):  # without the cache, the next call is slower
            self._file.parent.mkdir(exist_ok=True)
            write_whole(self._file, sealed(self._settings + written(kept)))


def _changed(seen: bytes) -> int:
    """Return when a file with this status was changed."""
    return max(map(int, seen.split(b" ")[3:5]))
