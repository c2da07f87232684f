"""The transfer of images between machines: import of a checked archive, and export to a file that is checked again."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

from sierra.containers.images import image_contents, oci, podman_images, sif_format
from sierra.containers.images.image import Image, Kind, short
from sierra.containers.images.image_contents import Contents
from sierra.containers.images.pins import all_pinned
from sierra.containers.images.resolve import named, tag
from sierra.errors import Damaged, Missing, UsageError
from sierra.store.layout import StorePaths
from sierra.util.scratch import scratch

UNFINISHED = ".sierra-image-"
"""The beginning of the names of folders with unfinished images."""


def import_archive(root: Path, store: StorePaths, file: Path, name: str = "") -> Contents:
    """Import an archive: check it, load it into podman's storage, and describe it. Without podman, make its squashfs.

    `name` is the tag that it gets. By default, it gets the first of the tags that it had at its origin, unless another image
    has that tag here. Raises Missing or Damaged, and imports nothing then; UsageError if the file is not an archive.
    """
    if not file.exists():
        raise Missing(f"the image file {file} does not exist")
    if not oci.is_archive(file):
        runs = file.is_file() and image_contents.is_apptainer_image(file)
        what = "a SIF or a squashfs, which needs no import: name it in [container] image" if runs else "not an archive"
        raise UsageError(f"{file} is {what}; only docker-archive and oci-archive can be imported")
    read = oci.read(file)
    image = read.image(name or str(file), file=str(file.resolve()))
    contents = image_contents.examine_again(root, store, image, foreign=True)
    if not podman_images.installed():
        image_contents.rootfs(root, store, image)
        return contents
    podman_images.load(file, image.id)
    free = (tag for tag in read.tags[:1] if podman_images.identify(tag) in (None, read.id))
    if new := name or next(free, ""):
        podman_images.tag(image.id, new)
    return replace(contents, image=replace(contents.image, name=new or image.id, file=""))


def export(root: Path, name: str, file: Path) -> Image:
    """Write an image to a file from which the same image can be loaded elsewhere, and return it.

    A pinned image is used as pinned.

    An OCI image becomes a docker-archive, whose bytes are always the same; a SIF or a squashfs is copied. The written file is
    read again before it gets its name. Raises Missing, Damaged, UsageError.
    """
    if file.is_dir():
        raise UsageError(f"{file} is a folder; name the file to write, for example {file / 'image.tar'}")
    if not file.parent.is_dir():
        raise UsageError(f"the folder {file.parent} for {file.name} does not exist")
    image = all_pinned(root).get(name) or named(root, name)
    try:
        with scratch(file.parent, UNFINISHED) as folder:
            unfinished = folder / file.name
            _write(root, image, unfinished)
            _check(image, unfinished)
            unfinished.replace(file)
    except OSError as error:
        raise Missing(f"{file} cannot be written: {error.strerror or error}") from error
    return image


def _write(root: Path, image: Image, target: Path) -> None:
    if image.file and (root / image.file).is_file():
        shutil.copyfile(root / image.file, target)
        return
    podman_images.require(image)
    called = None if image.file else tag(root, image.name)
    is_that = called is not None and podman_images.identify(called) == image.id
    podman_images.save(called if called and is_that else image.id.removeprefix("sha256:"), target)


def _check(image: Image, path: Path) -> None:
    if image.kind == Kind.SQUASHFS or image_contents.is_apptainer_image(path):
        digest = sif_format.read(path).digest() if sif_format.is_sif(path) else ""
        same = not digest or f"squashfs:{digest}" == image.id or image.kind == Kind.OCI
    else:
        read = oci.read(path)
        read.check()
        same = read.id == image.id
    if not same:
        raise Damaged(f"the file written for {image.name} is not the image {short(image.id)}; export it again")
