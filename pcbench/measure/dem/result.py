"""The change of an area between two or more epochs: what `pcbench change` measures."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.regions import Region
from pcbench.measure.dem.along_normals import NormalVolume
from pcbench.measure.dem.covariance import Mask
from pcbench.measure.dem.difference import DemOfDifference
from pcbench.measure.dem.epochs import Epoch
from pcbench.measure.dem.grid import HeightGrid
from pcbench.measure.dem.profiles import Profile
from pcbench.measure.dem.series import HeightTrend, PlaceChange, years
from pcbench.measure.dem.settings import ChangeSettings
from pcbench.measure.dem.volumes import AreaChange


@dataclass(frozen=True, eq=False)
class EpochChange:
    """The change from the first epoch to a later one.

    Attributes:
        epoch: the later epoch.
        difference: the DEM of difference.
        whole: change of all that both epochs cover.
        zones: change of the zones in their order.
        parts: change of the changed parts, the largest first; none without a model of the errors, which tells them
            apart.
        along_normals: volume along normals, if it was measured.
    """

    epoch: Epoch
    difference: DemOfDifference
    whole: AreaChange
    zones: tuple[AreaChange, ...]
    parts: tuple[AreaChange, ...]
    along_normals: NormalVolume | None


@dataclass(frozen=True, eq=False)
class AreaHistory:
    """The change of an area over all epochs.

    Attributes:
        settings: settings of the measurement.
        epochs: the epochs in the order given.
        grid: the cells.
        zones: cells (H, W) of each zone by its name.
        zone_regions: the polygons of each zone by its name.
        changes: change from the first epoch to each later one.
        profiles: heights along lines.
        places: change of places.
        trend: trend of each cell, with three epochs or more.
        unit: unit of lengths, if known.
        crs: coordinate system, if known.
        warnings: what not to trust.
    """

    settings: ChangeSettings
    epochs: tuple[Epoch, ...]
    grid: HeightGrid
    zones: Mapping[str, Mask]
    zone_regions: Mapping[str, Region]
    changes: tuple[EpochChange, ...]
    profiles: tuple[Profile, ...]
    places: tuple[PlaceChange, ...]
    trend: HeightTrend | None
    unit: str | None
    crs: str | None
    warnings: tuple[str, ...]

    @property
    def times(self) -> FloatArray | None:
        """Times of the epochs in years since the first; None if one has no date."""
        return years([epoch.date for epoch in self.epochs])
