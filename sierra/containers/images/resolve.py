"""The resolution of an image's name to the image: a tag in podman's storage, a file, or a Containerfile folder."""

from __future__ import annotations

import contextlib
import os
from dataclasses import replace
from pathlib import Path

from sierra.containers.images import image_contents, oci, podman_images, sif_format, squashfs_tools
from sierra.containers.images.containerfile_folder import CONTAINERFILE, is_recipe
from sierra.containers.images.image import Image, Kind, machine, short
from sierra.errors import ConfigError, Damaged, Missing
from sierra.provenance.hash_cache import cached_sha256
from sierra.store.layout import ProjectPaths, StorePaths
from sierra.util import processors
from sierra.util.lazy_definitions import regex
from sierra.util.processors import ARCH

TAG = "localhost/sierra/"
FOLDER = regex(r"[a-z0-9]+(?:[._-]+[a-z0-9]+)*")
SUFFIXES = (".tar", ".sif", ".sqfs", ".squashfs", ".img", ".gz", ".tgz", ".zst")


def place(root: Path, name: str) -> Path | None:
    """Return the file or folder that a name means: one that exists, or that looks like a path; None for a tag."""
    path = root / name
    if path.exists():
        return path
    return path if name.startswith(("/", "./", "../")) or name.endswith(SUFFIXES) else None


def spelled(root: Path, name: str, known: str = "") -> str:
    """Return a name in the form that a project records: `known` for the same file; a path in the project relative to its root.

    `./sim/` and `/home/me/project/sim` are both `sim`, which is the same on every machine.
    """
    path = Path(os.path.normpath(root / name))
    if not path.exists() or (known and path == Path(os.path.normpath(root / known))):
        return known if known and path.exists() else name
    return str(path.relative_to(root)) if path.is_relative_to(root) and path != root else name


def tag(root: Path, name: str) -> str | None:
    """Return the tag in podman's storage that a name means; None for a file. Raises ConfigError for a forbidden name."""
    path = place(root, name)
    if path is None:
        return name
    if not is_recipe(path):
        return None
    folder = path.resolve().name.lower()
    if not FOLDER.fullmatch(folder):
        raise ConfigError(f"the folder name {name} cannot be a tag: use letters, digits, and . _ - between them")
    return TAG + folder


def named(root: Path, name: str) -> Image:
    """Return the image that a name stands for now; `examine` reads all of it. Raises Missing, or Damaged for another file."""
    called = tag(root, name)
    if called is not None:
        return _tagged(root, name, called)
    path = place(root, name)
    assert path is not None  # noqa: S101 - a name that is not a tag is a path
    try:
        return _file(root, path, name)
    except OSError as error:
        raise Missing(f"the image {name} cannot be read: {error.strerror or error}") from error


def existing(root: Path, name: str) -> list[str]:
    """Return the names that a name with `{arch}` stands for and that name an image now; another name as it is.

    Raises Missing if there is no such image; Damaged for a file that is not an image.
    """
    if ARCH not in name:
        return [name]
    names, why = [], ""
    for candidate in (name.replace(ARCH, processor) for processor in (processors.here(), *processors.NAMES)):
        try:
            named(root, candidate)
            names.append(candidate)
        except Missing as error:
            why = why or str(error)
    if not names:
        raise Missing(f"{name} names no image for any processor: {why}")
    return list(dict.fromkeys(names))


def verify(root: Path, image: Image) -> None:
    """Check that a pinned image is `unchanged`, and can run here. Raises Missing, also for another architecture."""
    if image.architecture and image.architecture != machine():
        raise Missing(f"the image {image.name} is for {image.architecture}, but this machine is {machine()}; build it here")
    unchanged(root, image)


def unchanged(root: Path, image: Image) -> None:
    """Check that a pinned image is still the image of its name. The result is cached, so the check is cheap.

    Raises Missing, with both ids, if a file was changed or a tag moved.
    """
    if image.file:
        _verify_file(root, image)
    elif podman_images.installed():
        _verify_tag(root, image)


def _verify_file(root: Path, image: Image) -> None:
    path = root / image.file
    if path.is_dir():
        now, was = oci.read(path).id, image.id
    else:
        now, was = cached_sha256(path), image.sha256
    if now != was:
        raise Missing(
            f"the image {image.name} is not the pinned one: {path} has SHA-256 {now[:19]}…, but the pin is {was[:19]}…; "
            f"restore it, or run: sierra image pin {image.name}"
        )


def _verify_tag(root: Path, image: Image) -> None:
    called, now = tag(root, image.name), None
    with contextlib.suppress(Missing):  # podman does not work here, which does not matter if nothing needs it
        now = None if called is None else podman_images.identify(called)
    if now is not None and now != image.id:
        raise Missing(
            f"the tag of the image {image.name} has moved: it is {short(now)} now, but the pin is {short(image.id)}; "
            f"tag the pinned image again, or run: sierra image pin {image.name}"
        )


def _tagged(root: Path, name: str, called: str) -> Image:
    found = podman_images.find(called)
    if found is None:
        again = f"run: sierra image build {name}" if called != name else "build, import or pull it, or name an image file"
        raise Missing(f"the image {called!r} is not in podman's storage; {again}")
    return Image(name, found.id, found.kind, found.architecture, found.layers, found.variables)


def _file(root: Path, path: Path, name: str) -> Image:
    if not path.exists():
        raise Missing(f"the image file {path} does not exist")
    if path.is_dir():
        if not oci.is_archive(path):
            raise Missing(f"{path} is not an image: it contains neither a {CONTAINERFILE} nor an OCI layout")
        return oci.read(path).image(name, file=_file_name(root, path))
    digest, file = cached_sha256(path), _file_name(root, path)
    if sif_format.is_sif(path):
        read = sif_format.read(path)
        squashfs_tools.size(path, read.offset)
        return _of_squashfs(root, name, file, digest, read.digest(), read.architecture)
    if squashfs_tools.is_squashfs(path):
        squashfs_tools.size(path)
        return _of_squashfs(root, name, file, digest, digest, "")
    if oci.is_archive(path):
        return oci.read(path).image(name, file=file, sha256=digest)
    raise Damaged(f"{path} is not an image: it must be an archive (docker-archive, oci-archive), a SIF or a squashfs")


def _of_squashfs(root: Path, name: str, file: str, digest: str, system: str, architecture: str) -> Image:
    """Return the image whose file system has the SHA-256 `system`: a squashfs, or the OCI image that it was made from."""
    made = image_contents.made_from(StorePaths(ProjectPaths(root).store), system)
    if made is not None:
        return replace(made, name=name, file=file, sha256=digest)
    return Image(name, f"squashfs:{system}", Kind.SQUASHFS, architecture, (), {}, file, digest)


def _file_name(root: Path, path: Path) -> str:
    """Return a file's path as it is recorded: relative to the project's root if the file is inside the project."""
    return str(path.relative_to(root)) if path.is_relative_to(root) else str(path)
