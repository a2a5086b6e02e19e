"""Hand-made PTX files. Does not import pcbench."""

POINTS = [(1.0, 2.0, 3.0, 0.5), (-1.5, 0.25, 2.0, 0.75), (0.0, 0.0, 4.0, 1.0), (0.125, 0.0, 0.0, 0.0)]
IDENTITY = [(1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0), (0, 0, 0, 1)]
TURN = [(0, 1, 0, 0), (-1, 0, 0, 0), (0, 0, 1, 0), (100, 200, 10, 1)]


def scan(rows, columns=None, matrix=IDENTITY):
    """Return the text of a scan with rows of x, y, z, intensity and perhaps colours."""
    columns = columns or len(rows)
    *axes, position = [" ".join(map(repr, row[:3])) for row in matrix]
    header = [columns, len(rows) // columns, position, *axes, *(" ".join(map(repr, row)) for row in matrix)]
    return "".join(f"{line}\n" for line in [*header, *(" ".join(map(repr, row)) for row in rows)])


def corpus():
    colored = [(*row, 1, 2, 3) for row in POINTS]
    texts = {
        "one": scan(POINTS * 3, columns=4),
        "colors": scan(colored, columns=2, matrix=TURN),
        "several": scan(POINTS, matrix=TURN) + scan(colored) + scan([(0, 0, 0, 0)]),
    }
    return {name: text.encode() for name, text in texts.items()}
