"""What a bench says of one cloud: brought onto the reference as its gauge allows, then the whole comparison."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcbench.errors import InputError
from pcbench.geometry.cameras import Camera
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.crop import points_inside
from pcbench.geometry.mesh import Mesh, MeshIndex
from pcbench.geometry.neighbors import Index
from pcbench.geometry.normals import Surface
from pcbench.geometry.region_text import parse_region
from pcbench.geometry.transform import Similarity, format_matrix, robust_similarity
from pcbench.geometry.visibility import SEEN_BY, views
from pcbench.io import read_cloud
from pcbench.io.files import Warn, atomic_write
from pcbench.io.meshes import holds_mesh, read_mesh
from pcbench.measure.settings import Settings
from pcbench.plugins import Reconstruction
from pcbench.registration import METHODS, Registration, local_origin, parse_method
from pcbench.registration.result import UNOBSERVABLE, WEAKLY_OBSERVABLE
from pcbench.report import compare, document

BY_GAUGE = "gauge"
_MESH_SAMPLES = 1_000_000  # points that stand for a mesh as the reference


@dataclass(frozen=True, eq=False)
class Truth:
    """What clouds are measured against.

    Args:
        cloud: the reference.
        cameras: the true ones by image name, in its frame.
        visible: which of its points (N,) the cameras saw; None where that cannot be said.
        visibility: where that is from, or why it cannot be said.
    """

    cloud: Cloud
    cameras: Mapping[str, Camera]
    visible: NDArray[np.bool_] | None
    visibility: str


def read_truth(reference: Path, mesh: Path | None, cameras: Mapping[str, Camera], warn: Warn) -> Truth:
    """The reference and what the cameras saw of it: by its attribute `visible`, else by rays against a mesh.

    Args:
        reference: a cloud or a mesh, which is sampled by area.
        mesh: of the same surface, its faces anticlockwise seen from outside.
        cameras: the true ones by image name.
        warn: called with one line for each thing left out.

    Raises:
        InputError: a file is not usable.
    """
    surface = read_mesh(mesh, on_warning=warn) if mesh is not None else None
    if holds_mesh(reference):
        whole = read_mesh(reference, on_warning=warn)
        surface = whole if surface is None else surface
        cloud = whole.sample(_MESH_SAMPLES)
    else:
        cloud = read_cloud(reference, on_warning=warn)
    if mesh is None and "visible" in cloud.attributes:
        seen = np.asarray(cloud.attributes["visible"]) != 0
        return Truth(cloud, cameras, *_some(seen, "the reference's attribute `visible`"))
    if surface is None:
        return Truth(cloud, cameras, None, "the reference has no attribute `visible`, and no mesh is given")
    if not cameras:
        return Truth(cloud, cameras, None, "the scene has no cameras")
    how = f"seen by {SEEN_BY} of the scene's {len(cameras)} cameras: rays against {mesh or reference}"
    return Truth(cloud, cameras, *_some(seen_points(cloud, surface, cameras), how))


def _some(seen: NDArray[np.bool_], how: str) -> tuple[NDArray[np.bool_] | None, str]:
    return (seen, how) if seen.any() else (None, f"none of its points is visible ({how})")


def seen_points(cloud: Cloud, mesh: Mesh, cameras: Mapping[str, Camera]) -> NDArray[np.bool_]:
    """Which points (N,) of a cloud of the mesh's surface at least three cameras see: from the place on the mesh that is
    nearest to them, which takes a scanner's noise out.
    """
    index = MeshIndex(mesh)
    _, closest, faces = index.query(cloud.points)
    counts = views(index, list(cameras.values()), closest, mesh.normals()[faces], enough=SEEN_BY)
    seen: NDArray[np.bool_] = counts >= SEEN_BY
    return seen


class Alignment(NamedTuple):
    """How a cloud comes onto the reference: `cameras` by a transform that was found by them, else as `compare` has it;
    and what is to be said of it.
    """

    how: str
    transform: Similarity | None = None
    notes: tuple[str, ...] = ()


def alignment(made: Reconstruction, cameras: Mapping[str, Camera]) -> Alignment:
    """The registration that a cloud's gauge asks for.

    What is in the world of the scene is measured as it stands: where it lies is part of what it claims, and fitting
    would take errors away. A frame of its own is no error; it is brought onto the reference by the centres of its
    cameras, which does not depend on the cloud that is judged. Without them the surfaces decide, from any pose where
    KISS-Matcher is installed. Only an arbitrary gauge gets a scale.
    """
    if made.gauge == "georeferenced":
        return Alignment("none")
    free_scale = made.gauge == "arbitrary"
    names = sorted(set(made.cameras) & set(cameras))
    notes: tuple[str, ...] = ()
    if names:
        found = np.stack([made.cameras[name].position for name in names])
        true = np.stack([cameras[name].position for name in names])
        try:
            fit = robust_similarity(found, true, with_scale=free_scale)
        except InputError as error:
            notes = (f"not registered by cameras: {error}",)
        else:
            errors = np.linalg.norm(fit.apply(found) - true, axis=1)
            spread = f"{np.median(errors):.3g} (median), {errors.max():.3g} (largest)"
            note = f"registered by {len(names)} cameras, with errors of {spread}"
            return Alignment("cameras", fit, (note,))
    fine = "similarity" if free_scale else "icp"
    if find_spec("kiss_matcher") is None:
        return Alignment(
            fine, None, (*notes, f"`{fine}` starts from where the cloud is: kiss-matcher is not installed")
        )
    return Alignment("global-similarity" if free_scale else "global", None, notes)


@dataclass(frozen=True)
class Rules:
    """How every cloud is measured.

    Args:
        register: `gauge`, or one of `pcbench.registration.METHODS` for all.
        crop: see `pcbench.geometry.region_text.parse_region`.
        threshold: of the F-score; None: 5 times the reference's median spacing, where its sampling hardly counts.
    """

    register: str = BY_GAUGE
    crop: str = "none"
    threshold: float | None = None


def check_rules(rules: Rules, truth: Truth) -> None:
    """Say before anything runs that no cloud could be measured like this.

    Raises:
        InputError: there is no such registration or region, or it leaves nothing of the reference.
    """
    kind, _, path = rules.register.partition(":")
    names_file = path and kind in ("points", "matrix")
    if not names_file and rules.register not in (BY_GAUGE, *METHODS):
        expected = ", ".join((BY_GAUGE, *METHODS))
        raise InputError(f"unknown registration {rules.register!r}: expected {expected}")
    if names_file:
        parse_method(rules.register)  # which reads the file
    if rules.threshold is None and Surface(Index(truth.cloud.points)).spacing == 0:
        raise InputError("the reference has no two points apart, so no spacing: give --threshold")
    points_inside(truth.cloud.points, parse_region(rules.crop, truth.cloud), rules.crop, "the reference's")


def score(truth: Truth, made: Reconstruction, rules: Rules, folder: Path) -> dict[str, Any]:
    """Numbers of one cloud, JSON-ready; writes T.txt, the matrix candidate -> reference, into the folder.

    Raises:
        InputError, RegistrationError: it cannot be measured.
    """
    chosen = alignment(made, truth.cameras) if rules.register == BY_GAUGE else Alignment(rules.register)
    matrix = folder / "T.txt"
    if chosen.transform is not None:
        _write(matrix, chosen.transform)
    settings = Settings(
        register=chosen.how if chosen.transform is None else f"matrix:{matrix}",
        crop=rules.crop,
        thresholds=None if rules.threshold is None else (rules.threshold,),
    )
    comparison = compare(truth.cloud, {"cloud": made.cloud}, settings)
    result = comparison.candidates[0]
    _write(matrix, result.registration.T_reference_candidate)
    whole = document(comparison)["candidates"][0]
    metrics, at = result.metrics, result.metrics.fscores[-1]
    return {
        "registration": chosen.how,
        "d1_c2r": metrics.d1_mse.accuracy.value,
        "d1_r2c": metrics.d1_mse.completeness.value,
        "mean_c2r": metrics.mean_distance.accuracy.value,
        "mean_r2c": metrics.mean_distance.completeness.value,
        "chamfer": metrics.chamfer.sum_unsquared.value,
        "hausdorff": metrics.hausdorff.symmetric_max,
        "threshold": at.threshold,
        "precision": at.precision.value,
        "recall": at.recall.value,
        "fscore": at.fscore.value,
        "recall_visible": _recall_visible(truth, made.cloud, result.registration, at.threshold, rules.crop),
        "notes": [*chosen.notes, *map(str, result.warnings), *_of_registration(result.registration)],
        "comparison": whole,
    }


def _recall_visible(
    truth: Truth, cloud: Cloud, registration: Registration, threshold: float, crop: str
) -> float | None:
    """Share of the reference's visible points (inside the region) that the cloud comes as near to as the threshold."""
    if truth.visible is None:
        return None
    region = parse_region(crop, truth.cloud)
    counted = truth.visible if region is None else truth.visible & region.contains(truth.cloud.points)
    if not counted.any():
        return None
    origin = local_origin(truth.cloud)
    aligned = Index(registration.T_local.apply(cloud.points - origin))
    return float(np.mean(aligned.query(truth.cloud.points[counted] - origin).distances <= threshold))


def _of_registration(registration: Registration) -> list[str]:
    """Its warnings. What the geometry does not fix is none where the pose is not from the geometry."""
    left_out = (UNOBSERVABLE, WEAKLY_OBSERVABLE) if registration.converged is None else ()
    return [notice.text for notice in registration.warnings if notice.code not in left_out]


def _write(path: Path, transform: Similarity) -> None:
    with atomic_write(path) as file:
        file.write(format_matrix(transform).encode())
