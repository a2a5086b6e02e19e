"""The scalars of deviation maps: how colour bars, tables, titles and the page name them. All are lengths."""

from __future__ import annotations

from typing import NamedTuple

COMPLETENESS = "completeness"
"""Name of the map of the reference's distances to a candidate."""


class Scalar(NamedTuple):
    """A scalar of deviation maps. The colour map follows the signs of its values, see `pcbench.report.colors`.

    Attributes:
        label: label of its colour bar, without the unit.
        short_label: label in a list of distances.
        title: first words of its lines in tables.
        plural: the values in words, if the page may summarise them by tiles.
        noun: what has a value.
    """

    label: str
    short_label: str = ""
    title: str = ""
    plural: str = ""
    noun: str = "point"


SCALARS = {
    "distance": Scalar(
        "distance to the closest reference point", "to the closest point", plural="distances to the closest point"
    ),
    COMPLETENESS: Scalar("distance to the closest candidate point"),
    "plane_distance": Scalar(
        "signed distance to the reference's tangent plane",
        "to the surface, signed",
        "map plane",
        "signed distances to the surface",
    ),
    "mesh_distance": Scalar(
        "distance to the reference mesh", "to the reference mesh", "map mesh", "distances to the reference mesh"
    ),
    "poisson_distance": Scalar("distance to the reference's Poisson mesh", "to the Poisson mesh", "map poisson"),
    "poisson_meshlab_distance": Scalar(
        "distance to the reference's Poisson mesh by pymeshlab", "to pymeshlab's Poisson mesh", "map poisson_meshlab"
    ),
    "m3c2_distance": Scalar(
        "M3C2 distance along the reference's normal", "along the normal (M3C2)", "map m3c2", noun="core point"
    ),
}
"""The scalars by name, in files and in `DeviationMap.scalars`."""


def scalar_of(name: str) -> Scalar:
    """Return a scalar by its name; another attribute of a cloud has its name as label."""
    label = name.replace("_", " ")
    return SCALARS.get(name) or Scalar(label, label)
