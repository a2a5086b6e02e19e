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
from pcbench.scenes.synthetic.reflect import Mirrors, mirrors_of, reflectance
from pcbench.scratch import naming

FINER = 4  # samples along each side of an image's pixel
_TILE = 8192  # samples along a side of what is drawn at once
_BRIGHTER = 2.0  # times, the green of pages that say what is mirrored: 8 bits are few for water's 2 %
_STRIP = 64  # rows of an image that go through the lens at once
_SKY = ((0.86, 0.90, 0.94), (0.52, 0.68, 0.86))  # at the lower and at the upper side

Pixels = NDArray[np.float32]  # (rows, columns, 3), 0 to 255
Canvas = NDArray[np.uint8]  # (rows, columns, 3), of samples


class CityView:
    """The city in front of one pinhole camera that is moved about."""

    def __init__(self, job: Path, intrinsics: Intrinsics, *, reflections: bool = False) -> None:
        import pyvista

        self.intrinsics = intrinsics
        # The pinhole image that holds all rays of the lens, about its axis.
        x, y = intrinsics.widest
        self.focal = FINER * max(intrinsics.fx, intrinsics.fy)
        self.width, self.height = (2 * int(np.ceil(self.focal * half - 1e-6)) for half in (x, y))
        self.tile = tuple(-(-side // -(-side // _TILE)) for side in (self.width, self.height))
        self.plotter = pyvista.Plotter(off_screen=True, window_size=list(self.tile), lighting="none")
        self.plotter.render_window.SetMultiSamples(0)
        faces = np.load(job / "faces.npz")
        pages = [np.load(job / f"page{number}.npy") for number in range(int(faces["page"].max()) + 1)]
        self.actors: list[tuple[Any, Any, Any]] = []  # with what they look like, and what they mirror
        for number in np.unique(faces["page"]):
            own = faces["page"] == number
            actor = _actor(faces["corners"][own], faces["uv"][own], faces["shade"][own])
            mirror = _texture(_mirror_page(job / f"mirror{number}.npy")) if reflections else None
            self.actors.append((actor, _texture(pages[number]), mirror))
            self.plotter.add_actor(actor)
        corners = faces["corners"].reshape(-1, 3)
        self.low, self.high = corners.min(axis=0), corners.max(axis=0)
        self.mirrors: Mirrors | None = None
        if reflections:
            self.mirrors = mirrors_of(faces["corners"], faces["uv"], faces["page"], faces["shade"], pages)

    def photograph(self, camera: Camera) -> Pixels:
        """The image through the lens: each pixel is the mean over its square."""
        for actor, texture, _ in self.actors:
            actor.SetTexture(texture)
        drawn = self._draw(camera, _SKY)
        if self.mirrors is not None:
            for actor, _, texture in self.actors:
                actor.SetTexture(texture)
            self._reflect(camera, drawn, self._draw(camera, ((0, 0, 0), (0, 0, 0))), self.mirrors)
        k = self.intrinsics
        if k.is_pinhole and drawn.shape[:2] == (FINER * k.height, FINER * k.width):
            return _shrunk(drawn)
        return self._through_the_lens(drawn)

    def _draw(self, camera: Camera, sky: tuple[tuple[float, ...], ...]) -> Canvas:
        """All samples, a tile at a time: OpenGL holds no more."""
        canvas: Canvas = np.empty((self.height, self.width, 3), dtype=np.uint8)
        view = self.plotter.camera
        view.position = tuple(camera.position)
        view.focal_point = tuple(camera.position + camera.direction)
        view.up = tuple(-camera.cam_from_world.rotation[1])
        columns, rows = self.tile
        view.view_angle = float(np.degrees(2 * np.arctan(0.5 * rows / self.focal)))
        far = float(np.linalg.norm(np.maximum(np.abs(camera.position - self.low), np.abs(camera.position - self.high))))
        view.clipping_range = (far / 2000, far)
        lower, upper = np.array(sky)
        for top in range(0, self.height, rows):
            for left in range(0, self.width, columns):
                middle = left + columns / 2 - self.width / 2, self.height / 2 - top - rows / 2
                view.SetWindowCenter(2 * middle[0] / columns, 2 * middle[1] / rows)
                ends = [lower + (1 - y / self.height) * (upper - lower) for y in (top + rows, top)]
                self.plotter.set_background(ends[0].tolist(), top=ends[1].tolist())
                self.plotter.render()
                part = np.asarray(self.plotter.screenshot(return_img=True))[..., :3]
                hole = canvas[top : top + rows, left : left + columns]
                hole[:] = part[: hole.shape[0], : hole.shape[1]]
        return canvas

    def _reflect(self, camera: Camera, drawn: Canvas, mirror: Canvas, mirrors: Mirrors) -> None:
        """Blend what glass and water mirror into the samples."""
        places = np.flatnonzero(mirror[..., 0])
        for some in np.array_split(places, -(-len(places) // 1_000_000)) if len(places) else ():
            y, x = np.divmod(some, self.width)
            rays = np.stack([x + 0.5 - self.width / 2, y + 0.5 - self.height / 2, np.full(len(x), self.focal)], axis=1)
            colors, cosines = mirrors.mirrored(camera.position, rays / self.focal @ camera.cam_from_world.rotation)
            covered, straight = (mirror[y, x, k].astype(np.float32) / 255 for k in (0, 1))
            share = reflectance(straight / _BRIGHTER, covered, cosines)[:, None]
            drawn[y, x] = np.round((1 - share) * drawn[y, x] + share * colors)

    def _through_the_lens(self, drawn: Canvas) -> Pixels:
        from scipy.ndimage import map_coordinates

        k = self.intrinsics
        image: Pixels = np.empty((k.height, k.width, 3), dtype=np.float32)
        u = (np.arange(FINER * k.width) + 0.5) / FINER
        for top in range(0, k.height, _STRIP):
            strip = image[top : top + _STRIP]
            v = top + (np.arange(FINER * len(strip)) + 0.5) / FINER
            fine = np.stack(np.meshgrid(u, v), axis=2).reshape(-1, 2)
            at = self.focal * k.directions(fine)[:, :2] + [0.5 * self.width - 0.5, 0.5 * self.height - 0.5]
            low, high = np.clip([np.floor(at[:, 1].min()) - 1, np.ceil(at[:, 1].max()) + 2], 0, self.height).astype(int)
            at[:, 1] -= low
            for c in range(3):
                plane = map_coordinates(drawn[low:high, :, c], at.T[::-1], output=np.float32, order=1, mode="nearest")
                strip[..., c] = _shrunk(plane.reshape(len(v), len(u), 1))[..., 0]
        return image


def _shrunk(fine: NDArray[Any]) -> Pixels:
    """Means over squares of samples (rows, columns, C)."""
    rows, columns, planes = fine.shape[0] // FINER, fine.shape[1] // FINER, fine.shape[2]
    squares = fine.reshape(rows, FINER, columns, FINER, planes)
    wide = np.uint16 if fine.dtype == np.uint8 else np.float32
    total = np.zeros((rows, columns, planes), dtype=wide)
    for i in range(FINER):  # much faster than the mean over two axes
        for j in range(FINER):
            total += squares[:, i, :, j]
    mean: Pixels = total.astype(np.float32) / np.float32(FINER * FINER)
    return mean


def _mirror_page(path: Path) -> NDArray[np.uint8]:
    """Red: whether there is glass or water; green: which share of the light it mirrors, `_BRIGHTER`."""
    if not path.is_file():
        return np.zeros((1, 1, 3), dtype=np.uint8)
    thousandths = np.load(path)
    green = np.round(255 * _BRIGHTER * (thousandths / 1000))
    return np.stack([255 * (thousandths > 0), green, 0 * green], axis=2).astype(np.uint8)


def _actor(corners: Any, uv: Any, shade: Any) -> Any:
    """Unlit triangles: the texture holds the light, or the colours at the corners do (trees)."""
    import pyvista
    from vtkmodules.util.numpy_support import numpy_to_vtk
    from vtkmodules.vtkRenderingCore import vtkActor, vtkPolyDataMapper

    data = pyvista.PolyData.from_regular_faces(corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3))
    coordinates = numpy_to_vtk(np.ascontiguousarray(uv.reshape(-1, 2)), deep=True)
    data.GetPointData().SetTCoords(coordinates)
    tint = numpy_to_vtk(np.repeat(shade.reshape(-1, 1), 3, axis=1), deep=True)
    data.GetPointData().SetScalars(tint)
    mapper = vtkPolyDataMapper()
    mapper.SetInputData(data)
    mapper.SetColorModeToDirectScalars()
    actor = vtkActor()
    actor.SetMapper(mapper)
    actor.GetProperty().LightingOff()
    return actor


def _texture(page: NDArray[np.uint8]) -> Any:
    from vtkmodules.util.numpy_support import numpy_to_vtk
    from vtkmodules.vtkCommonDataModel import vtkImageData
    from vtkmodules.vtkRenderingCore import vtkTexture

    image = vtkImageData()
    image.SetDimensions(page.shape[1], page.shape[0], 1)
    image.GetPointData().SetScalars(numpy_to_vtk(page.reshape(-1, 3), deep=True))
    texture = vtkTexture()
    texture.SetInputData(image)
    texture.InterpolateOn()
    texture.MipmapOn()
    texture.SetMaximumAnisotropicFiltering(2)
    return texture


def develop(
    image: Pixels, optics: dict[str, float], intrinsics: Intrinsics, rng: np.random.Generator
) -> NDArray[np.uint8]:
    """What lens and sensor make of the light: vignetting, gain, blur, noise, 8 bits."""
    from scipy.ndimage import gaussian_filter

    if optics["vignetting"] > 0:
        image = image * vignette(intrinsics, optics["vignetting"])[..., None]
    image = image * np.float32(np.exp(rng.normal(0, optics["exposure"])))
    if optics["blur"] > 0:
        image = gaussian_filter(image, (optics["blur"], optics["blur"], 0), mode="nearest")
    if optics["noise"] > 0:
        image = image + np.float32(optics["noise"]) * rng.standard_normal(image.shape, dtype=np.float32)
    return np.round(np.clip(image, 0, 255)).astype(np.uint8)


def vignette(intrinsics: Intrinsics, strength: float) -> NDArray[np.float32]:
    """Which share of the light reaches each pixel (rows, columns): at a strength of 1 the fourth power of the cosine
    of the angle between its ray and the axis.
    """
    k = intrinsics
    u, v = np.meshgrid(np.arange(k.width) + 0.5, np.arange(k.height) + 0.5)
    x, y, _ = k.directions(np.stack([u.ravel(), v.ravel()], axis=1)).T
    fourth = 1 / np.square(1 + x * x + y * y)
    share: NDArray[np.float32] = (1 - strength * (1 - fourth)).reshape(k.height, k.width).astype(np.float32)
    return share


def main() -> int:
    from PIL import Image

    job, folder = Path(sys.argv[1]), Path(sys.argv[2])
    values = json.loads((job / "job.json").read_text())
    view: CityView | None = None
    for number, row in enumerate(values["cameras"]):
        intrinsics = Intrinsics(**{**row["intrinsics"], "distortion": tuple(row["intrinsics"]["distortion"])})
        camera = Camera(row["name"], intrinsics, Similarity(np.array(row["rotation"]), np.array(row["translation"])))
        if view is None or view.intrinsics != intrinsics:
            view = CityView(job, intrinsics, reflections=values["reflections"])
        rng = np.random.default_rng([values["seed"], 9, number])
        pixels = develop(view.photograph(camera), values["optics"], intrinsics, rng)
        path = folder / camera.name
        with naming(path, path):
            Image.fromarray(pixels).save(path, compress_level=4)
    return 0


if __name__ == "__main__":
    sys.exit(main())
