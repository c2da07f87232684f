"""Videos as deliverables: how the core checks whether a video still follows from the store."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from sierra.deliverables.kinds import DeliverableKind, FilesOfPaper
from sierra.extensions.videos.prepare import VERSION
from sierra.extensions.videos.table import Video

if TYPE_CHECKING:
    from sierra.config.project_file import LoadedProject
    from sierra.deliverables.gallery import Gallery
    from sierra.deliverables.record import Deliverable
    from sierra.store.row_types import DeliverableRow
    from sierra.store.store import Store

KIND = "video"


def _content(project: LoadedProject, store: Store, row: DeliverableRow) -> Deliverable:
    from sierra.extensions.videos.render import content

    return content(project, store, row)


def _paper(name: str, video: Video, galleries: Mapping[str, Gallery]) -> FilesOfPaper:
    from sierra.extensions.videos.render import of_paper

    return of_paper(name, video, galleries)


VIDEOS = DeliverableKind("videos", Video, "make it again with: sierra video", _content, VERSION, paper=_paper)
