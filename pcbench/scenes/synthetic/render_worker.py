"""Rendering process: `render_worker JOB FOLDER` writes one image per camera."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pcbench.geometry.cameras import Camera, Intrinsics
from pcbench.geometry.transform import Similarity
from pcbench.scenes.synthetic.reflect import Mirrors, build_mirrors, reflectance
from pcbench.scratch import attribute_errors_to

SUPERSAMPLING = 4  # samples along each side of a pixel
_TILE_SAMPLES = 8192  # samples along a side of one OpenGL rendering
_REFLECTANCE_GAIN = 2.0  # factor of stored reflectances: 8 bits would resolve water's 2 % poorly
_STRIP_ROWS = 64  # image rows distorted at a time
_SKY = ((0.86, 0.90, 0.94), (0.52, 0.68, 0.86))  # colours at the lower and at the upper edge of the image

Pixels = NDArray[np.float32]  # (rows, columns, 3), 0 to 255
Canvas = NDArray[np.uint8]  # (rows, columns, 3) samples


class CityView:
    """City in front of a movable pinhole camera."""

    def __init__(self, job: Path, intrinsics: Intrinsics, *, reflections: bool = False) -> None:
        import pyvista

        self.intrinsics = intrinsics
        # A pinhole image, symmetric about the optical axis, that contains all rays of the distorted image.
        x, y = intrinsics.widest
        self.focal = SUPERSAMPLING * max(intrinsics.fx, intrinsics.fy)
        self.width, self.height = (2 * int(np.ceil(self.focal * half - 1e-6)) for half in (x, y))
        self.tile = tuple(-(-side // -(-side // _TILE_SAMPLES)) for side in (self.width, self.height))
        self.plotter = pyvista.Plotter(off_screen=True, window_size=list(self.tile), lighting="none")
        self.plotter.render_window.SetMultiSamples(0)
        faces = np.load(job / "faces.npz")
        pages = [np.load(job / f"page{number}.npy") for number in range(int(faces["page"].max()) + 1)]
        self.actors: list[tuple[Any, Any, Any]] = []  # actor, its texture and its reflectance texture
        for number in np.unique(faces["page"]):
            on_page = faces["page"] == number
            actor = _actor(faces["corners"][on_page], faces["uv"][on_page], faces["shade"][on_page])
            mirror = _texture(_mirror_page(job / f"mirror{number}.npy")) if reflections else None
            self.actors.append((actor, _texture(pages[number]), mirror))
            self.plotter.add_actor(actor)
        corners = faces["corners"].reshape(-1, 3)
        self.low, self.high = corners.min(axis=0), corners.max(axis=0)
        self.mirrors: Mirrors | None = None
        if reflections:
            self.mirrors = build_mirrors(faces["corners"], faces["uv"], faces["page"], faces["shade"], pages)

    def photograph(self, camera: Camera) -> Pixels:
        """Render the distorted image; each pixel is the mean of its samples."""
        for actor, texture, _ in self.actors:
            actor.SetTexture(texture)
        samples = self._render_samples(camera, _SKY)
        if self.mirrors is not None:
            for actor, _, texture in self.actors:
                actor.SetTexture(texture)
            self._reflect(camera, samples, self._render_samples(camera, ((0, 0, 0), (0, 0, 0))), self.mirrors)
        k = self.intrinsics
        if k.is_pinhole and samples.shape[:2] == (SUPERSAMPLING * k.height, SUPERSAMPLING * k.width):
            return _downsample(samples)
        return self._apply_distortion(samples)

    def _render_samples(self, camera: Camera, sky: tuple[tuple[float, ...], ...]) -> Canvas:
        """Render all samples in tiles, because OpenGL limits the size of an image."""
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
                target = canvas[top : top + rows, left : left + columns]
                target[:] = part[: target.shape[0], : target.shape[1]]
        return canvas

    def _reflect(self, camera: Camera, samples: Canvas, mirror: Canvas, mirrors: Mirrors) -> None:
        """Blend the reflections of glass and water into the samples."""
        reflecting = np.flatnonzero(mirror[..., 0])
        for block in np.array_split(reflecting, -(-len(reflecting) // 1_000_000)) if len(reflecting) else ():
            y, x = np.divmod(block, self.width)
            rays = np.stack([x + 0.5 - self.width / 2, y + 0.5 - self.height / 2, np.full(len(x), self.focal)], axis=1)
            colors, cosines = mirrors.trace_reflections(
                camera.position, rays / self.focal @ camera.cam_from_world.rotation
            )
            coverage, normal_reflectance = (mirror[y, x, k].astype(np.float32) / 255 for k in (0, 1))
            share = reflectance(normal_reflectance / _REFLECTANCE_GAIN, coverage, cosines)[:, None]
            samples[y, x] = np.round((1 - share) * samples[y, x] + share * colors)

    def _apply_distortion(self, samples: Canvas) -> Pixels:
        from scipy.ndimage import map_coordinates

        k = self.intrinsics
        image: Pixels = np.empty((k.height, k.width, 3), dtype=np.float32)
        u = (np.arange(SUPERSAMPLING * k.width) + 0.5) / SUPERSAMPLING
        for top in range(0, k.height, _STRIP_ROWS):
            strip = image[top : top + _STRIP_ROWS]
            v = top + (np.arange(SUPERSAMPLING * len(strip)) + 0.5) / SUPERSAMPLING
            fine = np.stack(np.meshgrid(u, v), axis=2).reshape(-1, 2)
            xy = self.focal * k.directions(fine)[:, :2] + [0.5 * self.width - 0.5, 0.5 * self.height - 0.5]
            low, high = np.clip([np.floor(xy[:, 1].min()) - 1, np.ceil(xy[:, 1].max()) + 2], 0, self.height).astype(int)
            xy[:, 1] -= low
            for c in range(3):
                plane = map_coordinates(samples[low:high, :, c], xy.T[::-1], output=np.float32, order=1, mode="nearest")
                strip[..., c] = _downsample(plane.reshape(len(v), len(u), 1))[..., 0]
        return image


def _downsample(fine: NDArray[Any]) -> Pixels:
    """Return the mean of the samples (rows, columns, C) of each pixel."""
    rows, columns, planes = fine.shape[0] // SUPERSAMPLING, fine.shape[1] // SUPERSAMPLING, fine.shape[2]
    squares = fine.reshape(rows, SUPERSAMPLING, columns, SUPERSAMPLING, planes)
    wide = np.uint16 if fine.dtype == np.uint8 else np.float32
    total = np.zeros((rows, columns, planes), dtype=wide)
    for i in range(SUPERSAMPLING):  # much faster than a mean over two axes
        for j in range(SUPERSAMPLING):
            total += squares[:, i, :, j]
    mean: Pixels = total.astype(np.float32) / np.float32(SUPERSAMPLING * SUPERSAMPLING)
    return mean


def _mirror_page(path: Path) -> NDArray[np.uint8]:
    """Encode reflectance as colours: red is 255 on glass and water, green is reflectance times `_REFLECTANCE_GAIN`."""
    if not path.is_file():
        return np.zeros((1, 1, 3), dtype=np.uint8)
    thousandths = np.load(path)
    green = np.round(255 * _REFLECTANCE_GAIN * (thousandths / 1000))
    return np.stack([255 * (thousandths > 0), green, 0 * green], axis=2).astype(np.uint8)


def _actor(corners: Any, uv: Any, shade: Any) -> Any:
    """Return unlit triangles: the light is in the texture, or for trees in the colours of the corners."""
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


def apply_sensor(
    image: Pixels, optics: dict[str, float], intrinsics: Intrinsics, rng: np.random.Generator
) -> NDArray[np.uint8]:
    """Apply lens and sensor effects: vignetting, gain, blur, noise, 8 bits."""
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
    """Return the share of light (rows, columns) that reaches each pixel.

    At strength 1 it is the fourth power of the cosine of the angle between the pixel's ray and the optical axis.
    """
    k = intrinsics
    u, v = np.meshgrid(np.arange(k.width) + 0.5, np.arange(k.height) + 0.5)
    x, y, _ = k.directions(np.stack([u.ravel(), v.ravel()], axis=1)).T
    fourth = 1 / np.square(1 + x * x + y * y)
    share: NDArray[np.float32] = (1 - strength * (1 - fourth)).reshape(k.height, k.width).astype(np.float32)
    return share


def main() -> int:
    """Render the images of a job."""
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
        pixels = apply_sensor(view.photograph(camera), values["optics"], intrinsics, rng)
        path = folder / camera.name
        with attribute_errors_to(path, path):
            Image.fromarray(pixels).save(path, compress_level=4)
    return 0


if __name__ == "__main__":
    sys.exit(main())
