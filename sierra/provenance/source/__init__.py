"""The source: the code that runs are made from."""

from __future__ import annotations

from sierra.provenance.source.capture import RECORDED, SWHID, Source, capture, contents, ignored
from sierra.provenance.source.manifest import blobs, changed, holds, paths, tree_of
from sierra.provenance.source.restore import is_available, restore
from sierra.provenance.source.share_refs import share

__all__ = ["RECORDED", "SWHID", "Source", "blobs", "capture", "changed", "contents", "holds", "ignored", "is_available"]
__all__ += ["paths", "restore", "share", "tree_of"]
