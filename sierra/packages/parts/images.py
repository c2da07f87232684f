"""The part of a package with the container images of its runs: always digest and recipe, on request the images themselves.

Images are identified by the recorded id, and never by a name, which may stand for another image by now. Everything is checked
against this id when it is written. The bytes do not depend on the place where an image is found:

* `oci` is a docker-archive without tags, which podman, docker and apptainer read;
* `sif` is the file that apptainer runs: the recorded SIF or squashfs, or the squashfs that SIERRA makes from an OCI image.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from sierra.containers.images import podman_images, sif_format
from sierra.containers.images.containerfile_folder import LABEL, is_recipe, text
from sierra.containers.images.image import Image, Kind, of_fields, short
from sierra.containers.images.image_contents import opened, rootfs
from sierra.errors import Damaged, Missing
from sierra.packages.layout import IMAGE_FILES, IMAGES, PROJECT
from sierra.packages.members import unsafe
from sierra.packages.subject import ImageForm, Member, PartResult, Subject
from sierra.store.layout import StorePaths
from sierra.store.row_types import ImageRow
from sierra.store.store import Store
from sierra.util.hashing import sha256_file

USED = """
SELECT DISTINCT ON (image) * FROM images
WHERE image IN (SELECT image FROM specs UNION SELECT image FROM builds UNION SELECT image FROM isolations)
ORDER BY image, name, file
"""
OF_BATCH = """
SELECT DISTINCT ON (image) * FROM images
WHERE image IN (SELECT image FROM specs WHERE spec IN (SELECT spec FROM batch_runs WHERE batch = $b))
ORDER BY image, name, file
"""
DESCRIBED = ("image", "kind", "architecture", "layers", "name", "variables", "recipe", "variants")
OPTIONAL = ("variants",)
"""The columns that are only described where they have a value."""


def members(subject: Subject, packed: Mapping[str, Member]) -> PartResult:
    """Return the description of the images, their recipes, and their files if they are requested.

    Raises Missing for an image that is neither in its file nor in podman's storage, Damaged if one is not the recorded one.
    """
    rows = subject.store.select(ImageRow, USED)
    if not rows:
        return PartResult(())
    collected = [Member(IMAGES, _description(rows), "container images of the runs")]
    notes: list[str] = []
    for row in rows:
        recipe = _Recipe(subject, row)
        collected += [*recipe.members, *(() if row.variants else _files(subject, _image(row)))]
        notes += recipe.notes
    lacking = (
        "" if subject.options.image != "none" else f"container images are not packed, only described in {IMAGES}: see --image"
    )
    return PartResult(collected, notes=tuple(notes), facts=(lacking,) if lacking else ())


def check(root: Path, store: Store, batches: Iterable[str], wanted: ImageForm) -> None:
    """Raise Missing for an image of batches that is wanted, and neither in its file nor in podman's storage."""
    for batch in batches if wanted != "none" else ():
        for row in store.select(ImageRow, OF_BATCH, b=batch):
            there = row.variants or (row.file and (root / row.file).exists())
            if not there and not (row.kind == Kind.OCI and podman_images.holds(row.image)):
                raise _gone(root / (row.file or row.name or ""), row.image)


def _gone(path: Path, image: str) -> Missing:
    return Missing(f"the image file {path} no longer exists, and podman does not have {short(image)}; restore it")


def _description(rows: Sequence[ImageRow]) -> bytes:
    """Return the recorded ids, layers and recipes of images as JSON."""
    fields = [{name: getattr(row, name) for name in DESCRIBED if name not in OPTIONAL or getattr(row, name)} for row in rows]
    return (json.dumps(fields, indent=2, ensure_ascii=False) + "\n").encode()


class _Recipe:
    """The folder from which an image was built, if its name is that of a Containerfile folder in the project."""

    def __init__(self, subject: Subject, row: ImageRow) -> None:
        root, name = subject.project.root, row.name or ""
        folder = root / name
        self.members: list[Member] = []
        self.notes: list[str] = []
        if not name or not is_recipe(folder) or not folder.resolve().is_relative_to(root.resolve()):
            return
        if not text(folder, json.loads(row.labels or "{}").get(LABEL, "")):
            self.notes.append(f"the files in {name} are not those of which the image {short(row.image)} was built")
        for path in sorted(path for path in folder.rglob("*") if path.is_file() and not path.is_symlink()):
            member = PROJECT + path.relative_to(root).as_posix()
            if reason := unsafe(member):
                self.notes.append(f"{member!a} is not packed: {reason}")
            else:
                executable = bool(path.stat().st_mode & 0o100)
                self.members.append(Member(member, path, "recipe of a container image", executable=executable))


def _image(row: ImageRow) -> Image:
    """Return a recorded image. Raises Damaged if its record is wrong."""
    variables = json.loads(row.variables or "{}")
    text_fields = {"id": row.image, "architecture": row.architecture or "", "file": row.file or "", "sha256": row.sha256 or ""}
    try:
        return of_fields(row.name or row.image, {**text_fields, "kind": row.kind, "layers": row.layers, "variables": variables})
    except (LookupError, TypeError, ValueError) as error:
        raise Damaged(f"the record of the image {row.image} is wrong: {error}") from error


def _files(subject: Subject, image: Image) -> Iterator[Member]:
    """Yield an image in the requested forms. A squashfs has one form only."""
    wanted = subject.options.image
    name = f"{IMAGE_FILES}{image.folder}"
    folder = subject.folder / "images"
    if image.kind is Kind.OCI and wanted in ("oci", "both"):
        folder.mkdir(exist_ok=True)
        yield Member(
            f"{name}.tar", _archive(subject, image, folder / f"{image.folder}.tar"), "container image, for podman load"
        )
    if wanted in ("sif", "both") or (image.kind is Kind.SQUASHFS and wanted != "none"):
        path = _squashfs(subject, image, StorePaths(folder))
        suffix = "sif" if sif_format.is_sif(path) else "sqfs"
        yield Member(f"{name}.{suffix}", path, "container image, for apptainer")


def _archive(subject: Subject, image: Image, path: Path) -> Path:
    """Write an OCI image as a docker-archive, of which all data is checked."""
    with opened(subject.project.root, StorePaths(path.parent), _located(subject, image)) as read, path.open("wb") as out:
        read.write(out)
    return path


def _squashfs(subject: Subject, image: Image, scratch: StorePaths) -> Path:
    """Return the file that apptainer runs. Raises Missing or Damaged unless it is the recorded image."""
    root = subject.project.root
    path = rootfs(root, scratch, _located(subject, image))
    if image.file and path == root / image.file and sha256_file(path) != image.sha256:
        digest = sif_format.read(path).digest() if sif_format.is_sif(path) else sha256_file(path)
        if f"squashfs:{digest}" != image.id:
            raise Damaged(f"{path} is not the recorded image {short(image.id)}; restore it")
    return path


def _located(subject: Subject, image: Image) -> Image:
    """Return the image with its current location: its recorded file, else podman's storage."""
    path = subject.project.root / image.file
    if not image.file or (path.exists() and (path.is_dir() or sha256_file(path) == image.sha256)):
        return image
    if image.kind is Kind.OCI and podman_images.holds(image.id):
        return replace(image, file="")
    if not path.exists():
        raise _gone(path, image.id)
    return image
