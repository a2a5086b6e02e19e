"""Make the pictures of the README and of these pages: `make gallery`, or some: `python docs/gallery.py city bench`."""

import sys
from pathlib import Path
from subprocess import run
from tempfile import TemporaryDirectory

from PIL import Image

HERE = Path(__file__).parent / "gallery"
CITY = "0014.png", "0034.png"  # of the third circle, and of the sixth
BENCHED = " --images 20 --size 640x360 --extent 120 --rig oblique --points 200000"
BUDGETS = (
    " --method sfm --sweep image_scale=0.25,0.5,1 --sweep upsample=false,true --sweep poses=given,solve --seeds 3"
    " --crop box:-60,-60,-100,60,60,200"
)
SHOWN = ("reference", "sparse_plane_distance", "densified_plane_distance", "distribution")


def pcbench(command: str, folder: Path) -> None:
    """Run a command as it would be typed, FOLDER standing for the folder."""
    run(["pcbench", *(word.replace("FOLDER", str(folder)) for word in command.split())], check=True)


def small(picture: Path, name: str) -> None:
    # A palette halves what a repository has to carry for ever.
    Image.open(picture).convert("RGB").quantize(128).save(HERE / f"{name}.png", optimize=True)


def demo(folder: Path) -> None:
    pcbench("demo --out FOLDER --no-bench --quiet", folder)
    for name in SHOWN:
        small(folder / "report" / "figures" / f"{name}.png", name)


def city(folder: Path) -> None:
    pcbench("synth city --out FOLDER --points 1000 --quiet", folder)
    photographs = [Image.open(folder / "images" / name).resize((720, 405)) for name in CITY]
    strip = Image.new("RGB", (1440, 405))
    for number, photograph in enumerate(photographs):
        strip.paste(photograph, (720 * number, 0))
    strip.save(HERE / "city.jpg", quality=85)  # a sensor's noise is what PNG cannot shrink


def bench(folder: Path) -> None:
    """Prints the table that goes with the charts."""
    pcbench("synth city --out FOLDER/city --quiet" + BENCHED, folder)
    pcbench("bench FOLDER/city --reference FOLDER/city/truth/cloud.ply --out FOLDER/bench" + BUDGETS, folder)
    small(folder / "bench" / "figures" / "speed.png", "bench")
    small(folder / "bench" / "figures" / "accuracy_completeness.png", "bench_directions")


def dense(folder: Path) -> None:
    """The bench that ends the demo; prints its table."""
    pcbench("demo --points 20000 --out FOLDER", folder)
    small(folder / "bench" / "figures" / "speed.png", "bench_dense")


def bend(folder: Path) -> None:
    pcbench("experiment bend --out FOLDER/bend --quiet", folder)
    # Its lines are told apart by colours that a palette would merge.
    Image.open(folder / "bend" / "bend.png").convert("RGB").save(HERE / "bend.png", optimize=True)


def gao(folder: Path) -> None:
    """Prints the tables and sentences of the page on the paper."""
    pcbench("experiment gao --out FOLDER/gao", folder)
    for name in ("rings", "directions", "growth"):
        small(folder / "gao" / "figures" / f"{name}.png", f"gao_{name}")
    maps = folder / "gao" / "city_1" / "against-mvs" / "figures"
    for name in ("sparse", "splat-means", "splat-surface"):
        small(maps / f"{name}_poisson_distance.png", f"gao_{name.replace('-', '_')}")
    small(folder / "gao" / "views" / "figures" / "city_1_splat.png", "gao_views")


def main() -> None:
    pictures = {"demo": demo, "city": city, "bench": bench, "dense": dense, "bend": bend, "gao": gao}
    for name in sys.argv[1:] or pictures:
        with TemporaryDirectory() as folder:
            pictures[name](Path(folder))


if __name__ == "__main__":
    main()
