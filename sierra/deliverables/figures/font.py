"""The font of figures: the letters of DejaVu Sans that figures use most, in a small file.

A PDF file embeds the letters that it uses, and matplotlib reads the complete font to take them from it. With all 6,000 letters
of DejaVu Sans this takes 0.1 s for each figure; with 1,000 letters, and kerning in its old, simple table, 0.007 s. The letters
look the same, and their distances are the same, but there are no ligatures: `fi` stays two letters, as people search for it.
Other letters come from DejaVu Sans itself, which matplotlib brings along; and those that it lacks, such as Chinese ones, from
the fonts of the machine.

`python -m sierra.deliverables.figures.font` writes the file again, for example for a new version of matplotlib.
"""

from __future__ import annotations

import io
import unicodedata
from collections.abc import Mapping
from contextlib import suppress
from functools import cache
from pathlib import Path

from matplotlib import get_data_path
from matplotlib.font_manager import findSystemFonts, fontManager, get_font

FILE = Path(__file__).with_name("DejaVuSansSubset.ttf")
FAMILY = "DejaVu Sans Subset"
WHOLE = "fonts/ttf/DejaVuSans.ttf"
"""The complete font, in matplotlib's folder of data."""
LETTERS = (
    range(0x20, 0x7F),  # ASCII
    range(0xA0, 0x180),  # Latin with accents
    range(0x370, 0x400),  # Greek
    range(0x400, 0x460),  # Cyrillic
    range(0x2010, 0x2040),  # dashes, quotation marks, …
    range(0x2070, 0x20A0),  # superscripts and subscripts
    range(0x2190, 0x2300),  # arrows and mathematics
)
REGULAR = ("Regular", "Book", "Normal", "Roman", "Medium")
FAMILY_NAMES = (1, 4, 16)
"""The entries of a font's table of names from which matplotlib takes the family."""


@cache
def register() -> None:
    """Make matplotlib know the font; once for each process."""
    fontManager.addfont(FILE)


def others(text: str) -> tuple[list[str], list[str]]:
    """Return the families of the machine's fonts for the letters of a text that DejaVu Sans lacks, and letters without a font.

    Each family is that of the font with the most of these letters.
    """
    common = {code for codes in LETTERS for code in codes}
    lacking = {ord(letter) for letter in text if ord(letter) not in common and unicodedata.category(letter)[0] not in "CZ"}
    families: list[str] = []
    if lacking:
        lacking -= get_font(str(Path(get_data_path(), WHOLE))).get_charmap().keys()
    while lacking and (known := _known()):
        best = max(known, key=lambda path: len(lacking & known[path]))
        if not lacking & known[best]:
            break
        lacking -= known[best]
        fontManager.addfont(best)
        families.append(get_font(best).family_name)
    return families, [chr(code) for code in sorted(lacking)]


@cache
def _known() -> Mapping[str, frozenset[int]]:
    """Return the characters of each regular font of the machine, by its path."""
    characters = {}
    for path in sorted(findSystemFonts()):
        with suppress(OSError, RuntimeError):
            font = get_font(path)
            if font.style_name in REGULAR:
                characters[path] = frozenset(font.get_charmap())
    return characters


def made() -> bytes:
    """Return the content of the file, from the complete font; with its notices of copyright."""
    from fontTools import subset

    options = subset.Options(glyph_names=True, name_IDs=["*"], notdef_outline=True)
    options.drop_tables += ["FFTM", "MATH"]  # when it was made; the layout of formulas
    options.drop_tables += ["GDEF", "GPOS", "GSUB"]  # taking letters from them takes longer than all else
    options.legacy_kern = True
    with subset.load_font(str(Path(get_data_path(), WHOLE)), options) as font:
        subsetter = subset.Subsetter(options)
        subsetter.populate(unicodes=[code for codes in LETTERS for code in codes])
        subsetter.subset(font)
        font.recalcTimestamp = False
        for entry in font["name"].names:
            if entry.nameID in FAMILY_NAMES:
                entry.string = FAMILY
        buffer = io.BytesIO()
        font.save(buffer, reorderTables=False)
    return buffer.getvalue()


if __name__ == "__main__":
    FILE.write_bytes(made())
