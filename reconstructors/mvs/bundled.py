"""The maps of all images by the bundled matcher: a stage for each image and pass, so that a killed run loses one image.

An image's stage depends on its own photograph and those of its sources, on nothing else: a further image elsewhere
leaves the maps of the others as they are.
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
from reconstructors.mvs.sources import MatchedImage
from reconstructors.mvs.views import Photographs, in_folder

PHOTOMETRIC, GEOMETRIC = "photometric", "geometric"  # in the workspace, with a folder for each image


@dataclass(frozen=True, eq=False)
class Matching:
    """The images to match, and how.

    Args:
        views: the stages of the views by image name.
    """

    photographs: Photographs
    views: Mapping[str, Path]
    plan: MatchingPlan
    seed: int

    def photometric(self, reference: MatchedImage, workspace: Path) -> Path:
        """The stage of an image's map by the photographs alone."""
        plan, photographs = self.plan, self.photographs
        names = (reference.name, *reference.sources)
        inputs = {
            "views": {name: digest_of(self.views[name]) for name in names},
            "poses": {name: photographs.cameras[name].cam_from_world.matrix.tolist() for name in names},
            "depths": reference.depths,
            "levels": plan.levels,
            "iterations": plan.iterations,
            "seed": self.seed,
        }

        def make(folder: Path) -> None:
            own, *others = (photographs.view(name) for name in names)
            made = patchmatch.match(
                own, others, reference.depths, levels=plan.levels, iterations=plan.iterations, seed=self.seed
            )
            write_map(folder, made)

        return stage(*in_folder(workspace / PHOTOMETRIC, reference.name), inputs, make)

    def geometric(self, reference: MatchedImage, photometric: Mapping[str, Path], workspace: Path) -> Path:
        """The stage of an image's map with the depths of its sources, as far as these have some."""
        photographs = self.photographs
        sources = [name for name in reference.sources if name in photometric]
        names = (reference.name, *sources)
        inputs = {
            "photometric": {name: digest_of(photometric[name]) for name in names},
            "iterations": self.plan.geometric,
        }

        def make(folder: Path) -> None:
            own, *others = (photographs.view(name) for name in names)
            made = patchmatch.refine(
                own,
                others,
                [photographs.depth(photometric[name]) for name in sources],
                photographs.map(photometric[reference.name]),
                reference.depths,
                iterations=self.plan.geometric,
                seed=self.seed,
            )
            write_map(folder, made)

        return stage(*in_folder(workspace / GEOMETRIC, reference.name), inputs, make)


def bundled_maps(matching: Matching, references: Sequence[MatchedImage], workspace: Path) -> dict[str, Path]:
    """The stages of the maps by image name; says how far it is."""
    photometric = {
        reference.name: matching.photometric(reference, workspace)
        for reference in with_time_left(references, "depths from photographs")
    }
    return {
        reference.name: matching.geometric(reference, photometric, workspace)
        for reference in with_time_left(references, "depths that agree")
    }


def digest_of(stage_folder: Path) -> str:
    """What a stage was made of, in few characters."""
    key = stage_key(stage_folder)
    assert key is not None, stage_folder
    return sha256(key.encode()).hexdigest()
