"""LZF, the compression of binary_compressed PCD files. Marc Lehmann, LibLZF, 2000-2008."""

from pcbench.errors import InputError

MAX_GROWTH = 88  # three bytes make at most 264


def decompress(data: bytes, size: int) -> bytearray:
    """The `size` bytes that the compressed data stand for.

    Raises:
        InputError: they stand for more or fewer bytes, or point outside themselves.
    """
    out = bytearray()
    place, end = 0, len(data)
    try:
        while place < end:
            control = data[place]
            place += 1
            if control < 32:  # so many bytes, and one more, as they are
                out += data[place : place + control + 1]
                place += control + 1
                continue
            length = (control >> 5) + 2
            if length == 9:
                length += data[place]
                place += 1
            distance = ((control & 31) << 8) + data[place] + 1
            place += 1
            start = len(out) - distance
            if start < 0:
                raise InputError("damaged LZF data: a reference to before the first byte: export the file again")
            piece = out[start : start + length]
            # A copy that overlaps itself repeats its bytes.
            out += piece if length <= distance else (piece * (length // distance + 1))[:length]
            if len(out) > size:
                break
    except IndexError:
        place = end + 1
    if place != end or len(out) != size:
        raise InputError(f"damaged LZF data: expected {size} bytes, got {len(out)}: export the file again")
    return out
