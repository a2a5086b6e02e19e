"""Make the pictures that the README shows: `make gallery`."""

from pathlib import Path
from subprocess import run
from tempfile import TemporaryDirectory

from PIL import Image

SHOWN = ("reference", "sparse_plane_distance", "densified_plane_distance", "distribution")


def main() -> None:
    here = Path(__file__).parent / "gallery"
    with TemporaryDirectory() as folder:
        run(["pcbench", "demo", "--out", folder, "--quiet"], check=True)
        for name in SHOWN:
            picture = Image.open(Path(folder) / "report" / "figures" / f"{name}.png").convert("RGB")
            # A palette halves what a repository has to carry for ever.
            picture.quantize(128).save(here / f"{name}.png", optimize=True)


if __name__ == "__main__":
    main()
