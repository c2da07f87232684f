"""Seeds of runs: derived from the base seed and the run's number, not drawn at random, and never repeated.

A seed is a number from 1 to 2³¹-1. It fits into an int32, which every simulator accepts. It is never 0, which for many
simulators means "choose a seed". If the run's number were hashed to 31 bits, two of 50 000 runs would almost certainly have the
same seed. Therefore the numbers are *permuted* instead. Format 1 of the permutation:

1. The key is SHA-256 of `{"base":"…","format":1,"sierra":"seeds","stream":"…"}` (`hashing.digest`; the base in
   decimal), read as eight big-endian 32-bit words.
2. x is the run's number plus 1. For each word of the key, in order: x is increased by the word, xored with
   itself shifted right by 16, and multiplied by 0x9E3779B9, all modulo 2³¹. Finally, x is xored with x >> 15.
3. If x is now 0, step 2 is repeated once, starting from that 0.

Each operation of step 2 is invertible modulo 2³¹ (addition, an odd factor, xor with the number's own higher bits), so step 2 is
a bijection of 0 … 2³¹-1. Step 3 walks the cycle past 0, and no number starts from 0, so the result is a bijection of
1 … 2³¹-1. So runs 0 to 7 keep their seeds for any number of further runs. Eight rounds spread each bit of the number over all
bits of the seed, so that neighbouring numbers get unrelated seeds. It is not a cipher: the next seed can be guessed.

Sources: Black and Rogaway, "Ciphers with Arbitrary Finite Domains" (2002), for walking the cycle; Knuth, "The Art of
Computer Programming" 3, section 6.4, for the factor, 2³² over the golden ratio. Golden seeds in
`tests/unit/design/test_seeds.py` pin the format.
"""

from __future__ import annotations

from functools import lru_cache

from sierra.errors import QueryError
from sierra.util.hashing import digest

LARGEST = 2**31 - 1
"""The largest seed, and also the number of different seeds."""
FACTOR = 0x9E3779B9


def seed(base: int, number: int, stream: str = "") -> int:
    """Return the seed of run `number` (from 0): 1 to 2**31-1, different for each number of one base and stream.

    Another `stream`, for example one per experiment, gives unrelated seeds; seeds of different streams may coincide. The values
    are a format that golden seeds pin: they never change. Raises QueryError for a base that is negative or exceeds 2**63-1, a
    number outside 0 … 2**31-2, or a stream that is not Unicode.
    """
    if not 0 <= base < 2**63:
        raise QueryError(f"a base seed must be from 0 to {2**63 - 1}, not {base}")
    if not 0 <= number < LARGEST:
        raise QueryError(f"a run's number must be from 0 to {LARGEST - 1}, not {number}")
    key = _key(base, stream)
    return _permuted(number + 1, key) or _permuted(0, key)


@lru_cache(maxsize=1024)
def _key(base: int, stream: str) -> tuple[int, ...]:
    if any("\ud800" <= character <= "\udfff" for character in stream):
        raise QueryError(f"a stream's name must be Unicode without surrogates, not {stream!r}")
    key = bytes.fromhex(digest("seeds", {"base": str(base), "stream": stream}))
    return tuple(int.from_bytes(key[at : at + 4]) for at in range(0, len(key), 4))


def _permuted(x: int, key: tuple[int, ...]) -> int:
    for word in key:
        x = (x + word) & LARGEST
        x = (x ^ x >> 16) * FACTOR & LARGEST
    return x ^ x >> 15
