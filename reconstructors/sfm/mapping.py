"""Cameras and points from verified matches: solved (incremental or global), or triangulated from given cameras."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any, Literal

from pcbench.errors import ReconstructionError
from pcbench.plugins.progress import progress
from pcbench.plugins.stages import stage, stage_key
from pcbench.scenes import Scene
from reconstructors.sfm.features import DATABASE, working_images
from reconstructors.sfm.model import Refine, check_written

Mapper = Literal["incremental", "global"]


def map_images(
    verified: Path, scene: Scene, workspace: Path, mapper: Mapper, refine: Refine, seed: int, name: str = ""
) -> Path:
    """Solve for cameras and points; return the stage's folder with a model per component, each in an arbitrary gauge.

    Args:
        verified: Stage with the verified matches.
        scene: Images.
        workspace: Folder of the stages.
        mapper: Incremental or global mapping.
        refine: Intrinsics to solve for.
        seed: Random seed.
        name: Name of the stage; that of the mapper if empty.
    """
    import pycolmap

    def make(folder: Path) -> None:
        images = working_images(scene, workspace)
        if mapper == "incremental":
            options = _incremental_options(refine, seed, len(scene))
            registered = 0

            def start() -> None:
                nonlocal registered
                registered = 2

            def count() -> None:
                nonlocal registered
                registered += 1
                progress(f"solving cameras: {registered} of {len(scene)} images")

            reports = {"initial_image_pair_callback": start, "next_image_callback": count}
            models = pycolmap.incremental_mapping(verified / DATABASE, images, folder, options, **reports)
            if all(model.num_reg_images() <= 2 for model in models.values()) and len(scene) > 2:
                _accept_little_parallax(options)
                for model in folder.iterdir():
                    shutil.rmtree(model)
                pycolmap.incremental_mapping(verified / DATABASE, images, folder, options, **reports)
        else:
            progress("solving all cameras at once")
            # The global mapper changes two-view geometries in the database: use a copy.
            database = folder / DATABASE
            shutil.copyfile(verified / DATABASE, database)
            pycolmap.global_mapping(database, images, folder, _global_options(refine, seed))
            database.unlink()
        for model in folder.iterdir():
            check_written(model)

    inputs = {"matches": stage_key(verified), "mapping": mapper, "refine": refine, "seed": seed}
    return stage(workspace, name or mapper, inputs, make)


def largest_component(mapped: Path, scene: Scene) -> tuple[Any, list[str]]:
    """Return the model with the most images, and notes on the components and images that are left out.

    Args:
        mapped: Folder of the models.
        scene: Images.

    Raises:
        ReconstructionError: No model has two images and points.
    """
    import pycolmap

    models = [pycolmap.Reconstruction(path) for path in sorted(mapped.iterdir()) if path.is_dir()]
    models = [model for model in models if model.num_reg_images() >= 2 and model.num_points3D() > 0]
    if not models:
        raise ReconstructionError(
            "no image registers: pairs were verified, but no two images could start a model; take more images with"
            " more overlap and sideways motion, or give cameras"
        )
    largest = max(models, key=lambda model: (model.num_reg_images(), model.num_points3D()))
    names = {image.name for image in largest.images.values() if image.has_pose}
    notes = []
    unregistered = [name for name in scene.images if name not in names]
    for model in models:
        names_apart = sorted({image.name for image in model.images.values() if image.has_pose}.difference(names))
        if model is not largest and names_apart:  # other components may have the same images
            notes.append(
                f"warning: {model.num_reg_images()} images form a separate model, which is left out:"
                f" {', '.join(names_apart)}; add images that connect the two"
            )
    if unregistered:
        share = f"{len(unregistered)} of {len(scene)} images"
        notes.append(f"warning: {share} are not registered and left out: {', '.join(unregistered)}")
    return largest, notes


def triangulate(verified: Path, scene: Scene, workspace: Path, seed: int) -> Path:
    """Triangulate points from the scene's given cameras; return the stage's folder, with the model in its folder 0."""
    import pycolmap

    def make(folder: Path) -> None:
        model = posed_model(verified / DATABASE, scene)
        (folder / "0").mkdir()
        pycolmap.triangulate_points(
            model,
            verified / DATABASE,
            working_images(scene, workspace),
            folder / "0",
            options=_incremental_options("none", seed, len(scene)),
            refine_intrinsics=False,
        )
        check_written(folder / "0")

    inputs = {"matches": stage_key(verified), "scene": scene.fingerprint(), "seed": seed}
    return stage(workspace, "triangulation", inputs, make)


def _incremental_options(refine: Refine, seed: int, images: int) -> Any:
    import pycolmap

    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = options.mapper.num_threads = 1
    options.random_seed = options.mapper.random_seed = options.triangulation.random_seed = seed
    options.min_model_size = min(3, images)
    options.triangulation.ignore_two_view_tracks = images > 2
    options.ba_refine_focal_length = refine in ("all", "focal")
    options.ba_refine_extra_params = refine in ("all", "distortion")
    options.mapper.abs_pose_refine_focal_length = refine in ("all", "focal")
    options.mapper.abs_pose_refine_extra_params = refine in ("all", "distortion")
    return options


def _accept_little_parallax(options: Any) -> None:
    """Let a model start from two images with little parallax, as in a forward walk.

    COLMAP relaxes the angle and the number of matches itself (16 to 4 degrees, 100 to 25), but never starts from two
    images of which one lies ahead of the other.
    """
    options.mapper.init_max_forward_motion = 1.0  # cosine of the angle between the motion and the optical axis
    options.mapper.init_min_tri_angle = 4.0  # degrees


def _global_options(refine: Refine, seed: int) -> Any:
    import pycolmap

    options = pycolmap.GlobalPipelineOptions()
    options.num_threads = options.mapper.num_threads = 1
    options.mapper.bundle_adjustment.ceres.solver_options.num_threads = 1
    options.mapper.bundle_adjustment.ceres.use_gpu = options.mapper.global_positioning.use_gpu = False
    for part in (options, options.mapper, options.mapper.rotation_averaging, options.mapper.global_positioning,
                 options.mapper.retriangulation):  # fmt: skip
        part.random_seed = seed
    options.mapper.bundle_adjustment.refine_focal_length = refine in ("all", "focal")
    options.mapper.bundle_adjustment.refine_extra_params = refine in ("all", "distortion")
    return options


def posed_model(database_file: Path, scene: Scene) -> Any:
    """Return a model of the database's images with the scene's cameras and no points."""
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
