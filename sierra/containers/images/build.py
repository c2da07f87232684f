"""Reproducible builds of an image from a Containerfile folder: two builds give the same id.

An executable `rootfs` in the folder is run first, in a copy of the folder, with the path of the tar that it must write: the
files of a base image, made from a distribution's packages, because no registry is used. Other files that it adds to the folder,
such as wheels, are also available to the Containerfile. Then podman builds without network and without a cache. All files get
one time: SOURCE_DATE_EPOCH, or else EPOCH. Permissions do not depend on the user's umask.
"""

from __future__ import annotations

import os
import shutil
import stat
import subprocess
import tarfile
import tempfile
from pathlib import Path

from sierra.containers.images import containerfile_folder, podman_images
from sierra.containers.images.containerfile_folder import CONTAINERFILE, ROOTFS, is_recipe
from sierra.containers.images.image import Image
from sierra.containers.images.resolve import named, tag
from sierra.errors import ConfigError, Missing
from sierra.util.lazy_definitions import regex

TAR = "rootfs.tar"
EPOCH = 1700000000
ERROR = regex(r"(E: |ERROR|error|dpkg: error|.*:\d+: (fatal )?error: )")
"""The beginning of a line that reports an error: from apt, pip, dpkg or a compiler."""


def build(root: Path, name: str, *, network: bool = False) -> Image:
    """Build and tag an image from a Containerfile folder of the project, and return it. A failed build leaves nothing behind.

    `network` lets the Containerfile's commands use the network; `rootfs` always may. Raises Missing, ConfigError.
    """
    folder = (root / name).resolve()
    if not is_recipe(folder):
        raise ConfigError(f"{name} is not a Containerfile folder: there is no {CONTAINERFILE} in {folder}")
    called = tag(root, name) or name
    podman_images.program()
    epoch = _epoch()
    try:
        with tempfile.TemporaryDirectory(prefix="sierra-image-") as temporary:
            context = Path(temporary) / "context"
            shutil.copytree(folder, context, symlinks=True)
            if (context / ROOTFS).is_file():
                _run_rootfs(name, context, epoch)
            _normalize(context, epoch)
            labels = {containerfile_folder.LABEL: containerfile_folder.identity(folder)}
            podman_images.build(context, called, epoch=epoch, labels=labels, network=network)
    except (OSError, shutil.Error) as error:
        raise Missing(f"{name} cannot be built: {getattr(error, 'strerror', None) or error}") from error
    return named(root, name)


def _run_rootfs(name: str, context: Path, epoch: int) -> None:
    """Run `rootfs`, which makes the tar of the base image. Raises Missing with the reason if it fails."""
    if not os.access(context / ROOTFS, os.X_OK):
        raise ConfigError(f"{name}/{ROOTFS} is not executable, so the base cannot be made; run: chmod +x {name}/{ROOTFS}")
    target = context / TAR
    done = podman_images.run(
        [str(context / ROOTFS), str(target)],
        cwd=context,
        env={**os.environ, "SOURCE_DATE_EPOCH": str(epoch), "LC_ALL": "C.UTF-8", "TZ": "UTC"},
        stderr=subprocess.STDOUT,
        umask=0o022,
    )
    if done.returncode:
        status = f"signal {-done.returncode}" if done.returncode < 0 else f"exit status {done.returncode}"
        raise Missing(f"{name}/{ROOTFS} failed ({status}): {_why(done.stdout)}")
    if not target.is_file() or not tarfile.is_tarfile(target):
        raise Missing(f"{name}/{ROOTFS} succeeded, but wrote no tar to the path in $1")


def _why(output: str) -> str:
    """Return the line that gives the reason of a failure: one about disk space if there is one, else the first error."""
    lines = [line.strip() for line in output.splitlines() if line.strip()]
    full = next((line for line in lines if "No space left on device" in line), "")
    first = next((number for number, line in enumerate(lines) if ERROR.match(line)), len(lines) - 1)
    return full or " ".join(lines[first : first + (2 if lines[first].endswith(":") else 1)]) if lines else "it printed no error"


def _normalize(context: Path, epoch: int) -> None:
    """Give all files the same time, and the permissions that git records. podman's build copies both from the context."""
    for path in (context, *context.rglob("*")):
        if not path.is_symlink():
            path.chmod(0o755 if path.is_dir() or path.stat().st_mode & stat.S_IXUSR else 0o644)
        os.utime(path, (epoch, epoch), follow_symlinks=False)


def _epoch() -> int:
    seconds = os.environ.get("SOURCE_DATE_EPOCH", "")
    if seconds and not seconds.isdecimal():
        raise ConfigError(f"SOURCE_DATE_EPOCH is {seconds!r}; it must be seconds since 1970, for example {EPOCH}")
    return int(seconds or EPOCH)
