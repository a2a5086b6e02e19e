"""Hand-made LAS files, packed with struct; LAZ through lazrs. Does not import pcbench."""

import io
import struct

RECORDS = {  # layout of a point per format, without waveforms
    0: "<3iHBBbBH",
    1: "<3iHBBbBHd",
    2: "<3iHBBbBH3H",
    3: "<3iHBBbBHd3H",
    6: "<3iHBBBBhHd",
    7: "<3iHBBBBhHd3H",
    8: "<3iHBBBBhHd4H",
}
SCALES, OFFSETS = (0.01, 0.001, 0.5), (500_000.0, 4_000_000.25, -100.0)


def integers(i):
    return 1000 * i - 7, 2**31 - 1 - i, -(2**31) + 3 * i


def values(form, i, color=256):
    """Pack point i: its class alternates between 2 and 6, its return cycles through 1, 2 and 3 of 3."""
    return_number, return_count, classification = i % 3 + 1, 3, 2 if i % 2 else 6
    if form < 6:
        row = [*integers(i), 100 + i, return_number | return_count << 3, classification, -5, 9, 40 + i]
        row += [i + 0.25] if form in (1, 3) else []
    else:
        row = [*integers(i), 100 + i, return_number | return_count << 4, 0, classification, 9, -500, 40 + i, i + 0.25]
    if form in (2, 3, 7, 8):
        row += [color * (i % 200), color * 7, color * 255]
    return [*row, 5] if form == 8 else row


def vlr(user, number, data, extended=False):
    return struct.pack("<H16sHQ32s" if extended else "<H16sHH32s", 0, user, number, len(data), b"") + data


def wkt(text):
    return vlr(b"LASF_Projection", 2112, text.encode() + b"\0")


def geo_keys(**keys):
    """Pack GeoTIFF keys; the value of `unit_size` is the position and the count of its numbers in `geo_doubles`."""
    names = {"model": 1024, "geographic": 2048, "projected": 3072, "unit": 3076, "unit_size": 3077, "vertical": 4096}
    names["vertical_unit"] = 4099
    entries = b"".join(
        struct.pack("<4H", names[name], 34736, value[1], value[0]) if isinstance(value, tuple)
        else struct.pack("<4H", names[name], 0, 1, value)
        for name, value in keys.items()
    )  # fmt: skip
    return vlr(b"LASF_Projection", 34735, struct.pack("<4H", 1, 1, 0, len(keys)) + entries)


def geo_doubles(*numbers):
    return vlr(b"LASF_Projection", 34736, struct.pack(f"<{len(numbers)}d", *numbers))


def extra(name, kind, options=0, no_data=b"", scale=0.0, offset=0.0):
    data = struct.pack("<2sBB32s4s24s24s24s3d3d32s", b"", kind, options, name, b"", no_data, b"", b"",
                       scale, scale, scale, offset, offset, offset, b"")  # fmt: skip
    return data


def extras(*descriptions):
    return vlr(b"LASF_Spec", 4, b"".join(descriptions))


def las(form=0, count=10, minor=None, vlrs=(), evlrs=(), tail=lambda i: b"", compress=None, **replaced):
    """Build a file: `tail` gives the extra bytes of a point; `compress` is None, "chunks" or "variable" (COPC).

    Its points are `values(form, i)` for i from 0 to `count` - 1, or for `indices`.
    """
    minor = (4 if form >= 6 else 2) if minor is None else minor
    indices = replaced.get("indices", range(count))
    count = len(indices)
    points = b"".join(struct.pack(RECORDS[form], *values(form, i, replaced.get("color", 256))) + tail(i)
                      for i in indices)  # fmt: skip
    record_bytes = struct.calcsize(RECORDS[form]) + len(tail(0))
    header_bytes = {3: 235, 4: 375}.get(minor, 227)
    laszip = None
    if compress:
        import lazrs

        laszip = lazrs.LazVlr.new_for_compression(form, len(tail(0)), compress == "variable")
        vlrs = [*vlrs, vlr(b"laszip encoded", 22204, bytes(laszip.record_data()))]
    start = header_bytes + sum(map(len, vlrs))
    if compress == "chunks":
        points = compress_points(points, laszip, start)
    elif compress:
        first_chunk_bytes = len(points) // record_bytes // 3 * record_bytes
        points = compress_points([points[:first_chunk_bytes], points[first_chunk_bytes:]], laszip, start)
    stated_count = replaced.get("stated_count", count)
    block = struct.pack("<4sHH16sBB32s32sHHHIIBHI5I3d3d6d", b"LASF", 0, 0, b"", 1, minor, b"by hand", b"", 1, 2024,
                        header_bytes, start, len(vlrs), form | (128 if compress else 0), record_bytes,
                        stated_count if minor < 4 else 0, 0, 0, 0, 0, 0,
                        *replaced.get("scales", SCALES), *replaced.get("offsets", OFFSETS), *[0.0] * 6)  # fmt: skip
    if minor == 3:
        block += bytes(8)
    if minor == 4:
        block += struct.pack("<QQIQ15Q", 0, start + len(points) if evlrs else 0, len(evlrs), stated_count, *[0] * 15)
    return b"".join([block, *vlrs, points, *evlrs])


def compress_points(points, laszip, start):
    import lazrs

    buffer = io.BytesIO(bytes(start))
    buffer.seek(start)
    compressor = lazrs.LasZipCompressor(buffer, laszip)
    if isinstance(points, list):
        compressor.compress_chunks(points)
    else:
        compressor.compress_many(points)
    compressor.done()
    return buffer.getvalue()[start:]


def copc(count=300, form=7):
    """Build a COPC file with two chunks; its hierarchy, which pcbench does not read, is empty."""
    info, hierarchy = vlr(b"copc", 1, bytes(160)), vlr(b"copc", 1000, bytes(96), extended=True)
    return las(form, count, vlrs=[info], evlrs=[hierarchy], compress="variable")


UTM = (
    'PROJCS["WGS 84 / UTM zone 17N",GEOGCS["WGS 84",DATUM["WGS_1984",SPHEROID["WGS 84",6378137,298.257223563]],'
    'PRIMEM["Greenwich",0],UNIT["degree",0.0174532925199433]],PROJECTION["Transverse_Mercator"],'
    'PARAMETER["latitude_of_origin",0],PARAMETER["central_meridian",-81],PARAMETER["scale_factor",0.9996],'
    'PARAMETER["false_easting",500000],PARAMETER["false_northing",0],UNIT["metre",1],AUTHORITY["EPSG","32617"]]'
)


def corpus():
    """Return valid uncompressed files of all variants, as name -> bytes."""
    descriptions = extras(extra(b"height", 9), extra(b"count", 3, 8 | 16, b"", 0.5, 10.0), extra(b"", 0, 2))
    files = {f"format {form}": las(form, 20) for form in RECORDS}
    files |= {f"1.{minor}": las(1, 12, minor=minor, vlrs=[geo_keys(model=1, projected=32617)]) for minor in range(5)}
    files["extra bytes"] = las(3, 9, vlrs=[descriptions], tail=lambda i: struct.pack("<fHxx", i / 4, i))
    files["wkt"] = las(7, 9, vlrs=[wkt(UTM), vlr(b"other", 9, b"1234")])
    units = geo_keys(projected=32767, unit=32767, unit_size=(0, 1), vertical_unit=9003)
    files["units"] = las(0, 9, vlrs=[units, geo_doubles(0.3048)])
    files["height unit"] = las(0, 9, vlrs=[geo_keys(projected=26917, unit=9003, vertical=5703, vertical_unit=9002)])
    files["extended"] = las(6, 9, evlrs=[vlr(b"LASF_Projection", 2112, UTM.encode(), extended=True)])
    return files


def laz_corpus():
    descriptions = extras(extra(b"height", 9))
    files = {f"format {form}": las(form, 300, compress="chunks") for form in RECORDS}
    files["extra bytes"] = las(7, 99, vlrs=[descriptions], tail=lambda i: struct.pack("<f", i / 4), compress="chunks")
    files["variable"] = las(7, 300, compress="variable", vlrs=[wkt(UTM)])
    files["copc"] = copc()
    return files
