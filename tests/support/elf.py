"""Programs for other processors: an ELF header (elf(5)) that no kernel of this machine executes."""

from __future__ import annotations

from pathlib import Path

AARCH64, ARM, I386, X86_64 = 183, 40, 3, 62


def write(path: Path, processor: int = AARCH64) -> Path:
    """Write an executable file with the header of a program for a processor."""
    path.parent.mkdir(parents=True, exist_ok=True)
    bits = b"\1" if processor in (ARM, I386) else b"\2"
    kind, version = (2).to_bytes(2, "little"), (1).to_bytes(4, "little")
    path.write_bytes(b"\x7fELF" + bits + b"\1\1" + bytes(9) + kind + processor.to_bytes(2, "little") + version + bytes(44))
    path.chmod(0o755)
    return path
