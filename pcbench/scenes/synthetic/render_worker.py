"""The drawing process: `render_worker JOB FOLDER` writes an image for each camera."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pcbench.geometry.cameras import Camera, Intrinsics
from pcbench.geometry.transform import Similarity

FINER = 2  # pixels drawn along each side of an image's pixel
_SKY = ((0.86, 0.90, 0.94), (0.52, 0.68, 0.86))  # at the lower and at the upper side

Pixels = NDArray[np.float32]  # (rows, columns, 3), 0 to 255


class CityView:
    """The city in front of one pinhole camera that is moved about."""

    def __init__(self, job: Path, intrinsics: Intrinsics) -> None:
        import pyvista

        self.intrinsics = intrinsics
        # The pinhole image that holds all rays of the lens, about its axis.
        x, y = intrinsics.widest
        self.focal = FINER * max(intrinsics.fx, intrinsics.fy)
        self.width, self.height = (2 * int(np.ceil(self.focal * half - 1e-6)) for half in (x, y))
        self.plotter = pyvista.Plotter(off_screen=True, window_size=[self.width, self.height], lighting="none")
        self.plotter.set_background(_SKY[0], top=_SKY[1])
        self.plotter.render_window.SetMultiSamples(0)
        faces = np.load(job / "faces.npz")
        for number in np.unique(faces["page"]):
            own = faces["page"] == number
            page = np.load(job / f"page{number}.npy")
            self.plotter.add_actor(_actor(faces["corners"][own], faces["uv"][own], faces["shade"][own], page))
        corners = faces["corners"].reshape(-1, 3)
        self.low, self.high = corners.min(axis=0), corners.max(axis=0)

    def photograph(self, camera: Camera) -> Pixels:
        """The image through the lens: each pixel is the mean over its square."""
        view = self.plotter.camera
        view.position = tuple(camera.position)
        view.focal_point = tuple(camera.position + camera.direction)
        view.up = tuple(-camera.cam_from_world.rotation[1])
        view.view_angle = float(np.degrees(2 * np.arctan(0.5 * self.height / self.focal)))
        far = float(np.linalg.norm(np.maximum(np.abs(camera.position - self.low), np.abs(camera.position - self.high))))
        view.clipping_range = (far / 2000, far)
        self.plotter.render()
        drawn = np.asarray(self.plotter.screenshot(return_img=True))[..., :3].astype(np.float32)
        k = self.intrinsics
        if k.is_pinhole and drawn.shape[:2] == (FINER * k.height, FINER * k.width):
            return _shrunk(drawn)
        return self._through_the_lens(drawn)

    def _through_the_lens(self, drawn: Pixels) -> Pixels:
        from scipy.ndimage import map_coordinates

        k = self.intrinsics
        u, v = ((np.arange(FINER * n) + 0.5) / FINER for n in (k.width, k.height))
        fine = np.stack(np.meshgrid(u, v), axis=2).reshape(-1, 2)
        at = self.focal * k.directions(fine)[:, :2] + [0.5 * self.width - 0.5, 0.5 * self.height - 0.5]
        planes = [map_coordinates(drawn[..., c], at.T[::-1], order=1, mode="nearest") for c in range(3)]
        return _shrunk(np.stack(planes, axis=1).reshape(len(v), len(u), 3))


def _shrunk(fine: Pixels) -> Pixels:
    rows, columns = fine.shape[0] // FINER, fine.shape[1] // FINER
    mean: Pixels = fine.reshape(rows, FINER, columns, FINER, 3).mean(axis=(1, 3), dtype=np.float32)
    return mean


def _actor(corners: Any, uv: Any, shade: Any, page: Any) -> Any:
    """Unlit triangles: the texture holds the light, or the colours at the corners do (trees)."""
    import pyvista
    from vtkmodules.util.numpy_support import numpy_to_vtk
    from vtkmodules.vtkCommonDataModel import vtkImageData
    from vtkmodules.vtkRenderingCore import vtkActor, vtkPolyDataMapper, vtkTexture

    data = pyvista.PolyData.from_regular_faces(corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3))
    coordinates = numpy_to_vtk(np.ascontiguousarray(uv.reshape(-1, 2)), deep=True)
    data.GetPointData().SetTCoords(coordinates)
    tint = numpy_to_vtk(np.repeat(shade.reshape(-1, 1), 3, axis=1), deep=True)
    data.GetPointData().SetScalars(tint)
    mapper = vtkPolyDataMapper()
    mapper.SetInputData(data)
    mapper.SetColorModeToDirectScalars()
    image = vtkImageData()
    image.SetDimensions(page.shape[1], page.shape[0], 1)
    image.GetPointData().SetScalars(numpy_to_vtk(page.reshape(-1, 3), deep=True))
    texture = vtkTexture()
    texture.SetInputData(image)
    texture.InterpolateOn()
    texture.MipmapOn()
    texture.SetMaximumAnisotropicFiltering(4)
    actor = vtkActor()
    actor.SetMapper(mapper)
    actor.SetTexture(texture)
    actor.GetProperty().LightingOff()
    return actor


def develop(image: Pixels, optics: dict[str, float], rng: np.random.Generator) -> NDArray[np.uint8]:
    """What the sensor makes of the light: gain, blur, noise, 8 bits."""
    from scipy.ndimage import gaussian_filter

    image = image * np.float32(np.exp(rng.normal(0, optics["exposure"])))
    if optics["blur"] > 0:
        image = gaussian_filter(image, (optics["blur"], optics["blur"], 0), mode="nearest")
    if optics["noise"] > 0:
        image = image + np.float32(optics["noise"]) * rng.standard_normal(image.shape, dtype=np.float32)
    return np.round(np.clip(image, 0, 255)).astype(np.uint8)


def main() -> int:
    from PIL import Image

    job, folder = Path(sys.argv[1]), Path(sys.argv[2])
    values = json.loads((job / "job.json").read_text())
    view: CityView | None = None
    for number, row in enumerate(values["cameras"]):
        intrinsics = Intrinsics(**{**row["intrinsics"], "distortion": tuple(row["intrinsics"]["distortion"])})
        camera = Camera(row["name"], intrinsics, Similarity(np.array(row["rotation"]), np.array(row["translation"])))
        if view is None or view.intrinsics != intrinsics:
            view = CityView(job, intrinsics)
        rng = np.random.default_rng([values["seed"], 9, number])
        pixels = develop(view.photograph(camera), values["optics"], rng)
        Image.fromarray(pixels).save(folder / camera.name, compress_level=4)
    return 0


if __name__ == "__main__":
    sys.exit(main())
