"""PatchMatch stereo: a depth map of one photograph by comparison with others (Galliani et al. 2015; Schonberger et al.
2016; Xu and Tao 2019), on any CPU.

Every pixel holds a plane. Two coarser levels come first; at each level planes pass from pixel to pixel and are varied
at random. The same input gives the same maps, on each instruction set and with any number of threads.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcbench.errors import InputError
from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.cameras import Camera
from reconstructors.mvs.maps import DepthMap
from reconstructors.mvs.native import _patchmatch

MAX_SOURCES = 16
MAX_SIDE = 32_000  # pixels, as coordinates in a source are held in fixed point
_LEAST_SIDE = 32  # pixels: no coarser level has a shorter one
_BLOCK = 16  # pixels along a side of the parts in which noise is looked for
_TEXTURE = 2.5  # times the noise's variance: 1 patch of noise alone in 1000 has more
_VARIED = 3  # sweeps after which the steps of the variation are those of refinement


class GrayView(NamedTuple):
    """An undistorted photograph.

    Args:
        gray: (H, W) uint8.
        camera: a pinhole of that size.
        valid: (H, W), False where a mask hides the picture; None for nowhere.
    """

    gray: NDArray[np.uint8]
    camera: Camera
    valid: NDArray[np.bool_] | None = None


def match(
    reference: GrayView,
    sources: Sequence[GrayView],
    depth_range: tuple[float, float],
    *,
    levels: int = 3,
    iterations: int = 3,
    seed: int = 0,
) -> DepthMap:
    """The depth map that explains the sources best, by their pictures alone.

    Args:
        sources: 1 to 16.
        depth_range: of the z coordinates in the reference camera's frame, both positive.
        levels: of the image pyramid, each half as large as the one before.
        iterations: at each level, one less at full size where coarser levels came first.

    Returns:
        A depth wherever the reference is valid; where nothing is found the confidence says so. The confidence is the
        mean correlation with the sources that count at a pixel, 0 where it is negative.

    Raises:
        InputError: there are no sources or too many, a photograph is too large, or the range is empty.
    """
    views = [reference, *sources]
    pyramid = [views]
    for _ in range(levels - 1):
        if min(min(view.gray.shape) for view in views) < 2 * _LEAST_SIDE:
            break
        views = [_halved(view) for view in views]
        pyramid.append(views)
    state = None
    for level, (small, *others) in reversed(list(enumerate(pyramid))):
        if state is None:
            state = _State.of(np.zeros((*small.gray.shape, 4), np.float32), len(others))
        else:
            state = state.doubled(small.gray.shape)
        coarsest = level == len(pyramid) - 1
        # What comes from a coarser level is near enough: a last iteration at full size moved 0.4 % of the depths to
        # within a pixel's footprint of the truth, for a third of the time.
        count = iterations if level or coarsest else max(1, iterations - 1)
        state.improve(small, others, None, depth_range, count, 0 if coarsest else _VARIED - 1, seed + level)
    assert state is not None
    return state.map()


def refine(
    reference: GrayView,
    sources: Sequence[GrayView],
    source_depths: Sequence[NDArray[np.float32]],
    initial: DepthMap,
    depth_range: tuple[float, float],
    *,
    iterations: int = 2,
    seed: int = 0,
) -> DepthMap:
    """A map that also agrees with the sources' own maps (Xu and Tao 2019, sec. 4.2).

    Args:
        source_depths: of each source the depth map that `match` found, of its size.
        initial: what `match` found for the reference.

    Raises:
        InputError: as `match`.
    """
    planes = np.concatenate([initial.depth[..., None], initial.normal], axis=2, dtype=np.float32)
    state = _State.of(planes, len(sources))
    state.improve(reference, sources, source_depths, depth_range, iterations, _VARIED, seed)
    return state.map()


class _State(NamedTuple):
    planes: NDArray[np.float32]  # (H, W, 4), depth and normal
    cost: NDArray[np.float32]
    view_costs: NDArray[np.float32]

    @classmethod
    def of(cls, planes: NDArray[np.float32], sources: int) -> _State:
        shape = planes.shape[:2]
        return cls(planes, np.zeros(shape, np.float32), np.zeros((*shape, sources), np.float32))

    def doubled(self, shape: tuple[int, ...]) -> _State:
        """The planes at the next finer level: pixels there get the plane of the pixel that they were part of."""
        rows, columns = (
            np.minimum(np.arange(n) // 2, m - 1) for n, m in zip(shape, self.planes.shape[:2], strict=True)
        )
        return _State.of(self.planes[np.ix_(rows, columns)], self.view_costs.shape[2])

    def improve(
        self,
        reference: GrayView,
        sources: Sequence[GrayView],
        depths: Sequence[NDArray[np.float32]] | None,
        depth_range: tuple[float, float],
        iterations: int,
        first: int,
        seed: int,
    ) -> None:
        nearest, farthest = depth_range
        if not 1 <= len(sources) <= MAX_SOURCES:
            raise InputError(f"expected 1 to {MAX_SOURCES} sources, got {len(sources)}")
        longest = max(max(view.gray.shape) for view in (reference, *sources))
        if longest > MAX_SIDE:
            raise InputError(f"expected photographs of at most {MAX_SIDE} pixels a side, got {longest}: halve them")
        if not 0 < nearest < farthest:
            raise InputError(f"expected a range of positive depths, got {nearest:g} to {farthest:g}")
        k = _matrix(reference.camera)
        pinhole = np.array([k[0, 0], k[1, 1], k[0, 2], k[1, 2]], np.float32)
        valid = None if reference.valid is None else np.ascontiguousarray(reference.valid, dtype=np.uint8)
        moves = [_pixels_per_depth(reference.camera, source.camera, depth_range) for source in sources]
        least = max(1.0, _TEXTURE * noise_variance(reference.gray))
        matcher = _patchmatch.Matcher(
            reference.gray, pinhole, valid, nearest, farthest, float(np.median(moves)), least, seed
        )
        for i, source in enumerate(sources):
            there, back = _motion(reference.camera, source.camera), _motion(source.camera, reference.camera)
            shown = None if source.valid is None else source.valid.astype(np.float32)
            matcher.add_source(source.gray, there, None if depths is None else depths[i], back, shown)
        matcher.run(self.planes, self.cost, self.view_costs, iterations, first)

    def map(self) -> DepthMap:
        depth, normal = self.planes[..., 0], self.planes[..., 1:]
        return DepthMap(np.ascontiguousarray(depth), np.ascontiguousarray(normal), np.clip(1 - self.cost, 0, 1))


def noise_variance(gray: NDArray[np.uint8]) -> float:
    """Of a picture (H, W), in grey levels squared: what is left of its flattest parts after Immerkaer's operator
    (1996), which takes planes and second derivatives away. 0 for a picture too small to tell.
    """
    rows, columns = ((n - 2) // _BLOCK for n in gray.shape)
    if rows < 1 or columns < 1:
        return 0.0
    values = gray.astype(np.int16)
    down = values[:-2] - 2 * values[1:-1] + values[2:]
    left = np.abs(down[:, :-2] - 2 * down[:, 1:-1] + down[:, 2:])[: rows * _BLOCK, : columns * _BLOCK]
    blocks = left.reshape(rows, _BLOCK, columns, _BLOCK).mean(axis=(1, 3))
    return float(0.5 * np.pi * (np.percentile(blocks, 5) / 6) ** 2)


def _halved(view: GrayView) -> GrayView:
    """Means over 2 x 2 pixels; an odd last row or column is left out."""
    height, width = view.gray.shape[0] // 2, view.gray.shape[1] // 2
    cut = view.gray[: 2 * height, : 2 * width].astype(np.uint16).reshape(height, 2, width, 2)
    gray = ((cut.sum(axis=(1, 3)) + 2) // 4).astype(np.uint8)
    valid = None
    if view.valid is not None:
        valid = np.asarray(view.valid[: 2 * height, : 2 * width].reshape(height, 2, width, 2).all(axis=(1, 3)))
    k = view.camera.intrinsics
    half = type(k)(width, height, k.fx / 2, k.fy / 2, k.cx / 2, k.cy / 2)
    return GrayView(gray, Camera(view.camera.name, half, view.camera.cam_from_world), valid)


def _matrix(camera: Camera) -> FloatArray:
    """K for pixel coordinates in which the first pixel's centre is (0, 0)."""
    matrix = camera.intrinsics.matrix
    matrix[:2, 2] -= 0.5
    return matrix


def _motion(one: Camera, other: Camera) -> NDArray[np.float32]:
    """(3, 4), from homogeneous pixels times depth of one camera to those of the other."""
    relative = other.cam_from_world @ one.cam_from_world.inverse()
    turn = _matrix(other) @ relative.rotation @ np.linalg.inv(_matrix(one))
    return np.column_stack([turn, _matrix(other) @ relative.translation]).astype(np.float32)


def _pixels_per_depth(one: Camera, other: Camera, depth_range: tuple[float, float]) -> float:
    """How far, in pixels, what `one` shows in its middle moves in the other while its inverse depth changes by one."""
    motion = _motion(one, other).astype(np.float64)
    middle = np.array([one.intrinsics.cx, one.intrinsics.cy, 1.0])
    inverse = 0.5 * (1 / depth_range[0] + 1 / depth_range[1])
    at = motion[:, :3] @ middle + motion[:, 3] * inverse
    x, y = at[:2] / at[2]
    moved = (motion[:2, 3] - np.array([x, y]) * motion[2, 3]) / at[2]
    return max(float(np.hypot(*moved)), 1e-9)
