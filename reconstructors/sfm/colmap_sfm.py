"""Sparse structure from motion by COLMAP, through pycolmap (Schonberger and Frahm 2016; Pan et al. 2024, global).

The same input gives the same cloud: images get their numbers in the order of their names, pairs are listed, every
random choice has a seed, and what is not associative in floating point runs on one thread.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal

import numpy as np

from pcbench.errors import InputError, ReconstructionError
from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.cameras import Camera, Intrinsics
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.transform import Similarity, fit_similarity, robust_similarity
from pcbench.io.colmap_model import intrinsics_from_colmap
from pcbench.plugins import Gauge, Reconstruction
from pcbench.plugins.stages import stage, stage_key
from pcbench.scenes.scene import Scene
from reconstructors.sfm.alignment import camera_errors, moved
from reconstructors.sfm.control import ControlPoint, Refine, adjust, describe, measure, read_control
from reconstructors.sfm.epipolar import share_on_epipolar_lines
from reconstructors.sfm.pairs import Matching, choose_pairs

_FEW_INLIERS = 15  # COLMAP's default: a pair with fewer is not used
_FEW_FEATURES = 50  # below it hardly any pair has that many after ratio test and RANSAC
# With true cameras nearly all verified matches agree; with those of other images a few do by chance.
_LEAST_AGREEING = 0.2
_PARALLEL_DEG = 12.0  # of a survey's images from their mean: a flight is unsteady by a few
_MISFIT = 0.1  # of the cameras' spread: GPS of hand-held cameras is as bad, and then says nothing about pose or scale
_DATABASE = "database.db"


@dataclass(frozen=True)
class ColmapSfm:
    """Sparse points and cameras by COLMAP: SIFT, verified matches, incremental or global mapping; triangulation alone
    where the cameras are given.

    poses: `given` takes the scene's cameras as they are, `solve` finds them; `auto` is given where there are some.
    mapping: of solved poses. matching: which pairs; `auto` by the number of images and what is known of them.
    features: SIFT features an image, at most. upsample: find them at twice the size too: finer and more, three times
    the time. refine: which intrinsics are solved for: `all`, `focal` length, `distortion`, or `none`; the rest stays as
    the scene's cameras say, or as guessed (1.2 image widths, no distortion) where EXIF has no focal length.
    align: solved poses onto control points, the scene's cameras or GPS; `auto` takes the first there is. control: their
    file, lines of name, x y z, image, pixel x y; they are held fast in a last adjustment, where those whose names end
    in * are checks only. min_views: points that fewer images show are left out; one of two
    images may be anywhere along their common plane. undistort: leave undistorted images and model in the workspace.
    """

    poses: Literal["auto", "given", "solve"] = "auto"
    mapping: Literal["incremental", "global"] = "incremental"
    matching: Matching = "auto"
    features: int = 8192
    upsample: bool = True
    refine: Refine = "all"
    align: Literal["auto", "cameras", "control", "gps", "none"] = "auto"
    control: Path | None = None
    min_views: int = 3
    undistort: bool = False
    seed: int = 0

    def __post_init__(self) -> None:
        if self.features < _FEW_FEATURES:
            raise ValueError(f"expected at least {_FEW_FEATURES} features an image, got {self.features}")
        if self.min_views < 2:
            raise ValueError(f"expected points of at least 2 images, got min_views={self.min_views}")
        if not 0 <= self.seed < 2**31:
            raise ValueError(f"expected a seed from 0 to 2^31 - 1, got {self.seed}")
        if self.align == "control" and self.control is None:
            raise ValueError("align=control needs control=FILE")

    @classmethod
    def missing(cls) -> str | None:
        return None if find_spec("pycolmap") else "pycolmap is not installed: pip install 'pcbench[sfm]'"

    def reconstruct(self, scene: Scene, workspace: Path) -> Reconstruction:
        import pycolmap

        pycolmap.logging.minloglevel = pycolmap.logging.Level.WARNING.value
        notes: list[str] = []
        control = read_control(self.control) if self.control is not None else ()
        given = self.poses == "given" or (self.poses == "auto" and bool(scene.cameras))
        if given and control:
            raise InputError(
                "the scene gives the cameras: control points are used where they are solved for (poses=solve)"
            )
        scene = _usable(scene, given, notes)

        gauge: Gauge
        features = self._features(scene, workspace)
        counts = _check_features(features, scene, notes)
        matches = self._verified(scene, workspace, self._matches(scene, workspace, features, notes))
        _check_pairs(matches, len(scene), counts)
        if given:
            model = self._triangulate(scene, workspace, matches, notes)
            gauge, in_metres = "georeferenced", scene.origin is not None
        else:
            model = self._map(scene, workspace, matches, notes)
            if self.refine != "none" and (angle := _largest_angle(_cameras(model))) < _PARALLEL_DEG:
                notes.append(
                    f"all images look the same way within {angle:.0f} degrees: they hardly fix the lens, and with a"
                    " wrong one the cloud is stretched or bent; add oblique images or control points, or give the lens"
                    " (--set refine=none)"
                )
            model, gauge, in_metres = self._align(model, scene, control, notes)
        result = workspace / "model"
        shutil.rmtree(result, ignore_errors=True)
        result.mkdir()
        model.write(result)
        if self.undistort:
            _undistort(workspace, _images(scene, workspace))
        return Reconstruction(self._cloud(model, "m" if in_metres else None, notes), gauge, _cameras(model), notes)

    def _features(self, scene: Scene, workspace: Path) -> Path:
        """SIFT features of every image, in a database."""
        import pycolmap

        groups = [names for _, names in _groups(scene)]

        def make(folder: Path) -> None:
            images, database = _images(scene, workspace), folder / _DATABASE
            masks = _write_masks(scene, folder)
            pycolmap.Database.open(database).close()
            # Importing first fixes the images' numbers: extraction on several threads would shuffle them.
            for names in groups:
                pycolmap.import_images(
                    database, images, camera_mode=pycolmap.CameraMode.SINGLE, image_names=list(names)
                )
            reader = pycolmap.ImageReaderOptions()
            if masks is not None:
                reader.mask_path = str(masks)
            extraction = pycolmap.FeatureExtractionOptions()
            extraction.sift.max_num_features = self.features
            extraction.sift.first_octave = -1 if self.upsample else 0
            pycolmap.extract_features(
                database,
                images,
                image_names=list(scene.images),
                reader_options=reader,
                extraction_options=extraction,
                device=pycolmap.Device.cpu,
            )

        inputs = {
            "pycolmap": pycolmap.__version__,
            "scene": scene.fingerprint(cameras=False),
            "sharing a lens": groups,
            "features": self.features,
            "upsample": self.upsample,
        }
        return stage(workspace, "features", inputs, make)

    def _matches(self, scene: Scene, workspace: Path, features: Path, notes: list[str]) -> Path:
        """Matches of the chosen pairs, in a copy of the database."""
        import pycolmap

        how, pairs = choose_pairs(scene, self.matching)
        notes.append(f"{how} matching, {len(pairs)} pairs")

        def make(folder: Path) -> None:
            shutil.copyfile(features / _DATABASE, folder / _DATABASE)
            names = _rename(folder / _DATABASE, {})
            numbers = {name: number for number, name in names.items()}
            # COLMAP's list of pairs is cut at spaces: it gets the images' numbers for names.
            lines = [f"{numbers[a]} {numbers[b]}\n" for a, b in pairs]
            (folder / "pairs.txt").write_text("".join(lines), encoding="utf-8")
            pairing = pycolmap.ImportedPairingOptions()
            pairing.match_list_path = str(folder / "pairs.txt")
            options = pycolmap.FeatureMatchingOptions()
            options.skip_geometric_verification = True
            pycolmap.match_image_pairs(
                folder / _DATABASE, matching_options=options, pairing_options=pairing, device=pycolmap.Device.cpu
            )
            _rename(folder / _DATABASE, names)

        return stage(workspace, "matches", {"features": stage_key(features), "pairs": pairs}, make)

    def _verified(self, scene: Scene, workspace: Path, matches: Path) -> Path:
        """The matches that agree on a geometry, through the scene's lenses where they are known."""
        import pycolmap

        groups = _groups(scene)

        def make(folder: Path) -> None:
            shutil.copyfile(matches / _DATABASE, folder / _DATABASE)
            _set_lenses(folder / _DATABASE, groups)
            options = pycolmap.TwoViewGeometryOptions()
            options.ransac.random_seed = self.seed
            pycolmap.geometric_verification(folder / _DATABASE, two_view_geometry_options=options)

        inputs = {"matches": stage_key(matches), "lenses": repr(groups), "seed": self.seed}
        return stage(workspace, "verified", inputs, make)

    def _incremental_options(self) -> Any:
        import pycolmap

        options = pycolmap.IncrementalPipelineOptions()
        options.num_threads = options.mapper.num_threads = 1
        options.random_seed = options.mapper.random_seed = options.triangulation.random_seed = self.seed
        options.min_model_size = 3
        options.ba_refine_focal_length = self.refine in ("all", "focal")
        options.ba_refine_extra_params = self.refine in ("all", "distortion")
        options.mapper.abs_pose_refine_focal_length = self.refine in ("all", "focal")
        options.mapper.abs_pose_refine_extra_params = self.refine in ("all", "distortion")
        return options

    def _global_options(self) -> Any:
        import pycolmap

        options = pycolmap.GlobalPipelineOptions()
        options.num_threads = options.mapper.num_threads = 1
        options.mapper.bundle_adjustment.ceres.solver_options.num_threads = 1
        for part in (options, options.mapper, options.mapper.rotation_averaging, options.mapper.global_positioning,
                     options.mapper.retriangulation):  # fmt: skip
            part.random_seed = self.seed
        options.mapper.bundle_adjustment.refine_focal_length = self.refine in ("all", "focal")
        options.mapper.bundle_adjustment.refine_extra_params = self.refine in ("all", "distortion")
        return options

    def _map(self, scene: Scene, workspace: Path, matches: Path, notes: list[str]) -> Any:
        """Cameras and points of the largest component, in an arbitrary gauge."""
        import pycolmap

        incremental = self.mapping == "incremental"

        def make(folder: Path) -> None:
            images = _images(scene, workspace)
            if incremental:
                pycolmap.incremental_mapping(matches / _DATABASE, images, folder, self._incremental_options())
            else:
                # The global mapper changes two-view geometries in the database.
                database = folder / _DATABASE
                shutil.copyfile(matches / _DATABASE, database)
                pycolmap.global_mapping(database, images, folder, self._global_options())
                database.unlink()

        inputs = {"matches": stage_key(matches), "mapping": self.mapping, "refine": self.refine, "seed": self.seed}
        folder = stage(workspace, "mapping", inputs, make)
        models = [pycolmap.Reconstruction(path) for path in sorted(folder.iterdir()) if path.is_dir()]
        models = [model for model in models if model.num_reg_images() >= 2 and model.num_points3D() > 0]
        if not models:
            raise ReconstructionError(
                "nothing registers: pairs were verified, but no two images start a model; take more images with more"
                " overlap and sideways motion, or give cameras"
            )
        largest = max(models, key=lambda model: (model.num_reg_images(), model.num_points3D()))
        names = sorted(image.name for image in largest.images.values() if image.has_pose)
        if len(models) > 1:
            sizes = ", ".join(str(model.num_reg_images()) for model in models)
            notes.append(f"{len(models)} components (of {sizes} images): the largest is kept")
        if left := sorted(set(scene.images) - set(names)):
            notes.append(f"{len(left)} of {len(scene)} images are not registered: {_some(left)}")
        notes.append(_quality(largest))
        return largest

    def _triangulate(self, scene: Scene, workspace: Path, matches: Path, notes: list[str]) -> Any:
        """Points of the given cameras, in their frame."""
        import pycolmap

        share = share_on_epipolar_lines(matches / _DATABASE, scene.cameras)
        if share < _LEAST_AGREEING:
            raise ReconstructionError(
                f"the given cameras do not fit the images: {share:.1%} of the verified matches agree with them;"
                " check them (pcbench scene SCENE --figure cameras.png), or solve them (--set poses=solve)"
            )

        def make(folder: Path) -> None:
            model = _posed_model(matches / _DATABASE, scene)
            options = self._incremental_options()
            (folder / "0").mkdir()
            images = _images(scene, workspace)
            pycolmap.triangulate_points(
                model, matches / _DATABASE, images, folder / "0", options=options, refine_intrinsics=False
            )

        inputs = {"matches": stage_key(matches), "scene": scene.fingerprint(), "seed": self.seed}
        model = pycolmap.Reconstruction(stage(workspace, "triangulation", inputs, make) / "0")
        notes.append(f"{share:.0%} of the verified matches agree with the given cameras; {_quality(model)}")
        return model

    def _align(
        self, model: Any, scene: Scene, control: tuple[ControlPoint, ...], notes: list[str]
    ) -> tuple[Any, Gauge, bool]:
        """The model in the world of control points, cameras or GPS, in this order or as asked for; its gauge then, and
        whether that is in metres. Control points are held fast while everything is adjusted once more.
        """
        registered = _cameras(model)
        ways: dict[str, Callable[[], tuple[Similarity, str]]] = {
            "control": lambda: _onto_control(registered, control, scene.image_scale),
            "cameras": lambda: _onto_cameras(registered, scene.cameras),
            "gps": lambda: _onto_gps(registered, scene),
        }
        there = {
            "cameras": bool(scene.cameras),
            "control": bool(control),
            "gps": len(scene.measured_positions()[0]) >= 3,
        }
        chosen = next((way for way in ways if there[way]), "none") if self.align == "auto" else self.align
        if chosen == "none":
            return model, "arbitrary", False
        if not there[chosen]:
            raise InputError(f"align={chosen} needs {'three positions' if chosen == 'gps' else chosen} in the scene")
        try:
            transform, note = ways[chosen]()
        except InputError as error:
            if self.align != "auto":
                raise ReconstructionError(f"cannot be aligned to {chosen}: {error}") from error
            notes.append(f"not aligned to {chosen}: {error}")
            return model, "arbitrary", False
        _transform(model, transform)
        notes.append(note)
        if chosen == "control":
            held = [point for point in control if not point.is_check]
            model = adjust(model, held, scene.image_scale, self.refine)
            after = describe(measure(_cameras(model), control, scene.image_scale))
            notes.append(f"adjusted with the control points held fast: {after}; {_quality(model)}")
        return model, "georeferenced", chosen == "gps" or (chosen == "cameras" and scene.origin is not None)

    def _cloud(self, model: Any, unit: str | None, notes: list[str]) -> Cloud:
        """The points that enough images show, in the order of their numbers."""
        everything = [point for _, point in sorted(model.points3D.items())]
        views = np.array([_views(point) for point in everything], dtype=np.int32)
        points = [point for point, n in zip(everything, views, strict=True) if n >= self.min_views]
        if not points:
            raise ReconstructionError(
                f"none of {len(everything)} points is shown by {self.min_views} images: take more images, or --set"
                " min_views=2"
            )
        if len(points) < len(everything):
            notes.append(f"{len(everything) - len(points)} points of fewer than {self.min_views} images are left out")
        return Cloud(
            np.array([point.xyz for point in points]),
            colors=np.array([point.color for point in points], dtype=np.uint8),
            attributes={
                "reprojection_error": np.array([point.error for point in points]),
                "track_length": views[views >= self.min_views],
            },
            unit=unit,
        )


def _usable(scene: Scene, given: bool, notes: list[str]) -> Scene:
    """The images that can take part.

    Raises:
        InputError: they are fewer than two, or have no cameras though `given` says so.
    """
    if given:
        if not scene.cameras:
            raise InputError("poses=given needs cameras in the scene: a COLMAP model, transforms.json or the like")
        if bare := sorted(set(scene.images) - set(scene.cameras)):
            notes.append(f"{len(bare)} of {len(scene)} images without a camera are left out: {_some(bare)}")
            scene = scene.select(set(scene.cameras))
    if len(scene) < 2:
        raise InputError(f"expected at least two images, got {len(scene)}")
    return scene


def _groups(scene: Scene) -> list[tuple[Intrinsics | None, tuple[str, ...]]]:
    """Images that share a lens: the same known intrinsics, or the same size where they are not known."""
    found: dict[Any, list[str]] = {}
    for name in scene.images:
        camera = scene.cameras.get(name)
        found.setdefault(camera.intrinsics if camera else scene.size(name), []).append(name)
    return [(key if isinstance(key, Intrinsics) else None, tuple(names)) for key, names in found.items()]


def _set_lenses(database_file: Path, groups: Sequence[tuple[Intrinsics | None, tuple[str, ...]]]) -> None:
    """Give the known lenses to their images in a database."""
    import pycolmap

    known = {name: lens for lens, names in groups for name in names}
    database = pycolmap.Database.open(database_file)
    for number, name in sorted({image.camera_id: image.name for image in database.read_all_images()}.items()):
        if (k := known[name]) is not None:
            # What is solved for later should be no more than lenses have: pixels are square where they were.
            radial = k.fx == k.fy and not any(k.distortion[2:])
            model, numbers = "OPENCV", [k.fx, k.fy, k.cx, k.cy, *k.distortion]
            if radial:
                model, numbers = "RADIAL", [k.fx, k.cx, k.cy, *k.distortion[:2]]
            lens = pycolmap.Camera(camera_id=number, model=model, width=k.width, height=k.height, params=numbers)
            lens.has_prior_focal_length = True
            database.update_camera(lens)
    database.close()


def _rename(database_file: Path, names: Mapping[int, str]) -> dict[int, str]:
    """Give images in a database names by their numbers, where there is none the number itself; the names before."""
    import pycolmap

    database = pycolmap.Database.open(database_file)
    before = {}
    for image in database.read_all_images():
        before[int(image.image_id)] = str(image.name)
        image.name = names.get(int(image.image_id), str(image.image_id))
        database.update_image(image)
    database.close()
    return before


def _images(scene: Scene, workspace: Path) -> Path:
    """The folder of the images at the working size: their own, or a stage with smaller ones."""
    if scene.image_scale == 1:
        return scene.folder
    inputs = {"scene": scene.fingerprint(cameras=False)}
    return stage(workspace, "images", inputs, lambda folder: scene.write_images(folder))


def _write_masks(scene: Scene, folder: Path) -> Path | None:
    """The masks at the working size, under the names that COLMAP looks for."""
    from PIL import Image

    for name in scene.masks:
        path = folder / "masks" / f"{name}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        mask = scene.read_mask(name)
        assert mask is not None
        Image.fromarray(np.where(mask, np.uint8(255), np.uint8(0))).save(path)
    return folder / "masks" if scene.masks else None


def _check_features(features: Path, scene: Scene, notes: list[str]) -> dict[str, int]:
    """Features by image name.

    Raises:
        ReconstructionError: fewer than two images have enough of them.
    """
    import pycolmap

    database = pycolmap.Database.open(features / _DATABASE)
    counts = {image.name: int(database.num_keypoints_for_image(image.image_id)) for image in database.read_all_images()}
    database.close()
    if poor := sorted(name for name in scene.images if counts.get(name, 0) < _FEW_FEATURES):
        if len(scene) - len(poor) < 2:
            raise ReconstructionError(
                f"too few features: {len(poor)} of {len(scene)} images have fewer than {_FEW_FEATURES}"
                f" ({poor[0]}: {counts.get(poor[0], 0)}): the images are blank, blurred, masked or too small"
            )
        notes.append(f"{len(poor)} images have fewer than {_FEW_FEATURES} features: {_some(poor)}")
    return counts


def _check_pairs(matches: Path, images: int, counts: Mapping[str, int]) -> None:
    """Say that no two images show the same scene.

    Raises:
        ReconstructionError: no pair has enough verified matches.
    """
    import pycolmap

    database = pycolmap.Database.open(matches / _DATABASE)
    _, inliers = database.read_two_view_geometry_num_inliers()
    database.close()
    if max(inliers, default=0) < _FEW_INLIERS:
        raise ReconstructionError(
            f"no pair verified: {images} images have {int(np.median(list(counts.values())))} features (median), but no"
            " two agree on a geometry: they show different things, or the overlap is too small"
        )


def _posed_model(database_file: Path, scene: Scene) -> Any:
    """A model of the database's images with the scene's cameras, without points."""
    import pycolmap

    model = pycolmap.Reconstruction()
    database = pycolmap.Database.open(database_file)
    for camera in database.read_all_cameras():
        model.add_camera_with_trivial_rig(camera)
    for image in sorted(database.read_all_images(), key=lambda image: int(image.image_id)):
        pose = scene.cameras[image.name].cam_from_world
        rigid = pycolmap.Rigid3d(pycolmap.Rotation3d(pose.rotation), pose.translation)
        posed = pycolmap.Image(name=image.name, camera_id=image.camera_id, image_id=image.image_id)
        model.add_image_with_trivial_frame(posed, rigid)
    database.close()
    return model


def _onto_cameras(found: Mapping[str, Camera], given: Mapping[str, Camera]) -> tuple[Similarity, str]:
    names = sorted(set(found) & set(given))
    candidate = np.array([found[name].position for name in names]).reshape(-1, 3)
    reference = np.array([given[name].position for name in names]).reshape(-1, 3)
    fit = robust_similarity(candidate, reference)
    positions, angles = camera_errors({name: moved(camera, fit) for name, camera in found.items()}, given)
    _check_fit(positions, reference)
    return fit, (
        f"aligned to {len(names)} cameras: position errors {np.median(positions):.3g} (median), {positions.max():.3g}"
        f" (largest); rotation errors {np.median(angles):.3g} and {angles.max():.3g} degrees"
    )


def _onto_gps(found: Mapping[str, Camera], scene: Scene) -> tuple[Similarity, str]:
    measured, frame = scene.measured_positions()
    names = sorted(set(found) & set(measured))
    candidate = np.array([found[name].position for name in names]).reshape(-1, 3)
    reference = np.array([measured[name] for name in names]).reshape(-1, 3)
    fit = robust_similarity(candidate, reference)
    errors = fit.apply(candidate) - reference
    _check_fit(np.linalg.norm(errors, axis=1), reference)
    across, up = np.median(np.linalg.norm(errors[:, :2], axis=1)), np.median(np.abs(errors[:, 2]))
    return fit, (
        f"aligned to the GPS of {len(names)} images, {frame}: median error {across:.2f} m across, {up:.2f} m in height"
    )


def _check_fit(errors: FloatArray, positions: FloatArray) -> None:
    """Raise an InputError where solved cameras are so far from the known positions (N, 3) that one of both is wrong."""
    spread = float(np.sqrt(np.square(positions - positions.mean(axis=0)).sum(axis=1).mean()))
    error = float(np.median(errors))
    if error > _MISFIT * spread:
        raise InputError(
            f"solved positions are off by {error:.3g} (median) where the known ones spread over {spread:.3g}: the"
            " solution is wrong, or they are"
        )


def _onto_control(
    found: Mapping[str, Camera], control: tuple[ControlPoint, ...], scale: float
) -> tuple[Similarity, str]:
    """By the control points that two or more registered images show; check points are measured alone."""
    measured = measure(found, control, scale)
    used = [m for m in measured if not m.point.is_check]
    if len(used) < 3:
        raise InputError(f"expected three control points in two registered images each, got {len(used)}")
    fit = fit_similarity(np.stack([m.at for m in used]), np.stack([m.point.position for m in used]))
    moved_there = [m._replace(at=fit.apply(m.at[None])[0]) for m in measured]
    return fit, f"aligned to {describe(moved_there)}"


def _transform(model: Any, transform: Similarity) -> None:
    import pycolmap

    rotation = pycolmap.Rotation3d(transform.rotation)
    model.transform(pycolmap.Sim3d(transform.scale, rotation, transform.translation))


def _cameras(model: Any) -> dict[str, Camera]:
    """The registered cameras by image name, sorted."""
    cameras = {}
    for image in sorted(model.images.values(), key=lambda image: str(image.name)):
        if image.has_pose:
            lens, pose = model.cameras[image.camera_id], image.cam_from_world()
            intrinsics = intrinsics_from_colmap(
                lens.model_name, lens.width, lens.height, [float(v) for v in lens.params]
            )
            motion = Similarity(pose.rotation.matrix(), np.array(pose.translation))
            cameras[str(image.name)] = Camera(str(image.name), intrinsics, motion)
    return cameras


def _largest_angle(cameras: Mapping[str, Camera]) -> float:
    """Degrees between any camera's direction and the mean of them."""
    directions = np.stack([camera.direction for camera in cameras.values()])
    mean = directions.mean(axis=0)
    cosines = directions @ mean / max(float(np.linalg.norm(mean)), 1e-12)
    return float(np.degrees(np.arccos(np.clip(cosines.min(), -1, 1))))


def _views(point: Any) -> int:
    """The number of images that show a point: a track may have two features in one image."""
    return len({element.image_id for element in point.track.elements})


def _undistort(workspace: Path, images: Path) -> None:
    """`undistorted/images` and `undistorted/sparse`: pinholes, as dense methods want them."""
    import pycolmap

    shutil.rmtree(workspace / "undistorted", ignore_errors=True)
    pycolmap.undistort_images(workspace / "undistorted", workspace / "model", images)


def _quality(model: Any) -> str:
    error, length = model.compute_mean_reprojection_error(), model.compute_mean_track_length()
    return f"mean reprojection error {error:.3f} px, mean track length {length:.2f}"


def _some(names: list[str]) -> str:
    return ", ".join(names[:3]) + (", ..." if len(names) > 3 else "")
