"""Container images of a project."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

from sierra.api.noun import Noun
from sierra.containers import images
from sierra.errors import UsageError
from sierra.store.layout import StorePaths
from sierra.store.store import Store
from sierra.util import processors
from sierra.util.processors import ARCH

if TYPE_CHECKING:
    from sierra.containers.images.image import Image
    from sierra.containers.images.image_contents import Contents
    from sierra.containers.images.listing import Known


class Images(Noun):
    """Container images: `project.images`."""

    def pin(self, name: str | None = None) -> Contents:
        """Pin the image that a name (default: `[container] image`) refers to now in `sierra.lock`; return its content.

        For a name with `{arch}`, this pins the image for this machine's processor: see `pin_all`. Raises Missing if there is no
        image of that name, Damaged if its content does not match its hash; it pins nothing then.
        """
        return images.pin(self._project.root, Store.create(self._project.paths.store).paths, self._image(name))

    def pin_all(self, name: str | None = None) -> list[Contents]:
        """Pin the images for all processors that a name with `{arch}` refers to; of another name, its only image.

        Raises as `pin`, and Missing if there is an image for no processor.
        """
        store = Store.create(self._project.paths.store).paths
        return [images.pin(self._project.root, store, image) for image in images.existing(self._project.root, self.name(name))]

    def build(self, name: str | None = None, *, network: bool = False) -> Image:
        """Build an image from a Containerfile folder of the project, and return it. This does not pin it."""
        from sierra.containers.images import build

        return build.build(self._project.root, self._image(name), network=network)

    def import_archive(self, file: str | os.PathLike[str], name: str = "") -> Contents:
        """Import an image's archive after checking it, and return the image's content.

        If podman is available, the image goes into podman's storage, with the tag `name`.
        """
        from sierra.containers.images import import_export

        return import_export.import_archive(self._project.root, Store.create(self._project.paths.store).paths, Path(file), name)

    def export(self, name: str | None, file: str | os.PathLike[str]) -> Image:
        """Write an image, as it is pinned, to a file. Loading that file elsewhere gives the same image."""
        from sierra.containers.images import import_export

        return import_export.export(self._project.root, self._image(name), Path(file))

    def contents(self, name: str | None = None) -> Contents:
        """Return the content of an image: of the pinned image, otherwise of the image that the name refers to now."""
        name = self._image(name)
        image = images.all_pinned(self._project.root).get(name) or images.named(self._project.root, name)
        return images.examine(self._project.root, Store.create(self._project.paths.store).paths, image)

    def known(self) -> list[Known]:
        """Return the images that the project knows, and where they are: see `sierra.containers.images.listing.Known`."""
        from sierra.containers.images import listing

        named = [self._image(None)] if self._project.config.container else []
        return listing.listing(self._project.root, StorePaths(self._project.paths.store), named)

    def _image(self, name: str | None) -> str:
        """Return the name of an image as `name` does, with this machine's processor in the place of `{arch}`."""
        return self.name(name).replace(ARCH, processors.here())

    def name(self, name: str | None) -> str:
        """Return the given name of an image in the project's spelling; without one, the name of the project's image.

        Raises UsageError if there is neither.

        >>> project.images.name("docker.io/library/debian:12")
        'docker.io/library/debian:12'
        """
        from sierra.containers.images import resolve

        own = self._project.config.container.image if self._project.config.container else ""
        if name is None and not own:
            raise UsageError(f'{self._loaded.file} names no image; give the name of an image, or set [container] image = "…"')
        return resolve.spelled(self._project.root, name, own) if name else own
