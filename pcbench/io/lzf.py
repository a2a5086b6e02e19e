"""LZF, the compression of binary_compressed PCD files. Marc Lehmann, LibLZF, 2000-2008."""

from pcbench.errors import InputError

MAX_GROWTH = 88  # three bytes make at most 264


def decompress(data: bytes, size: int) -> bytearray:
    """The `size` bytes that the compressed data stand for.

    Raises:
        InputError: they stand for more or fewer bytes, or point outside themselves.
    """
    out = bytearray()
    position, end = 0, len(data)
    try:
        while position < end:
            control = data[position]
            position += 1
            if control < 32:  # so many bytes, and one more, as they are
                out += data[position : position + control + 1]
                position += control + 1
                continue
            length = (control >> 5) + 2
            if length == 9:
                length += data[position]
                position += 1
            distance = ((control & 31) << 8) + data[position] + 1
            position += 1
            start = len(out) - distance
            if start < 0:
                raise InputError("damaged LZF data: a reference to before the first byte: export the file again")
            repeated = out[start : start + length]
            # A copy that overlaps itself repeats its bytes.
            out += repeated if length <= distance else (repeated * (length // distance + 1))[:length]
            if len(out) > size:
                break
    except IndexError:
        position = end + 1
    if position != end or len(out) != size:
        raise InputError(f"damaged LZF data: expected {size} bytes, got {len(out)}: export the file again")
    return out
