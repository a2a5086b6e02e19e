"""Net volumes of known changes by `pcbench change`, by CloudCompare's -VOLUME and by xDEM; for volumes.py.

Each runs as a separate command, so that its seconds include its start and the reading of its input. A peer that is not
installed is named.
"""

from __future__ import annotations

import json
import math
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from measure import Seconds
from process_tree import measure

from pcbench import read_cloud

MOUND_M3, MOUND_RADIUS = 1060.0, 20.0
_MOUND_PLACE = 110.0, 70.0  # from the south-west corner, in m; all cells of 2 m around it have points of both halves
_XDEM_FITS = (("Gaussian",), ("Gaussian", "Spherical"))
_OFFSCREEN = {"QT_QPA_PLATFORM": "offscreen"}


class Pair(NamedTuple):
    """Two epochs as arrays (N, 3) in m, and the exact net volume in m3 between them."""

    name: str
    before: np.ndarray
    after: np.ndarray
    net: float


class NetVolume(NamedTuple):
    """Net, fill and cut in m3 as a tool states them; the interval of the net, where it has one, and the time."""

    tool: str
    net: float
    fill: float
    cut: float
    interval: tuple[float, float] | None
    seconds: Seconds


def print_peers(data: Path, xdem_python: Path | None) -> None:
    """Print the table of all tools and pairs."""
    if not shutil.which("CloudCompare"):
        print("CloudCompare is not measured: no command CloudCompare (Debian: cloudcompare)")
    for pair in pairs(data):
        print(f"\n{pair.name}: {len(pair.before):,} and {len(pair.after):,} points, exact net {pair.net:.1f} m3")
        print(
            f"{'':60}{'net':>9}{'fill':>9}{'cut':>9}{'95 % of net':>14}{'held':>6}{'error':>8}{'wall s':>8}{'CPU s':>7}"
        )
        with tempfile.TemporaryDirectory() as folder:
            for row in net_volumes(pair, Path(folder), xdem_python):
                print(line_of(row, pair.net), flush=True)


def line_of(row: NetVolume, true: float) -> str:
    """Return the line of a table."""
    low, high = row.interval or (math.nan, math.nan)
    interval = f"[{low:.0f}, {high:.0f}]" if row.interval else "none"
    held = ("yes" if low <= true <= high else "no") if row.interval else "-"
    fill, cut = (f"{value:.1f}" if value == value else "-" for value in (row.fill, row.cut))
    return (
        f"{row.tool:60}{row.net:9.1f}{fill:>9}{cut:>9}{interval:>14}{held:>6}{row.net - true:+8.1f}"
        f"{row.seconds.wall:8.1f}{row.seconds.cpu:7.1f}"
    )


def pairs(data: Path) -> Iterator[Pair]:
    """Yield the pairs whose data are there: a made pair, and two halves of an airborne cloud with a mound on one."""
    if (data / "change").is_dir():
        before, after = (read_cloud(data / "change" / f"{name}.xyz").points for name in ("before", "after"))
        expected = json.loads((data / "change" / "expected.json").read_text())
        yield Pair("change: cone, pit and uplift", before, after, expected["net_m3"])
    path = data / "autzen" / "autzen_trim.las"
    if path.exists():
        points = read_cloud(path).points
        points = 0.3048 * (points - points.min(axis=0))  # feet
        half = np.random.default_rng(0).random(len(points)) < 0.5
        after = points[~half]
        height = 3 * MOUND_M3 / (math.pi * MOUND_RADIUS**2)
        after[:, 2] += height * np.maximum(1 - np.linalg.norm(after[:, :2] - _MOUND_PLACE, axis=1) / MOUND_RADIUS, 0)
        yield Pair("autzen: two halves, a cone on one", points[half], after, MOUND_M3)


def net_volumes(pair: Pair, folder: Path, xdem_python: Path | None) -> Iterator[NetVolume]:
    """Yield what each tool states; all use the cells that pcbench chooses."""
    files = [folder / f"{name}.xyz" for name in ("before", "after")]
    for file, points in zip(files, (pair.before, pair.after), strict=True):
        np.savetxt(file, points, fmt="%.4f")
    document = folder / "change.json"
    command = [sys.executable, "-m", "pcbench.cli", "change", *map(str, files), "--no-figures", "-q"]
    usage = measure([*command, "--json", str(document), "--out", str(folder / "report")])
    result = json.loads(document.read_text())
    volumes, cell = result["changes"][0]["whole"]["volumes"], result["grid"]["cell"]
    value, low, high = volumes["net"]
    name = f"pcbench change, cells of {cell:g} m"
    yield NetVolume(name, value, volumes["fill"][0], volumes["cut"][0], (low, high), Seconds(usage.wall, usage.cpu))
    if shutil.which("CloudCompare"):
        yield _by_cloudcompare(folder, files, pair, cell)
    for models in _XDEM_FITS if xdem_python is not None else ():
        yield _by_xdem(folder, xdem_python, models)


def _by_cloudcompare(folder: Path, files: list[Path], pair: Pair, cell: float) -> NetVolume:
    """Return CloudCompare's volume. Both files get the same shift, because it gives each its own otherwise.

    It takes the second cloud as the ground and the first as the ceiling, so that its volume has the opposite sign.
    """
    x, y, _ = (f"{-value:.0f}" for value in np.floor(pair.before.min(axis=0) / 1000) * 1000)
    command = ["CloudCompare", "-SILENT", "-NO_TIMESTAMP", "-AUTO_SAVE", "OFF"]
    for file in files:
        command += ["-O", "-GLOBAL_SHIFT", x, y, "0", str(file)]
    usage = measure([*command, "-VOLUME", "-GRID_STEP", f"{cell:g}"], _OFFSCREEN)
    report = next(folder.glob("VolumeCalculationReport*.txt")).read_text()
    volume, added, removed = (
        float(re.search(rf"{label}:\s*(?:\([+-]\))?(-?[\d.,]+)", report)[1].replace(",", ""))
        for label in ("Volume", "Added volume", "Removed volume")
    )
    return NetVolume(
        f"CloudCompare {cloudcompare_version()} -VOLUME", -volume, removed, added, None, Seconds(usage.wall, usage.cpu)
    )


def _by_xdem(folder: Path, python: Path, models: tuple[str, ...]) -> NetVolume:
    """Return xDEM's net volume and interval from the cells of pcbench."""
    out = folder / "xdem.json"
    script = Path(__file__).with_name("volumes_xdem.py")
    map_file = next((folder / "report" / "maps").glob("*.tif"))
    usage = measure([str(python), str(script), str(map_file), str(out), *models])
    result = json.loads(out.read_text())
    net, half = result["net"], result["half_width"]
    ranges = " and ".join(f"{value:.3g} m" for value in result["ranges"])
    name = f"xDEM {result['version']}, {' + '.join(models).lower().replace('gauss', 'Gauss')}: ranges {ranges}"
    return NetVolume(name, net, math.nan, math.nan, (net - half, net + half), Seconds(usage.wall, usage.cpu))


def cloudcompare_version() -> str:
    """Return the version of Debian's package, or nothing."""
    command = ["dpkg-query", "-W", "-f", "${Version}", "cloudcompare"]
    try:
        return subprocess.run(command, capture_output=True, text=True).stdout
    except OSError:
        return ""
