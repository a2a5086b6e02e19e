"""The approximations: what each of them changes in a comparison, and which of them apply to a pair."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from importlib.util import find_spec
from typing import Any

import numpy as np

from pcbench.comparison.run import compare
from pcbench.errors import InputError
from pcbench.extras import LIBRARIES
from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.mesh import Mesh
from pcbench.geometry.meshlab import decimate
from pcbench.geometry.neighbors import Index
from pcbench.geometry.sampling import median_spacing
from pcbench.geometry.thinning import disk_radius_for, thin_at_random, thin_by_disks, voxel_side_for
from pcbench.geometry.voxels import voxel_downsample
from pcbench.measure.results import Candidate
from pcbench.measure.settings import Settings
from pcbench.registration import IcpSettings, as_method, local_origin
from pcbench.report.words import length
from pcbench.studies.tradeoff.approximate_search import compare_by_approximate_search
from pcbench.studies.tradeoff.results import TradeoffSettings

RANDOM, VOXEL, DISK = "random", "voxel", "Poisson disk"
THINNING = (RANDOM, VOXEL, DISK)
FLOAT32, SEARCH, NORMALS, ICP, DECIMATION = "float32", "search", "normals", "ICP", "decimation"
FAMILIES = (*THINNING, FLOAT32, SEARCH, NORMALS, ICP, DECIMATION)
CANDIDATE, REFERENCE, BOTH = "candidate", "reference", "both"
_SIDE_WORDS = {CANDIDATE: "the candidate", REFERENCE: "the reference", BOTH: "both clouds"}
_NEIGHBORS = (5, 10, 15)
_ICP_POINTS = (10_000, 3_000, 1_000)
_ICP_ITERATIONS = (20, 5)
_SEARCH_FACTORS = (1.1, 1.5, 2.0)
_FINE_SPACINGS = 3.0  # initial maximum correspondence distance without the coarse stage


@dataclass(frozen=True, eq=False)
class Pair:
    """A pair of clouds and the settings of its exact comparison. A mesh can be the reference."""

    reference: Cloud | Mesh
    candidate: Cloud
    settings: Settings

    @property
    def unit(self) -> str | None:
        """Unit of the coordinates, or None."""
        return self.reference.unit or self.candidate.unit

    @cached_property
    def digest(self) -> str:
        """Return a hash of all arrays that a comparison depends on."""
        total = hashlib.sha256()
        reference, candidate = self.reference, self.candidate
        arrays: list[Any] = [candidate.points, candidate.normals]
        if isinstance(reference, Mesh):
            arrays += [reference.vertices, reference.faces]
        else:
            arrays += [reference.points, reference.normals]
        for array in arrays:
            total.update(b"" if array is None else np.ascontiguousarray(array).tobytes())
        return total.hexdigest()

    def measure(self) -> Candidate:
        """Return the comparison of this pair."""
        return compare(self.reference, {"candidate": self.candidate}, self.settings).candidates[0]


@dataclass(frozen=True)
class Approximation:
    """A cheaper comparison.

    Attributes:
        name: unique name.
        family: kind, of `FAMILIES`.
        side: cloud that it changes, or empty.
        level: share that is kept, or another number that sets its strength.
        instruction: what to do, as an imperative.
        measure: function of the pair and a seed that returns the comparison.
    """

    name: str
    family: str
    side: str
    level: float
    instruction: str
    measure: Callable[[Pair, int], Candidate]

    @property
    def thinned(self) -> tuple[bool, bool]:
        """Return whether the reference is thinned, and whether the candidate is."""
        is_thinning = self.family in THINNING
        return is_thinning and self.side in (REFERENCE, BOTH), is_thinning and self.side in (CANDIDATE, BOTH)


EXACT = Approximation("", "", "", 1.0, "use all points", lambda pair, _: pair.measure())


def plan(pair: Pair, settings: TradeoffSettings) -> tuple[list[Approximation], list[str]]:
    """Return the approximations of a pair that the settings select, and a line about each kind that is left out.

    Raises:
        InputError: the settings select none.
    """
    skipped: list[str] = []
    chosen: list[Approximation] = []
    for family in (_thinning, _float32, _search, _normals, _icp, _decimation):
        chosen += family(pair, settings, skipped)
    chosen = [approximation for approximation in chosen if settings.selects(approximation.name)]
    unknown = [text for text in settings.only if not any(text.lower() in one.name.lower() for one in chosen)]
    reasons = {text: [line for line in skipped if text.lower() in line.lower()] for text in unknown}
    if not chosen or not all(reasons.values()):
        why = "; ".join(dict.fromkeys(line for lines in reasons.values() for line in lines))
        why = f" ({why})" if why else ""
        raise InputError(
            f"no approximation of this pair has {' or '.join(map(repr, unknown))} in its name{why}: name one of"
            f" {', '.join(FAMILIES)}"
        )
    return chosen, [line for line in skipped if settings.selects(line)]


_Skipped = list[str]


def _thinning(pair: Pair, settings: TradeoffSettings, skipped: _Skipped) -> Iterator[Approximation]:
    sides = [CANDIDATE, BOTH] if settings.quick else [CANDIDATE, REFERENCE, BOTH]
    if isinstance(pair.reference, Mesh):
        sides = [CANDIDATE]
        skipped.append(f"thinning of the reference ({', '.join(THINNING)}): it is a mesh")
    for kind in (RANDOM, VOXEL) if settings.quick else THINNING:
        for level in settings.levels:
            wanted = [side for side in sides if settings.selects(_thinning_name(kind, side, level))]
            changed = [which for which in (REFERENCE, CANDIDATE) if {which, BOTH} & set(wanted)]
            clouds = {REFERENCE: pair.reference, CANDIDATE: pair.candidate}
            sizes = {which: _size(kind, _points(clouds[which]), level) for which in changed}
            for side in wanted:
                yield _thinned(kind, side, level, sizes, pair.unit)


def _thinning_name(kind: str, side: str, level: float) -> str:
    return f"{kind} {side} {100 * level:g} %"


def _points(cloud: Cloud | Mesh) -> FloatArray:
    assert isinstance(cloud, Cloud)
    return cloud.points


def _size(kind: str, points: FloatArray, level: float) -> float:
    """Return the voxel side or disk radius of a level, and for random thinning its share."""
    if kind == RANDOM:
        return level
    return voxel_side_for(points, level) if kind == VOXEL else disk_radius_for(points, level)


def _thinned(kind: str, side: str, level: float, sizes: dict[str, float], unit: str | None) -> Approximation:
    sides = (REFERENCE, CANDIDATE) if side == BOTH else (side,)
    lengths = " and ".join(dict.fromkeys(length(sizes[which], unit) for which in sides))
    how = {
        RANDOM: "at random",
        VOXEL: f"to one point per voxel of {lengths}",
        DISK: f"to points more than {lengths} apart (Poisson disk)",
    }[kind]

    def measure(pair: Pair, seed: int) -> Candidate:
        clouds = {REFERENCE: pair.reference, CANDIDATE: pair.candidate}
        for number, which in enumerate(sides):
            cloud = clouds[which]
            assert isinstance(cloud, Cloud)
            clouds[which] = thin(cloud, kind, sizes[which], 2 * seed + number)
        candidate = clouds[CANDIDATE]
        assert isinstance(candidate, Cloud)
        return replace(pair, reference=clouds[REFERENCE], candidate=candidate).measure()

    kept = f"{100 * level:g} %"
    instruction = f"thin {_SIDE_WORDS[side]} to {kept} of the points {how}"
    if kind != RANDOM:
        instruction = f"thin {_SIDE_WORDS[side]} {how}, about {kept} of the points"
    return Approximation(_thinning_name(kind, side, level), kind, side, level, instruction, measure)


def thin(cloud: Cloud, kind: str, size: float, seed: int = 0) -> Cloud:
    """Return a thinned cloud.

    Args:
        cloud: cloud.
        kind: `RANDOM`, `VOXEL` or `DISK`.
        size: share of the points for random thinning, else the voxel side or the smallest distance between points.
        seed: random seed.
    """
    if kind == VOXEL:
        return cloud.select(voxel_downsample(cloud.points, size))
    return cloud.select((thin_at_random if kind == RANDOM else thin_by_disks)(cloud.points, size, seed))


def _float32(pair: Pair, settings: TradeoffSettings, skipped: _Skipped) -> Iterator[Approximation]:
    if isinstance(pair.reference, Mesh):
        skipped.append("float32: the reference is a mesh")
        return
    for name, words in (("stored", "as stored"), ("local", "relative to a local origin")):

        def measure(pair: Pair, seed: int, *, is_local: bool = name == "local") -> Candidate:
            assert isinstance(pair.reference, Cloud)
            origin = local_origin(pair.reference) if is_local else np.zeros(3)
            reference, candidate = (_rounded(cloud, origin) for cloud in (pair.reference, pair.candidate))
            return replace(pair, reference=reference, candidate=candidate).measure()

        yield Approximation(f"float32 {name}", FLOAT32, BOTH, 32, f"round coordinates {words} to float32", measure)


def _rounded(cloud: Cloud, origin: FloatArray) -> Cloud:
    rounded = (cloud.points - origin).astype(np.float32).astype(np.float64) + origin
    return replace(cloud, points=rounded)


def _search(pair: Pair, settings: TradeoffSettings, skipped: _Skipped) -> Iterator[Approximation]:
    for factor in _SEARCH_FACTORS[1:2] if settings.quick else _SEARCH_FACTORS:

        def measure(pair: Pair, seed: int, *, factor: float = factor) -> Candidate:
            return compare_by_approximate_search(pair.reference, pair.candidate, pair.settings, factor - 1)

        instruction = f"search points at most {factor:g} times as far as the closest ones (scipy)"
        yield Approximation(f"search within {factor:g}", SEARCH, "", factor, instruction, measure)


def _normals(pair: Pair, settings: TradeoffSettings, skipped: _Skipped) -> Iterator[Approximation]:
    if isinstance(pair.reference, Mesh) or pair.reference.normals is not None:
        skipped.append("neighbours of normals: the reference has normals")
        return
    for count in _NEIGHBORS[1:2] if settings.quick else _NEIGHBORS:

        def measure(pair: Pair, seed: int, *, count: int = count) -> Candidate:
            return replace(pair, settings=replace(pair.settings, normal_neighbors=count)).measure()

        instruction = f"estimate normals from {count} neighbours instead of {pair.settings.normal_neighbors}"
        yield Approximation(f"normals k={count}", NORMALS, "", count, instruction, measure)


def _icp(pair: Pair, settings: TradeoffSettings, skipped: _Skipped) -> Iterator[Approximation]:
    method = as_method(pair.settings.register)
    if not isinstance(method, IcpSettings):
        skipped.append(f"ICP: the registration is `{method.text}`")
        return
    spacing = 0.0
    if isinstance(pair.reference, Cloud) and len(pair.reference) > 1:
        spacing = median_spacing(Index(pair.reference.points))
    variants: list[tuple[str, float, str, IcpSettings]] = [
        (f"{count} points", count, f"register by at most {count:,} points", replace(method, max_sample=count))
        for count in (_ICP_POINTS[1:2] if settings.quick else _ICP_POINTS)
        if count < len(pair.candidate)  # else nothing would change
    ]
    if not settings.quick:
        variants += [
            (f"{n} iterations", n, f"register in at most {n} iterations per level", replace(method, max_iterations=n))
            for n in _ICP_ITERATIONS
        ]
        if spacing > 0:
            near = replace(method, max_correspondence_distance=_FINE_SPACINGS * spacing)
            variants.append(("one level", 1, "register without coarse correspondences", near))
    for name, level, instruction, icp in variants:

        def measure(pair: Pair, seed: int, *, icp: IcpSettings = icp) -> Candidate:
            return replace(pair, settings=replace(pair.settings, register=icp)).measure()

        yield Approximation(f"ICP {name}", ICP, "", level, instruction, measure)


def _decimation(pair: Pair, settings: TradeoffSettings, skipped: _Skipped) -> Iterator[Approximation]:
    if not isinstance(pair.reference, Mesh):
        skipped.append("decimation: the reference is no mesh")
        return
    if find_spec("pymeshlab") is None:
        library = LIBRARIES["pymeshlab"]
        skipped.append(f"decimation: {library.name} is not installed: pip install 'pcbench[{library.extra}]'")
        return
    for level in settings.levels:
        faces = max(4, round(level * len(pair.reference)))
        if faces > len(pair.reference):
            continue

        def measure(pair: Pair, seed: int, *, faces: int = faces) -> Candidate:
            assert isinstance(pair.reference, Mesh)
            return replace(pair, reference=decimate(pair.reference, faces)).measure()

        instruction = f"decimate the reference to {faces:,} faces by quadrics (pymeshlab)"
        yield Approximation(f"decimation {100 * level:g} %", DECIMATION, REFERENCE, level, instruction, measure)
