"""Create the pictures of the documentation: `make gallery`, or some of them: `python docs/gallery.py city bench`."""

import os
import shlex
import sys
from pathlib import Path
from subprocess import run
from tempfile import TemporaryDirectory

import numpy as np
from PIL import Image

from pcbench import compare, read_cloud, write_cloud

HERE = Path(__file__).parent / "gallery"
CITY_IMAGES = "0014.png", "0034.png"  # from the third and the sixth circle of cameras
BENCH_CITY = " --images 20 --size 640x360 --extent 120 --rig oblique --points 200000"
BENCH_OPTIONS = (
    " --method sfm --sweep image_scale=0.25,0.5,1 --sweep upsample=false,true --sweep poses=given,solve --seeds 3"
    " --crop box:-60,-60,-100,60,60,200"
)
_NEXT_PICTURE = "new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))"
DEMO_PICTURES = (
    "reference",
    "sparse_plane_distance",
    "densified_plane_distance",
    "densified_section",
    "distribution",
)


def pcbench(command: str, folder: Path) -> None:
    """Run a command line, with FOLDER replaced by the folder."""
    run(["pcbench", *(word.replace("FOLDER", str(folder)) for word in shlex.split(command))], check=True)


def save_compressed(picture: Path, name: str) -> None:
    """Save a picture with a palette, which halves its size in the repository."""
    Image.open(picture).convert("RGB").quantize(256).save(HERE / f"{name}.png", optimize=True)


def demo(folder: Path) -> None:
    """Create the pictures of the demo's comparison."""
    pcbench("demo --out FOLDER --no-bench --quiet", folder)
    for name in DEMO_PICTURES:
        save_compressed(folder / "report" / "figures" / f"{name}.png", name)


def report(folder: Path) -> None:
    """Create pictures of the demo's report.html: light, dark with clouds side by side, and on a phone."""
    sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
    from browser import Browser  # needs Debian's chromium

    command = "pcbench demo --points 200000 --out demo --no-bench --no-figures --quiet"
    run(command.split(), check=True, cwd=folder)  # the page shows the path as given
    page, picture = folder / "demo" / "report" / "report.html", folder / "page.png"
    with Browser() as browser:
        browser.open(page, width=1180, height=2200)
        browser.screenshot(picture, whole=False)
        save_compressed(picture, "report")
        browser.open(page, width=1180, height=900, dark=True)
        browser.run("for (const id of ['view-0', 'side-by-side']) document.getElementById(id).click()")
        browser.run("document.getElementById('view-title').scrollIntoView()")
        browser.run(_NEXT_PICTURE)
        browser.screenshot(picture, whole=False)
        save_compressed(picture, "report_dark")
        browser.open(page, width=390, height=844)
        browser.screenshot(picture, whole=False)
        save_compressed(picture, "report_phone")


def view(folder: Path) -> None:
    """Create the pictures of views in three dimensions."""
    pcbench("demo --points 200000 --no-bench --no-figures --quiet --out FOLDER", folder)
    clouds = {name: folder / "clouds" / f"{name}.ply" for name in ("reference", "densified")}
    compare(clouds["reference"], clouds["densified"]).plot("densified", off_screen=True).screenshot(folder / "view.png")
    save_compressed(folder / "view.png", "view")
    pcbench("deform FOLDER/clouds/reference.ply FOLDER/clouds/densified.ply --out FOLDER/bend --quiet", folder)
    pcbench("view FOLDER/bend --screenshot FOLDER/displacements.png", folder)
    save_compressed(folder / "displacements.png", "view_displacements")


def scenes(folder: Path) -> None:
    """Create pictures of three real scenes; takes three minutes.

    `autzen_trim.las` of PDAL (airborne LiDAR), `source.ply` and `target.ply` of small_gicp (street scans), and 18 drone
    photographs of OpenDroneMap (brighton) are in the folder PCBENCH_DATA.
    """
    data = Path(os.environ.get("PCBENCH_DATA", "../shared/data")).absolute()
    cloud = read_cloud(data / "autzen" / "autzen_trim.las")
    for half, rows in zip("ab", np.array_split(np.random.default_rng(0).permutation(len(cloud)), 2), strict=True):
        write_cloud(folder / f"autzen_{half}.ply", cloud.select(np.sort(rows)))
    pcbench("compare FOLDER/autzen_a.ply FOLDER/autzen_b.ply --register none --out FOLDER/autzen -q", folder)
    save_compressed(folder / "autzen" / "figures" / "autzen_b_plane_distance.png", "scene_airborne")

    street = data / "small_gicp"
    pcbench(
        f"compare {street}/target.ply {street}/source.ply --register global --crop reference --out FOLDER/street -q",
        folder,
    )
    save_compressed(folder / "street" / "figures" / "source_plane_distance.png", "scene_street")

    photographs = f"{data}/brighton --out FOLDER/"
    pcbench(f"reconstruct mvs {photographs}fine.ply --image-scale 0.4 --write-cameras FOLDER/cameras.json -q", folder)
    pcbench(f"reconstruct mvs {photographs}coarse.ply --image-scale 0.2 --cameras FOLDER/cameras.json -q", folder)
    pcbench("compare FOLDER/fine.ply FOLDER/coarse.ply --out FOLDER/drone -q", folder)
    for name, picture in (("reference", "scene_drone"), ("coarse_plane_distance", "scene_drone_distance")):
        save_compressed(folder / "drone" / "figures" / f"{name}.png", picture)


def city(folder: Path) -> None:
    """Create a picture of two photographs of the synthetic city."""
    pcbench("synth city --out FOLDER --points 1000 --quiet", folder)
    photographs = [Image.open(folder / "images" / name).resize((720, 405)) for name in CITY_IMAGES]
    strip = Image.new("RGB", (1440, 405))
    for number, photograph in enumerate(photographs):
        strip.paste(photograph, (720 * number, 0))
    strip.save(HERE / "city.jpg", quality=85)  # PNG cannot compress sensor noise


def bench(folder: Path) -> None:
    """Create the charts of the bench and print its table."""
    pcbench("synth city --out FOLDER/city --quiet" + BENCH_CITY, folder)
    pcbench("bench FOLDER/city --reference FOLDER/city/truth/cloud.ply --out FOLDER/bench" + BENCH_OPTIONS, folder)
    save_compressed(folder / "bench" / "figures" / "speed.png", "bench")
    save_compressed(folder / "bench" / "figures" / "accuracy_completeness.png", "bench_directions")


def dense(folder: Path) -> None:
    """Create the chart of the demo's bench and print its table."""
    pcbench("demo --points 20000 --out FOLDER", folder)
    save_compressed(folder / "bench" / "figures" / "speed.png", "bench_dense")


def bend(folder: Path) -> None:
    """Create the picture of the experiment on deformation."""
    pcbench("experiment bend --out FOLDER/bend --quiet", folder)
    # No palette here: it would merge the colours of the lines.
    Image.open(folder / "bend" / "bend.png").convert("RGB").save(HERE / "bend.png", optimize=True)


def gao(folder: Path) -> None:
    """Create the pictures of the experiment on the paper and print its tables and sentences."""
    pcbench("experiment gao --cities 1 --out FOLDER/gao", folder)  # as the table of docs/paper.md
    for name in ("rings", "directions", "growth"):
        save_compressed(folder / "gao" / "figures" / f"{name}.png", f"gao_{name}")
    maps = folder / "gao" / "city_1" / "against-mvs" / "figures"
    for name in ("sparse", "splat-means", "splat-surface"):
        save_compressed(maps / f"{name}_poisson_distance.png", f"gao_{name.replace('-', '_')}")
    save_compressed(folder / "gao" / "views" / "figures" / "city_1_splat.png", "gao_views")


def stress(folder: Path) -> None:
    """Create the chart of reconstructors under errors of camera positions."""
    pcbench("stress --reconstructors --quick --only positions --out FOLDER/stress", folder)
    save_compressed(folder / "stress" / "figures" / "scores_cameras.png", "stress_positions")


def breaks(folder: Path) -> None:
    """Create the charts of all methods under stress; takes one and a half hours."""
    ours, metrics = "icp,icp-point,similarity,global,deform", "pcbench,Open3D,point-cloud-utils"
    peers = "Open3D plane,Open3D GICP,small_gicp plane,small_gicp GICP,robust ICP,KISS-Matcher"
    pcbench(f"stress --methods '{ours},{metrics},{peers}' --out FOLDER/stress", folder)
    for name in ("matrix_registration", "matrix_verdicts", "basin_start-map", "speed", "worst_1"):
        save_compressed(folder / "stress" / "figures" / f"{name}.png", f"stress_{name.replace('-', '_')}")


def tradeoff(folder: Path) -> None:
    """Create the charts of cheaper comparisons, which `benchmarks/tradeoff.py` draws beside its tables."""
    script = Path(__file__).parents[1] / "benchmarks" / "tradeoff.py"
    for pair in ("demo", "autzen", "forest"):
        run([sys.executable, script, pair, "--chart", HERE], check=True)


def main() -> None:
    """Create the pictures named on the command line, or all of them."""
    pictures = {
        "demo": demo,
        "report": report,
        "view": view,
        "scenes": scenes,
        "city": city,
        "bench": bench,
        "dense": dense,
        "bend": bend,
        "gao": gao,
        "stress": stress,
        "breaks": breaks,
        "tradeoff": tradeoff,
    }
    for name in sys.argv[1:] or pictures:
        with TemporaryDirectory() as folder:
            pictures[name](Path(folder))


if __name__ == "__main__":
    main()
