"""A text of letters that stay, and of characters that deceive, as each way to show it must have it."""

from __future__ import annotations

LETTERS = "\u0645\u06cc\u200c\u062e 👩\u200d🚀 a\xa0b א\u200f"
MIXED = f"{LETTERS} \x1b[2J\x9b\u202e\u2066\ufeff"
SHOWN = rf"{LETTERS} \x1b[2J\x9b\u202e\u2066\ufeff"
