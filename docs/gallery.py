"""Make the pictures that the README shows: `make gallery`."""

from pathlib import Path
from subprocess import run
from tempfile import TemporaryDirectory

from PIL import Image

CITY = "0014.png", "0034.png"  # of the third circle, and of the sixth
SHOWN = ("reference", "sparse_plane_distance", "densified_plane_distance", "distribution")


def main() -> None:
    here = Path(__file__).parent / "gallery"
    with TemporaryDirectory() as folder:
        run(["pcbench", "demo", "--out", folder, "--quiet"], check=True)
        for name in SHOWN:
            picture = Image.open(Path(folder) / "report" / "figures" / f"{name}.png").convert("RGB")
            # A palette halves what a repository has to carry for ever.
            picture.quantize(128).save(here / f"{name}.png", optimize=True)
    with TemporaryDirectory() as folder:
        run(["pcbench", "synth", "city", "--out", folder, "--points", "1000", "--quiet"], check=True)
        photographs = [Image.open(Path(folder) / "images" / name).resize((720, 405)) for name in CITY]
        strip = Image.new("RGB", (1440, 405))
        for number, photograph in enumerate(photographs):
            strip.paste(photograph, (720 * number, 0))
        strip.save(here / "city.jpg", quality=85)  # a sensor's noise is what PNG cannot shrink
    with TemporaryDirectory() as folder:
        run(["pcbench", "experiment", "bend", "--out", f"{folder}/bend", "--quiet"], check=True)
        # Its lines are told apart by colours that a palette would merge.
        Image.open(Path(folder) / "bend/bend.png").convert("RGB").save(here / "bend.png", optimize=True)


if __name__ == "__main__":
    main()
