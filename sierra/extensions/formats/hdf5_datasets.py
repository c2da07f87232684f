"""The reader of HDF5 files, in long form: a row for each element of a dataset, with its indices.

`rows` is the path of a dataset, or of a group whose datasets have the same shape: each is a column. Fields of compound types
are columns too. A dataset that was not written completely is refused, because HDF5 would give its fill value for the rest. Only
the file itself is read: external links, external storage and virtual datasets, which name other files, are refused. The number
of rows follows a second time from the extents of the datasets in the file.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from sierra.extensions.formats.columnar import Columnar
from sierra.extensions.formats.numpy_arrays import INDICES, fields_of, plain
from sierra.ingest.base import UnreadableError
from sierra.ingest.rewriting import OriginalFile

if TYPE_CHECKING:
    import h5py
    import numpy as np
    import pyarrow as pa

MAGIC = b"\x89HDF\r\n\x1a\n"
LARGEST = 1 << 30
"""The limit on the bytes of one dataset, of one chunk of it, and of its indices: a small file can name huge ones."""
LINKS = 32


class Hdf5Datasets(Columnar):
    """The reader of HDF5 files."""

    def table(self, source: OriginalFile) -> pa.Table:
        import numpy as np
        import pyarrow as pa

        with opened(source) as file:
            datasets = _datasets(file, self.shape.form.rows)
            size = _size(datasets)
            columns = fields_of({name: values(dataset) for name, dataset in datasets.items()})
        places = np.indices(size).reshape(len(size), -1) if size else ()
        indices = dict(zip(INDICES, places, strict=False))
        if twice := sorted(indices.keys() & columns.keys()):
            raise UnreadableError(f"the dataset {twice[0]!r} has the name of an index")
        self.shape = replace(self.shape, places=tuple(indices))
        return pa.table(indices | {name: plain(name, array) for name, array in columns.items()})

    def count(self, source: OriginalFile, written: int) -> int:
        with opened(source) as file:
            extents = {dataset.id.get_space().get_simple_extent_npoints() for dataset in _datasets(file, self.rows).values()}
        if len(extents) > 1:
            raise UnreadableError(f"its datasets have {min(extents)} to {max(extents)} elements")
        return int(next(iter(extents), 0))

    @property
    def rows(self) -> str:
        return self.shape.form.rows


@contextmanager
def opened(source: OriginalFile) -> Iterator[h5py.File]:
    """Open an HDF5 file for reading. Raises UnreadableError for all errors of HDF5."""
    import h5py

    with tempfile.TemporaryDirectory(prefix="sierra-") as folder:
        path = source.path
        if source.compressed:
            path = Path(folder, "plain.h5")
            path.write_bytes(source.content())
        if not path.stat().st_size:
            raise UnreadableError("is empty")
        try:
            with h5py.File(path, "r", locking=False) as file:
                yield file
        except (
            OSError,
            RuntimeError,
            KeyError,
            TypeError,
            ValueError,
            MemoryError,
            NotImplementedError,
            OverflowError,
        ) as error:
            if isinstance(error, UnreadableError):
                raise
            raise UnreadableError(f"is truncated, damaged, or not HDF5 ({' '.join(str(error).split())})") from error


def _datasets(file: h5py.File, path: str) -> Mapping[str, h5py.Dataset]:
    """Return the dataset at a path, or those in the group there, by name. Raises UnreadableError."""
    import h5py

    node = resolve(file, path)
    if isinstance(node, h5py.Dataset):
        return {path.rstrip("/").rpartition("/")[2]: node}
    inner = {name: resolve(file, f"{node.name.rstrip('/')}/{name}") for name in node}
    datasets = {name: member for name, member in inner.items() if isinstance(member, h5py.Dataset)}
    if not datasets:
        raise UnreadableError(f"the group {path!r} has no dataset; it has {', '.join(map(repr, inner)) or 'nothing'}")
    return datasets


def resolve(file: h5py.File, path: str, links: int = LINKS) -> h5py.Dataset | h5py.Group:
    """Return the object at a path; follow only links within the file. Raises UnreadableError."""
    import h5py

    node: h5py.Group = file
    names = [name for name in path.split("/") if name]
    for number, name in enumerate(names):
        link = node.get(name, getlink=True) if isinstance(node, h5py.Group) else None
        if link is None:
            known = f"; {node.name!r} has {', '.join(map(repr, list(node)[:10])) or 'nothing'}" if links and number == 0 else ""
            raise UnreadableError(f"has no {path!r}{known}")
        if isinstance(link, h5py.ExternalLink):
            raise UnreadableError(f"{path!r} is a link to another file, {link.filename!r}, which is not read")
        if isinstance(link, h5py.SoftLink):
            if not links:
                raise UnreadableError(f"{path!r} is a link to itself")
            target = link.path if link.path.startswith("/") else f"{node.name}/{link.path}"
            return resolve(file, "/".join([target, *names[number + 1 :]]), links - 1)
        node = node[name]
    return node


def _size(found: Mapping[str, h5py.Dataset]) -> tuple[int, ...]:
    """Return the shape of all of these datasets. Raises UnreadableError if they differ, or are not written completely."""
    shapes = {name: check(name, dataset) for name, dataset in found.items()}
    first, size = next(iter(shapes.items()))
    for name, shape in shapes.items():
        if shape != size:
            raise UnreadableError(f"the dataset {name!r} has the shape {shape}, but {first!r} has {size}")
    if len(size) > len(INDICES):
        raise UnreadableError(f"has {len(size)} dimensions; {len(INDICES)} is the maximum")
    return size


def check(name: str, dataset: h5py.Dataset, *, filled: bool = False) -> tuple[int, ...]:
    """Return the shape of a dataset that can be read. Raises UnreadableError if it cannot.

    `filled`: parts that were not written are marked by the fill value.
    """
    if dataset.shape is None:
        raise UnreadableError(f"the dataset {name!r} has no dataspace")
    if dataset.is_virtual or dataset.external:
        raise UnreadableError(f"the dataset {name!r} is stored in other files, which are not read")
    shape = tuple(map(int, dataset.shape))
    lengths: tuple[int, ...] = tuple(dataset.chunks or (0,))
    width: int = dataset.dtype.itemsize
    elements, in_chunk = math.prod(shape), math.prod(lengths)
    if max(elements * max(width, 8 * len(shape)), in_chunk * width) > LARGEST:
        raise UnreadableError(f"the dataset {name!r} of shape {shape}, or a chunk of it, is larger than {LARGEST >> 20} MiB")
    if not filled and elements and not _is_written(dataset, shape):
        raise UnreadableError(f"the dataset {name!r} was not written completely; resize it to what was written")
    return shape


def _is_written(dataset: h5py.Dataset, shape: tuple[int, ...]) -> bool:
    """Check that the file has all parts of a dataset."""
    if dataset.chunks is None:
        return bool(dataset.id.get_storage_size())
    parts: list[int] = [-(-length // chunk) for length, chunk in zip(shape, dataset.chunks, strict=True)]
    needed = math.prod(parts)
    return bool(dataset.id.get_num_chunks() >= needed)


def values(dataset: h5py.Dataset) -> np.ndarray:
    """Return the elements of a dataset; names stand for the numbers of an enumeration. Raises UnreadableError."""
    import h5py
    import numpy as np

    name = dataset.name
    if h5py.check_string_dtype(dataset.dtype) is not None:
        try:
            texts = dataset.asstr()[()]
        except UnicodeDecodeError as error:
            raise UnreadableError(f"the dataset {name!r} has texts that are not UTF-8") from error
        return np.array(texts, dtype="U")
    known = h5py.check_enum_dtype(dataset.dtype)
    array: np.ndarray = dataset[()]
    array = np.asarray(array)
    if known is None or array.dtype.kind == "b":
        return array
    named = {number: text for text, number in known.items()}
    try:
        return np.array([named[number] for number in array.reshape(-1).tolist()], dtype="U").reshape(array.shape)
    except KeyError as error:
        raise UnreadableError(f"the dataset {name!r} has {error}, which its enumeration does not name") from error
