"""PatchMatch stereo on the CPU: the depth map of an image by comparison with others.

Sources: Galliani et al. 2015; Schonberger et al. 2016; Xu and Tao 2019.

Each pixel has a plane. The search is coarse to fine, over three levels: at each level planes propagate to neighbouring
pixels and are perturbed at random. The same input gives the same maps, bit for bit, on all instruction sets and with
any number of threads.
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
MAX_SIDE_PX = 32_000  # coordinates in a source are 16.16 fixed-point numbers
_MIN_LEVEL_SIDE_PX = 32  # shorter side at the coarsest level
_NOISE_BLOCK_PX = 16  # side of the blocks in which noise is measured
_MIN_TEXTURE_TO_NOISE = 2.5  # ratio of variances; 1 in 1000 patches of pure noise exceeds it
_REFINEMENT_SWEEP = 3  # sweep number from which perturbations are small enough for refinement


class GrayView(NamedTuple):
    """An undistorted grey photograph.

    Args:
        gray: (H, W) uint8.
        camera: pinhole of that size.
        valid: (H, W), False where a mask hides the image; None if all pixels are valid.
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
    """Compute the depth map that best explains the sources, from the photographs alone.

    Args:
        reference: photograph whose depths are searched.
        sources: 1 to 16 photographs to compare with.
        depth_range: smallest and largest z coordinate in the reference camera's frame, both positive.
        levels: levels of the image pyramid, each half as large as the one before.
        iterations: sweeps per level; one less at full size after coarser levels.
        seed: seed of the random perturbations.

    Returns:
        A depth at each valid pixel of the reference. The confidence is the mean correlation with the sources that
        count at a pixel, clamped at 0; it is low where no depth explains the sources.

    Raises:
        InputError: there are no sources or too many, a photograph is too large, or the depth range is empty.
    """
    views = [reference, *sources]
    pyramid = [views]
    for _ in range(levels - 1):
        if min(min(view.gray.shape) for view in views) < 2 * _MIN_LEVEL_SIDE_PX:
            break
        views = [_halve(view) for view in views]
        pyramid.append(views)
    state = None
    for level, (scaled, *others) in reversed(list(enumerate(pyramid))):
        if state is None:
            state = _SearchState.initial(np.zeros((*scaled.gray.shape, 4), np.float32), len(others))
        else:
            state = state.upsample(scaled.gray.shape)
        coarsest = level == len(pyramid) - 1
        # Depths from a coarser level are close already: one more sweep at full size brought 0.4 % of the depths to
        # within a pixel's footprint of the truth, for a third of the time.
        count = iterations if level or coarsest else max(1, iterations - 1)
        first = 0 if coarsest else _REFINEMENT_SWEEP - 1
        state.improve(scaled, others, None, depth_range, count, first, seed + level, half_patches=True)
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
    """Refine a depth map so that it also agrees with the maps of its sources (Xu and Tao 2019, sec. 4.2).

    Args:
        reference: photograph whose depths are refined.
        sources: 1 to 16 photographs to compare with.
        source_depths: for each source the depth map from `match`, of the source's size.
        initial: depth map of the reference from `match`.
        depth_range: smallest and largest z coordinate in the reference camera's frame, both positive.
        iterations: sweeps.
        seed: seed of the random perturbations.

    Raises:
        InputError: as `match`.
    """
    planes = np.concatenate([initial.depth[..., None], initial.normal], axis=2, dtype=np.float32)
    state = _SearchState.initial(planes, len(sources))
    state.improve(
        reference, sources, source_depths, depth_range, iterations, _REFINEMENT_SWEEP, seed, half_patches=False
    )
    return state.map()


class _SearchState(NamedTuple):
    """Plane and costs of each pixel during the search."""

    planes: NDArray[np.float32]  # (H, W, 4), depth and normal
    cost: NDArray[np.float32]  # (H, W)
    view_costs: NDArray[np.float32]  # (H, W, sources)

    @classmethod
    def initial(cls, planes: NDArray[np.float32], sources: int) -> _SearchState:
        shape = planes.shape[:2]
        return cls(planes, np.zeros(shape, np.float32), np.zeros((*shape, sources), np.float32))

    def upsample(self, shape: tuple[int, ...]) -> _SearchState:
        """Return the state at the next finer level: each pixel gets the plane of its coarser pixel."""
        rows, columns = (
            np.minimum(np.arange(n) // 2, m - 1) for n, m in zip(shape, self.planes.shape[:2], strict=True)
        )
        return _SearchState.initial(self.planes[np.ix_(rows, columns)], self.view_costs.shape[2])

    def improve(
        self,
        reference: GrayView,
        sources: Sequence[GrayView],
        depths: Sequence[NDArray[np.float32]] | None,
        depth_range: tuple[float, float],
        iterations: int,
        first_sweep: int,
        seed: int,
        *,
        half_patches: bool,
    ) -> None:
        """Run sweeps of the compiled search in place; perturbations shrink with the sweep number.

        Patches of 13 instead of 25 texels (`half_patches`) take less time. Depths found with them are as good after
        refinement with whole patches.
        """
        nearest, farthest = depth_range
        if not 1 <= len(sources) <= MAX_SOURCES:
            raise InputError(f"expected 1 to {MAX_SOURCES} sources, got {len(sources)}")
        longest = max(max(view.gray.shape) for view in (reference, *sources))
        if longest > MAX_SIDE_PX:
            raise InputError(
                f"expected photographs of at most {MAX_SIDE_PX} pixels along each side, got {longest}; halve their size"
            )
        if not 0 < nearest < farthest:
            raise InputError(f"expected 0 < smallest < largest depth, got {nearest:g} to {farthest:g}")
        k = _zero_based_matrix(reference.camera)
        pinhole = np.array([k[0, 0], k[1, 1], k[0, 2], k[1, 2]], np.float32)
        valid = None if reference.valid is None else np.ascontiguousarray(reference.valid, dtype=np.uint8)
        motions = [_pixels_per_depth(reference.camera, source.camera, depth_range) for source in sources]
        min_variance = max(1.0, _MIN_TEXTURE_TO_NOISE * noise_variance(reference.gray))
        matcher = _patchmatch.Matcher(
            reference.gray,
            pinhole,
            valid,
            nearest,
            farthest,
            float(np.median(motions)),
            min_variance,
            half_patches,
            seed,
        )
        for i, source in enumerate(sources):
            forward = projection_between(reference.camera, source.camera)
            backward = projection_between(source.camera, reference.camera)
            visible = None if source.valid is None else source.valid.astype(np.float32)
            matcher.add_source(source.gray, forward, None if depths is None else depths[i], backward, visible)
        matcher.run(self.planes, self.cost, self.view_costs, iterations, first_sweep)

    def map(self) -> DepthMap:
        """Return the depth map; the confidence is one minus the cost, clamped to 0 to 1."""
        depth, normal = self.planes[..., 0], self.planes[..., 1:]
        return DepthMap(np.ascontiguousarray(depth), np.ascontiguousarray(normal), np.clip(1 - self.cost, 0, 1))


def noise_variance(gray: NDArray[np.uint8]) -> float:
    """Estimate the noise variance of an image (H, W), in squared grey levels; 0 for an image that is too small.

    It is measured in the flattest blocks after Immerkaer's operator (1996), which removes planes and most structure.
    """
    rows, columns = ((n - 2) // _NOISE_BLOCK_PX for n in gray.shape)
    if rows < 1 or columns < 1:
        return 0.0
    values = gray.astype(np.int16)
    down = values[:-2] - 2 * values[1:-1] + values[2:]
    curvature = np.abs(down[:, :-2] - 2 * down[:, 1:-1] + down[:, 2:])
    whole_blocks = curvature[: rows * _NOISE_BLOCK_PX, : columns * _NOISE_BLOCK_PX]
    blocks = whole_blocks.reshape(rows, _NOISE_BLOCK_PX, columns, _NOISE_BLOCK_PX).mean(axis=(1, 3))
    return float(0.5 * np.pi * (np.percentile(blocks, 5) / 6) ** 2)


def window_variances(gray: NDArray[np.uint8], side_px: int) -> FloatArray:
    """Return the variance (H, W) of the grey values in the square window around each pixel, in squared grey levels."""
    from scipy.ndimage import uniform_filter

    values = gray.astype(np.float64)
    variances: FloatArray = uniform_filter(values * values, side_px) - uniform_filter(values, side_px) ** 2
    return variances


def _halve(view: GrayView) -> GrayView:
    """Average blocks of 2 x 2 pixels; an odd last row or column is dropped."""
    height, width = view.gray.shape[0] // 2, view.gray.shape[1] // 2
    cut = view.gray[: 2 * height, : 2 * width].astype(np.uint16).reshape(height, 2, width, 2)
    gray = ((cut.sum(axis=(1, 3)) + 2) // 4).astype(np.uint8)
    valid = None
    if view.valid is not None:
        valid = np.asarray(view.valid[: 2 * height, : 2 * width].reshape(height, 2, width, 2).all(axis=(1, 3)))
    k = view.camera.intrinsics
    half = type(k)(width, height, k.fx / 2, k.fy / 2, k.cx / 2, k.cy / 2)
    return GrayView(gray, Camera(view.camera.name, half, view.camera.cam_from_world), valid)


def _zero_based_matrix(camera: Camera) -> FloatArray:
    """Return K for pixel coordinates in which the first pixel's centre is (0, 0)."""
    matrix = camera.intrinsics.matrix
    matrix[:2, 2] -= 0.5
    return matrix


def projection_between(one: Camera, other: Camera) -> NDArray[np.float32]:
    """Return the (3, 4) map from homogeneous pixels times depth of one camera to those of the other."""
    relative = other.cam_from_world @ one.cam_from_world.inverse()
    rotation = _zero_based_matrix(other) @ relative.rotation @ np.linalg.inv(_zero_based_matrix(one))
    translation = _zero_based_matrix(other) @ relative.translation
    return np.column_stack([rotation, translation]).astype(np.float32)


def _pixels_per_depth(one: Camera, other: Camera, depth_range: tuple[float, float]) -> float:
    """Return how many pixels the centre of `one` moves in `other` per unit of inverse depth."""
    projection = projection_between(one, other).astype(np.float64)
    centre = np.array([one.intrinsics.cx, one.intrinsics.cy, 1.0])
    inverse = 0.5 * (1 / depth_range[0] + 1 / depth_range[1])
    homogeneous = projection[:, :3] @ centre + projection[:, 3] * inverse
    x, y = homogeneous[:2] / homogeneous[2]
    moved = (projection[:2, 3] - np.array([x, y]) * projection[2, 3]) / homogeneous[2]
    return max(float(np.hypot(*moved)), 1e-9)
