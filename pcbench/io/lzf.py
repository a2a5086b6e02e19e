"""Decompress LZF, used by binary_compressed PCD files. Marc Lehmann, LibLZF, 2000-2008."""

from pcbench.errors import InputError

MAX_GROWTH = 88  # three bytes expand to at most 264


def decompress(data: bytes, size: int) -> bytearray:
    """Decompress data to exactly `size` bytes.

    Raises:
        InputError: the data decompress to another size or refer to bytes outside the output.
    """
    out = bytearray()
    position, end = 0, len(data)
    try:
        while position < end:
            control = data[position]
            position += 1
            if control < 32:  # literal run of control + 1 bytes
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
                raise InputError("damaged LZF data: a back reference before the first byte: export the file again")
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
