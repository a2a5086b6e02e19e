"""Depth maps by the bundled matcher: one stage per image and pass, so that a killed run loses at most one image.

The stage of an image depends on its own photograph and those of its sources only: adding an image elsewhere leaves the
other maps valid.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path

from pcbench.plugins.progress import with_time_left
from pcbench.plugins.stages import stage, stage_key
from reconstructors.mvs import patchmatch
from reconstructors.mvs.maps import write_map
from reconstructors.mvs.plan import MatchingPlan
from reconstructors.mvs.planar import fill_plain_surface
from reconstructors.mvs.sources import MatchedImage
from reconstructors.mvs.views import ViewCache, stage_location

PHOTOMETRIC_FOLDER, GEOMETRIC_FOLDER = "photometric", "geometric"  # in the workspace, with one folder per image


@dataclass(frozen=True, eq=False)
class Matching:
    """The images to match, and the plan.

    Args:
        photographs: views and maps of the images.
        views: stages of the views by image name.
        plan: matching effort.
        seed: seed of the random perturbations.
    """

    photographs: ViewCache
    views: Mapping[str, Path]
    plan: MatchingPlan
    seed: int

    def match_photometric(self, reference: MatchedImage, workspace: Path) -> Path:
        """Return the stage of an image's map from the photographs alone."""
        plan, photographs = self.plan, self.photographs
        names = (reference.name, *reference.sources)
        inputs = {
            "views": {name: stage_digest(self.views[name]) for name in names},
            "poses": {name: photographs.cameras[name].cam_from_world.matrix.tolist() for name in names},
            "depths": reference.depths,
            "levels": plan.levels,
            "iterations": plan.photometric_iterations,
            "seed": self.seed,
        }

        def make(folder: Path) -> None:
            reference_view, *source_views = (photographs.view(name) for name in names)
            depth_map = patchmatch.match(
                reference_view,
                source_views,
                reference.depths,
                levels=plan.levels,
                iterations=plan.photometric_iterations,
                seed=self.seed,
            )
            write_map(folder, depth_map)

        return stage(*stage_location(workspace / PHOTOMETRIC_FOLDER, reference.name), inputs, make)

    def refine_geometric(self, reference: MatchedImage, photometric: Mapping[str, Path], workspace: Path) -> Path:
        """Return the stage of an image's map that is refined with the depths of its sources, if these have maps.

        Plain surface is filled afterwards.
        """
        photographs = self.photographs
        sources = [name for name in reference.sources if name in photometric]
        names = (reference.name, *sources)
        inputs = {
            "photometric": {name: stage_digest(photometric[name]) for name in names},
            "iterations": self.plan.geometric_iterations,
        }

        def make(folder: Path) -> None:
            reference_view, *source_views = (photographs.view(name) for name in names)
            depth_map = patchmatch.refine(
                reference_view,
                source_views,
                [photographs.depth(photometric[name]) for name in sources],
                photographs.map(photometric[reference.name]),
                reference.depths,
                iterations=self.plan.geometric_iterations,
                seed=self.seed,
            )
            write_map(folder, fill_plain_surface(reference_view, source_views, depth_map))

        return stage(*stage_location(workspace / GEOMETRIC_FOLDER, reference.name), inputs, make)


def compute_bundled_maps(matching: Matching, references: Sequence[MatchedImage], workspace: Path) -> dict[str, Path]:
    """Compute the maps of all images and report progress; return their stages by image name."""
    photometric = {
        reference.name: matching.match_photometric(reference, workspace)
        for reference in with_time_left(references, "photometric depths")
    }
    return {
        reference.name: matching.refine_geometric(reference, photometric, workspace)
        for reference in with_time_left(references, "geometric depths")
    }


def stage_digest(stage_folder: Path) -> str:
    """Return a short digest of a stage's inputs and files."""
    key = stage_key(stage_folder)
    assert key is not None, stage_folder
    return sha256(key.encode()).hexdigest()
