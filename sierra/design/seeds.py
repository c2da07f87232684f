"""Seeds of runs: derived from the base seed and the run's number, not drawn at random, and never repeated.

A seed is a number from 1 to 2³¹-1. It fits into an int32, which every simulator accepts. It is never 0, which for many
simulators means "choose a seed". If the run's number were hashed to 31 bits, two of 50 000 runs would almost certainly have the
same seed. Therefore the numbers are *permuted* instead. Format 1 of the permutation:

1. The key is SHA-256 of `{"base":"…","format":1,"sierra":"seeds","stream":"…"}` (`hashing.digest`; the base in
   decimal), read as eight big-endian 32-bit words.
2. x is the run's number plus 1. For each word of the key, in order: x is increased by the word, xored with
   itself shifted right by 16, and multiplied by 0x9E3779B9, all modulo 2³¹. Finally, x is xored with x >> 15.
3. If x is now 0, step 2 is repeated once, starting from that 0.

With a smaller largest seed, the key `max` of `[seed]`, the numbers have the b bits of that seed instead of 31: modulo 2ᵇ, the
shifts are b/2 rounded up, and in the end b/2 rounded down, and step 3 is repeated until x is from 1 to `max`. So the seeds of
`max = 2147483647` are those without the key.

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


def seed(base: int, number: int, stream: str = "", largest: int = LARGEST) -> int:
    """Return the seed of run `number` (from 0): 1 to `largest`, different for each number of one base and stream.

    Another `stream`, for example one per experiment, gives unrelated seeds; seeds of different streams may coincide. The values
    are a format that golden seeds pin: they never change. Raises QueryError for a base that is negative or exceeds 2**63-1, a
    number outside 0 … `largest`-1, or a stream that is not Unicode.
    """
    if not 0 <= base < 2**63:
        raise QueryError(f"a base seed must be from 0 to {2**63 - 1}, not {base}")
    if not 0 <= number < largest:
        raise QueryError(f"a run's number must be from 0 to {largest - 1}, not {number}")
    key, bits = _key(base, stream), largest.bit_length()
    permuted = _permuted(number + 1, key, bits)
    while not 0 < permuted <= largest:
        permuted = _permuted(permuted, key, bits)
    return permuted


def streams(largest: int) -> tuple[int, int]:
    """Return how many run numbers each stream of seeds has, and how many streams there are.

    Each `montecarlo` experiment has a stream of its own. Both numbers are the same for any number of runs, so that seeds stay.
    """
    width = 1 << (largest.bit_length() + 1) // 2
    return width, largest // width


@lru_cache(maxsize=1024)
def _key(base: int, stream: str) -> tuple[int, ...]:
    if any("\ud800" <= character <= "\udfff" for character in stream):
        raise QueryError(f"a stream's name must be Unicode without surrogates, not {stream!r}")
    key = bytes.fromhex(digest("seeds", {"base": str(base), "stream": stream}))
    return tuple(int.from_bytes(key[at : at + 4]) for at in range(0, len(key), 4))


def _permuted(x: int, key: tuple[int, ...], bits: int = 31) -> int:
    mask, shift = (1 << bits) - 1, (bits + 1) // 2
    for word in key:
        x = (x + word) & mask
        x = (x ^ x >> shift) * FACTOR & mask
    return x ^ x >> (bits // 2 or 1)
