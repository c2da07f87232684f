"""The contents of an image: its files with their hashes, its packages, its labels, and how it was made.

They are kept in `.sierra/images/<id>/`, next to the squashfs that apptainer runs. All of them can be made again from the image.
Every file is written under a temporary name and then renamed, so that processes that inspect the same image at the same time do
not disturb each other.

Packages are read from the records of package managers: deb-control(5) paragraphs in `var/lib/dpkg/status` (or one file each in
`status.d`, as in distroless images), `lib/apk/db/installed` (P: and V: lines), and `METADATA` of a Python distribution
(PEP 566).
"""

from __future__ import annotations

import contextlib
import json
import os
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from functools import cached_property
from pathlib import Path

from sierra.containers.images import containerfile_folder, oci, podman_images, sif_format
from sierra.containers.images import squashfs_tools as squashfs
from sierra.containers.images.image import DEFAULT_PATH, Image, Kind, of_fields, short
from sierra.containers.images.merge_layers import Entry, Rootfs, listed, listing, merge, resolve
from sierra.containers.images.oci import Archive
from sierra.errors import Damaged, Missing
from sierra.provenance.hash_cache import cached_sha256
from sierra.store.layout import ImagePaths, StorePaths
from sierra.store.row_types import ImageRow
from sierra.util.fs import UNFINISHED_END, write_whole
from sierra.util.hashing import sha256
from sierra.util.json_types import JsonView, as_object
from sierra.util.lazy_definitions import regex
from sierra.util.regular_files import read_regular, read_regular_text

FORMAT = 1
UNFINISHED = regex(rf"\.(saved\.\w+\.\d+|(image\.json|files\.jsonl){UNFINISHED_END}|rootfs\.(sqfs|\d+)\.\d+)")
FOLDER = regex(r"[a-z0-9]+-[0-9a-f]{64}")
EXECUTABLE = 0o111
STORED = ("form", "manifests", "config", "labels", "recipe", "created", "size", "squashfs")
"""The fields of `Contents` that are stored as they are."""

STATUS, STATUS_D, APK = "var/lib/dpkg/status", "var/lib/dpkg/status.d/", "lib/apk/db/installed"
METADATA = regex(r"(?:^|/)[^/]+\.(?:dist-info/METADATA|egg-info/PKG-INFO)$")
LISTS, HEAD = 64 << 20, 1 << 16
"""The greatest number of bytes that are read of a manager's list, and of one distribution's metadata."""


@dataclass(frozen=True)
class Contents:
    """The contents of an image."""

    image: Image
    form: str
    """The form that was read: docker-archive, oci-archive, oci, sif or squashfs."""
    manifests: Mapping[str, str]
    """The digests of its manifests, by the form in which each was seen; every form has its own."""
    config: Mapping[str, JsonView]
    labels: Mapping[str, str]
    packages: Mapping[str, tuple[str, ...]]
    recipe: str
    """The text of its Containerfile folder, the definition file of a SIF, or the build steps in its history."""
    created: str
    size: int
    """The total size of its files in bytes."""
    listing: bytes
    """The list of its files by path, one JSON object per line."""
    squashfs: str = ""
    """The SHA-256 of the squashfs that was made from it; empty if there is none."""

    @classmethod
    def of_row(cls, row: ImageRow, listing: bytes) -> Contents:
        """Return the contents from a row of the table `images` and the listing that the row names."""
        variables, packages = (json.loads(text or "{}") for text in (row.variables, row.packages))
        return cls(
            image=Image(row.name or "", row.image, Kind(row.kind), row.architecture or "", tuple(row.layers), variables),
            form="",
            manifests=json.loads(row.manifests or "{}"),
            config={},
            labels=json.loads(row.labels or "{}"),
            packages={manager: tuple(lines) for manager, lines in packages.items()},
            recipe=row.recipe or "",
            created=row.created.isoformat() if row.created else "",
            size=row.size,
            listing=listing,
            squashfs=row.squashfs or "",
        )

    @property
    def user(self) -> str:
        """Return the user that the image sets for its programs; empty for root. Engines ignore this user."""
        user = str(as_object(self.config.get("config")).get("User") or "")
        return "" if user.partition(":")[0] in ("", "0", "root") else user

    @cached_property
    def files(self) -> dict[str, Entry]:
        """Return every path of the image with its entry. Paths have no leading slash."""
        return listed(self.listing.splitlines())

    def program(self, word: str, path: str | None = None) -> str | None:
        """Return the path of the program that a command's first word calls in the image, or None if there is none.

        The program is searched on `path`, or else on the image's own PATH. The result is the path by which it is called
        (`/bin/sh`), which may be a link; `sha256` follows links.
        """
        if "/" in word:
            return word if self._executable(word) else None
        folders = (path or self.image.variables.get("PATH") or DEFAULT_PATH).split(":")
        candidates = (f"{folder.rstrip('/')}/{word}" for folder in folders if folder.startswith("/"))
        return next((candidate for candidate in candidates if self._executable(candidate)), None)

    def real(self, path: str) -> str | None:
        """Return the path with all links followed within the image, or None if nothing is there."""
        found = resolve(path, self.files.get)
        return None if found is None else f"/{found}"

    def sha256(self, path: str) -> str | None:
        """Return the SHA-256 of a file of the image, with links followed; None if there is no such file."""
        entry = self._file(path)
        return None if entry is None else entry.sha256

    def _file(self, path: str) -> Entry | None:
        found = resolve(path, self.files.get)
        entry = self.files.get(found) if found else None
        return entry if entry is not None and entry.type == "file" else None

    def _executable(self, path: str) -> bool:
        entry = self._file(path)
        return entry is not None and bool(entry.mode & EXECUTABLE)

    def row(self) -> ImageRow:
        """Return its row of the table `images`. The listing, whose hash is in `files`, is stored as an object."""
        image = self.image
        return ImageRow(
            image=image.id,
            kind=str(image.kind),
            architecture=image.architecture or None,
            layers=list(image.layers),
            name=image.name,
            file=image.file or None,
            sha256=image.sha256 or None,
            squashfs=self.squashfs or None,
            manifests=json.dumps(dict(self.manifests), sort_keys=True),
            created=_time(self.created),
            labels=json.dumps(dict(self.labels), sort_keys=True),
            variables=json.dumps(dict(image.variables), sort_keys=True),
            packages=json.dumps({name: list(lines) for name, lines in self.packages.items()}, sort_keys=True),
            recipe=self.recipe or None,
            files=sha256(self.listing),
            size=self.size,
        )


def contents(store: StorePaths, image: Image) -> Contents | None:
    """Return the stored contents of an image, or None if they are missing or incomplete."""
    found = _stored(store.image(image.folder))
    if found is None or found.image.id != image.id:
        return None
    architecture, variables = image.architecture or found.image.architecture, image.variables or found.image.variables
    return replace(found, image=replace(image, architecture=architecture, variables=variables))


def _stored(paths: ImagePaths) -> Contents | None:
    with contextlib.suppress(OSError, ValueError, LookupError, TypeError, AttributeError):
        fields, files = json.loads(read_regular_text(paths.description)), read_regular(paths.files)
        if fields["format"] == FORMAT and sha256(files) == fields["files"]:
            image = of_fields(fields["image"]["name"], fields["image"])
            packages = {manager: tuple(lines) for manager, lines in fields["packages"].items()}
            return Contents(image, packages=packages, listing=files, **{name: fields[name] for name in STORED})
    return None


def unfinished(store: StorePaths) -> Iterator[Path]:
    """Yield unfinished files and saved copies of images. Each name ends with the id of the process that made it."""
    if store.images.is_symlink():  # it is unknown who owns the target
        return
    for path in (*store.images.glob(".*"), *store.images.glob("*/.*")):
        placed = path.parent == store.images or (FOLDER.fullmatch(path.parent.name) and not path.parent.is_symlink())
        if placed and UNFINISHED.fullmatch(path.name):
            yield path


def outdated(root: Path, store: StorePaths, image: Image) -> bool:
    """Return whether an image's name is a Containerfile folder that has changed since the image was built."""
    folder = root / image.name
    if image.file or not containerfile_folder.is_recipe(folder):
        return False
    found = contents(store, image)
    return found is not None and found.labels.get(containerfile_folder.LABEL) != containerfile_folder.identity(folder)


def known(store: StorePaths) -> Iterator[Contents]:
    """Yield the contents of all images that this store describes, with the names by which they were first seen."""
    for folder in sorted(store.images.glob("*-*")) if store.images.is_dir() else ():
        found = _stored(store.image(folder.name))
        if found is not None and found.image.folder == folder.name:
            yield found


def made_from(store: StorePaths, digest: str) -> Image | None:
    """Return the image from which the squashfs with this SHA-256 was made in this store, or None."""
    return next((one.image for one in known(store) if one.squashfs == digest), None)


def examine(root: Path, store: StorePaths, image: Image) -> Contents:
    """Return the contents of an image. Reads the whole image if they are not stored yet. Raises Missing, Damaged."""
    stored = contents(store, image)
    if stored is not None:
        return stored
    if image.file and is_apptainer_image(root / image.file):
        with _disk(store.images):
            return _keep(store, _of_squashfs(root / image.file, image))
    return examine_again(root, store, image)


def examine_again(root: Path, store: StorePaths, image: Image, *, foreign: bool = False) -> Contents:
    """Return the contents of an image after reading and checking all of it again. `foreign`: see `merge_layers.merge`."""
    known = contents(store, image)
    with _disk(store.images), opened(root, store, image) as read:
        found = _of_rootfs(merge(read, wanted, foreign=foreign), image)
        recipe = containerfile_folder.text(root / image.name, found.labels.get(containerfile_folder.LABEL, ""))
        return _keep(store, replace(found, recipe=recipe or found.recipe, squashfs=known.squashfs if known else ""))


def rootfs(root: Path, store: StorePaths, image: Image) -> Path:
    """Return the path of the squashfs that apptainer runs: the image's own file, or one made from its layers.

    A missing squashfs is made. An existing one is hashed before it is used (the hash is cached); a damaged one is made again.
    """
    if image.file and is_apptainer_image(root / image.file):
        return root / image.file
    paths, known = store.image(image.folder), contents(store, image)
    if known is None or not known.squashfs or not paths.rootfs.is_file() or cached_sha256(paths.rootfs) != known.squashfs:
        with _disk(store.images), opened(root, store, image) as read:
            merged = merge(read, wanted)
            paths.root.mkdir(parents=True, exist_ok=True)
            digest = squashfs.make(merged.write, paths.rootfs)
            _keep(store, replace(contents(store, image) or _of_rootfs(merged, image), squashfs=digest))
    return paths.rootfs


def is_apptainer_image(path: Path) -> bool:
    """Return whether apptainer can run this file as it is: a SIF or a squashfs. Raises Missing if it cannot be read."""
    try:
        return not path.is_dir() and (sif_format.is_sif(path) or squashfs.is_squashfs(path))
    except OSError as error:
        raise Missing(f"{path} cannot be read: {error.strerror or error}") from error


@contextlib.contextmanager
def opened(root: Path, store: StorePaths, image: Image) -> Iterator[Archive]:
    """Yield an OCI image as an archive: its own file, or a copy that podman saves. Raises Damaged if that is another image."""
    with contextlib.ExitStack() as stack:
        path = root / image.file
        if not image.file:
            podman_images.require(image)
            store.images.mkdir(parents=True, exist_ok=True)
            folder = stack.enter_context(
                tempfile.TemporaryDirectory(prefix=".saved.", suffix=f".{os.getpid()}", dir=store.images)
            )
            path = Path(folder) / "image.tar"
            podman_images.save(image.id.removeprefix("sha256:"), path)
        read = oci.read(path)
        if read.id != image.id:
            raise Damaged(f"{path} is the image {short(read.id)}, not {short(image.id)}")
        yield read


def wanted(path: str) -> int:
    return _wanted_list(path) or sif_format.wanted(path)


def _of_rootfs(merged: Rootfs, image: Image) -> Contents:
    read = merged.archive
    config = read.config
    return Contents(
        image=image,
        form=read.form,
        manifests={read.form: read.manifest} if read.manifest else {},
        config=config,
        labels=oci.labels(config),
        packages=_packages(merged.kept),
        recipe=_history(config),
        created=str(config.get("created") or ""),
        size=sum(entry.size for entry in merged.entries),
        listing=listing(merged.entries),
    )


def _of_squashfs(path: Path, image: Image) -> Contents:
    read = sif_format.read(path) if sif_format.is_sif(path) else None
    entries, kept = squashfs.listing(path, read.offset if read else 0, wanted)
    own = image.kind is Kind.SQUASHFS  # else it was made from an OCI image, and does not contain its variables
    variables = sif_format.variables(kept) if own else image.variables
    return Contents(
        image=replace(image, variables=variables),
        form="sif" if read else "squashfs",
        manifests={},
        config={"config": {"Env": [f"{name}={value}" for name, value in variables.items()]}} if own else {},
        labels=sif_format.labels(kept) or (read.labels if read else {}),
        packages=_packages(kept),
        recipe=read.recipe if read else "",
        created="",
        size=sum(entry.size for entry in entries),
        listing=listing(entries),
    )


def _history(config: Mapping[str, JsonView]) -> str:
    steps = config.get("history")
    lines = [str(as_object(step).get("created_by") or "") for step in steps] if isinstance(steps, list) else []
    return "\n".join(filter(None, lines))


def _keep(store: StorePaths, inside: Contents) -> Contents:
    paths = store.image(inside.image.folder)
    paths.root.mkdir(parents=True, exist_ok=True)
    write_whole(paths.files, inside.listing)
    described = {
        "format": FORMAT,
        "image": asdict(inside.image),
        **{name: getattr(inside, name) for name in (*STORED, "packages")},
        "files": sha256(inside.listing),
    }
    write_whole(paths.description, json.dumps(described, indent=2, sort_keys=True).encode())
    return inside


@contextlib.contextmanager
def _disk(folder: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise Missing(f"the contents of the image cannot be stored in {folder}: {error.strerror or error}") from error


def _time(text: str) -> datetime | None:
    with contextlib.suppress(ValueError):
        return datetime.fromisoformat(text).astimezone(UTC) if text else None
    return None


def _wanted_list(path: str) -> int:
    """Return the number of bytes of a file that `_packages` needs; 0 for a file that it does not need."""
    if path in (STATUS, APK):
        return LISTS
    return HEAD if METADATA.search(path) or (path.startswith(STATUS_D) and not path.endswith(".md5sums")) else 0


def _packages(kept: Mapping[str, bytes]) -> dict[str, tuple[str, ...]]:
    """Return sorted lines `name==version` by package manager: dpkg, apk, python."""
    by_manager: dict[str, set[str]] = {}
    for path, content in kept.items():
        for manager, line in _package_lines(path, content.decode("utf-8", "replace")):
            by_manager.setdefault(manager, set()).add(line)
    return {manager: tuple(sorted(lines)) for manager, lines in sorted(by_manager.items())}


def _package_lines(path: str, text: str) -> Iterator[tuple[str, str]]:
    if path == APK:
        yield from (("apk", line) for line in _paragraphs(text, "P:", "V:", None))
    elif path == STATUS or path.startswith(STATUS_D):
        yield from (("dpkg", line) for line in _paragraphs(text, "Package:", "Version:", "Status:"))
    else:
        header = text.replace("\r\n", "\n").split("\n\n", 1)[0]
        yield from (("python", line) for line in _paragraphs(header, "Name:", "Version:", None))


def _paragraphs(text: str, name: str, version: str, status: str | None) -> Iterator[str]:
    """Yield the name and version of each paragraph, except for packages that are marked as no longer installed."""
    for paragraph in text.split("\n\n"):
        fields: dict[str, str] = {}
        for line in paragraph.split("\n"):
            for key in (name, version, *([status] if status else [])):
                if line.startswith(key):
                    fields.setdefault(key, line.removeprefix(key).strip())
        gone = status in fields and "installed" not in fields[status].split()
        if name in fields and version in fields and not gone:
            yield f"{fields[name]}=={fields[version]}"
