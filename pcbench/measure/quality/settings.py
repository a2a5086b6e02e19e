"""Settings of the quality of a cloud."""

from __future__ import annotations

from dataclasses import dataclass

from pcbench.options import CLASSES_HELP, RETURNS_HELP, Bounds, OptionGroup, parse_integers, parse_returns, setting

_LENGTH = Bounds(float, 0, is_open=True)


@dataclass(frozen=True)
class QualitySettings:
    """Settings of the quality of a cloud.

    Attributes:
        radius: radius of the neighbourhoods in which noise, entropy and plane variance are measured; None: from the
            spacing, see `pcbench.measure.quality.patches`.
        min_neighbors: least number of points of a neighbourhood, the point itself included.
        max_separation: largest distance of parallel sheets that counts as a double wall; None: 22 spacings.
        strips: attribute whose values tell strips apart, such as `point_source_id`; `gps_time` splits at gaps, `file`
            at the files of a folder, `none` compares no strips; `auto` takes the first of these that has two strips.
        classes: LAS classes to keep, see `pcbench.read_cloud`.
        returns: returns to keep, likewise.
        seed: seed of random samples and of the bootstrap.
    """

    radius: float | None = setting(
        None,
        "--radius",
        "Radius of the neighbourhoods for noise, mean map entropy and mean plane variance.  [default: 8 spacings, more"
        " where the noise is larger]",
        metavar="LENGTH",
        bounds=_LENGTH,
    )
    min_neighbors: int = setting(
        12,
        "--min-neighbors",
        "Least number of points of a neighbourhood.",
        metavar="N",
        bounds=Bounds(int, 10),
        shows_default=True,
        group=OptionGroup.METRICS,
    )
    max_separation: float | None = setting(
        None,
        "--max-separation",
        "Largest distance of parallel sheets that counts as a double wall.  [default: 22 spacings]",
        metavar="LENGTH",
        bounds=_LENGTH,
    )
    strips: str = setting(
        "auto",
        "--strips",
        "Attribute that tells strips apart, such as point_source_id or return_number; gps_time (split at gaps), file,"
        " none, or auto.",
        metavar="NAME",
        shows_default=True,
    )
    classes: tuple[int, ...] | None = setting(
        None, "--classes", CLASSES_HELP, metavar="N,N,...", parse=parse_integers, group=OptionGroup.INPUT
    )
    returns: str | tuple[int, ...] | None = setting(
        None, "--returns", RETURNS_HELP, metavar="WHICH", parse=parse_returns, group=OptionGroup.INPUT
    )
    seed: int = setting(
        0, "--seed", "Random seed.", metavar="N", bounds=Bounds(int, 0), shows_default=True, group=OptionGroup.METRICS
    )
