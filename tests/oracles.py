"""Slow, plain numpy versions of what pcbench measures: float64, brute force, nothing imported from pcbench or scipy.

They are written from the definitions alone, so that their agreement with pcbench is evidence.
"""

import numpy as np

_PAIRS_AT_ONCE = 2_000_000  # 48 MB of coordinate differences


def squared_distance_rows(queries, points):
    """Yield chunks (start, squared distances (n, len(points))), computed from differences to keep precision."""
    step = max(1, _PAIRS_AT_ONCE // len(points))
    for start in range(0, len(queries), step):
        difference = queries[start : start + step, None, :] - points[None, :, :]
        yield start, np.einsum("nmi,nmi->nm", difference, difference)


# Neighbours


def k_nearest(queries, points, k):
    """Distances and indices (N, k) of the k nearest points, nearest first, ties by the lowest index."""
    distances, indices = np.empty((len(queries), k)), np.empty((len(queries), k), dtype=np.int64)
    for start, squared in squared_distance_rows(queries, points):
        order = np.argsort(squared, axis=1, kind="stable")[:, :k]
        indices[start : start + len(order)] = order
        distances[start : start + len(order)] = np.sqrt(np.take_along_axis(squared, order, axis=1))
    return distances, indices


def nearest(queries, points):
    """Distances and indices (N,) of the nearest point, ties by the lowest index."""
    distances, indices = np.empty(len(queries)), np.empty(len(queries), dtype=np.int64)
    for start, squared in squared_distance_rows(queries, points):
        lowest = squared.argmin(axis=1)  # argmin returns the first minimum
        indices[start : start + len(lowest)] = lowest
        distances[start : start + len(lowest)] = np.sqrt(squared[np.arange(len(lowest)), lowest])
    return distances, indices


def leave_one_out(points):
    """Distance (N,) from each point to its nearest other point: 0 if it has a duplicate."""
    result = np.empty(len(points))
    for start, squared in squared_distance_rows(points, points):
        rows = np.arange(len(squared))
        squared[rows, start + rows] = np.inf
        result[start : start + len(squared)] = np.sqrt(squared.min(axis=1))
    return result


def normals(points, k):
    """Unit normals (N, 3) of the plane through each point's k nearest points, itself included; sign arbitrary."""
    _, indices = k_nearest(points, points, k)
    result = np.empty_like(points)
    for row, neighbours in enumerate(indices):
        centred = points[neighbours] - points[neighbours].mean(axis=0)
        _, vectors = np.linalg.eigh(centred.T @ centred)
        result[row] = vectors[:, 0]  # of the smallest eigenvalue
    return result


# Metrics


def d1(queries, points):
    """D1 in one direction: mean squared distance to the nearest point."""
    return float(np.mean(nearest(queries, points)[0] ** 2))


def d2(queries, points, point_normals):
    """D2 in one direction: mean squared distance to the plane through the nearest point, orthogonal to its normal."""
    _, indices = nearest(queries, points)
    return float(np.mean(((queries - points[indices]) * point_normals[indices]).sum(axis=1) ** 2))


def hausdorff(first, second):
    """Hausdorff distance: max(max a, max b), unsquared."""
    return float(max(nearest(first, second)[0].max(), nearest(second, first)[0].max()))


def chamfer_unsquared(first, second):
    """Chamfer distance: mean a + mean b."""
    return float(nearest(first, second)[0].mean() + nearest(second, first)[0].mean())


def chamfer_squared(first, second):
    """Chamfer distance: mean a^2 + mean b^2."""
    return d1(first, second) + d1(second, first)


def chamfer_sum_of_squares(first, second):
    """Chamfer distance of PDAL: sum a^2 + sum b^2."""
    return float((nearest(first, second)[0] ** 2).sum() + (nearest(second, first)[0] ** 2).sum())


def fscore(candidate, reference, threshold):
    """Precision (candidate within the threshold), recall (reference within it), harmonic mean."""
    precision = float(np.mean(nearest(candidate, reference)[0] <= threshold))
    recall = float(np.mean(nearest(reference, candidate)[0] <= threshold))
    total = precision + recall
    return precision, recall, 2 * precision * recall / total if total else 0.0


def voxel_mean(values, points, side, lower):
    """Mean over occupied voxels floor((p - lower) / side) of the voxel's mean value."""
    voxels: dict[tuple[int, ...], list[float]] = {}
    for value, index in zip(values, np.floor((points - lower) / side).astype(int), strict=True):
        voxels.setdefault(tuple(index), []).append(float(value))
    return float(np.mean([np.mean(voxel_values) for voxel_values in voxels.values()]))


# M3C2 (Lague et al. 2013, section 3)


def m3c2_normals(reference, cores, radius):
    """Upward normals (K, 3) of planes through the reference's points around each core; NaN with fewer than three."""
    result = np.full(cores.shape, np.nan)
    for row, core in enumerate(cores):
        neighbours = reference[np.sqrt(((reference - core) ** 2).sum(axis=1)) <= radius]
        if len(neighbours) >= 3:
            normal = np.linalg.svd(neighbours - neighbours.mean(axis=0))[2][2]
            result[row] = normal * (1 if normal[2] >= 0 else -1)
    return result


def m3c2(reference, candidate, cores, normals, radius, half_length, registration_error):
    """Distances, levels of detection (eq. 1, ddof 0, none below five points) and counts (K, 2) in the cylinders."""
    distances, lod, counts = np.full(len(cores), np.nan), np.full(len(cores), np.nan), np.zeros((len(cores), 2), int)
    for row, (core, normal) in enumerate(zip(cores, normals, strict=True)):
        heights_of_clouds = []
        for cloud in (reference, candidate):
            offsets = cloud - core
            heights = offsets @ normal
            axis_distances = np.sqrt(((offsets - heights[:, None] * normal) ** 2).sum(axis=1))
            heights_of_clouds.append(heights[(np.abs(heights) <= half_length) & (axis_distances <= radius)])
        counts[row] = [len(heights) for heights in heights_of_clouds]
        if counts[row].min() > 0:
            distances[row] = heights_of_clouds[1].mean() - heights_of_clouds[0].mean()
        if counts[row].min() >= 5:
            variance = sum(heights.var() / len(heights) for heights in heights_of_clouds)
            lod[row] = 1.96 * (np.sqrt(variance) + registration_error)
    return {"distances": distances, "lod": lod, "counts": counts}


# Sampling floors: expected scores of two samples of one surface


def cloudcompare_columns(path):
    """Return the columns (N,) of CloudCompare's M3C2 output by name."""
    names = path.read_text().splitlines()[0].replace('"', "").split(",")
    return dict(zip(names, np.loadtxt(path, delimiter=",", skiprows=1).T, strict=True))


def floor_distances(queries, points):
    """Leave-one-out distances (N,) in the searched cloud, at the fourth-nearest points of the queries."""
    fourth = [
        np.argsort(((points - query) ** 2).sum(axis=1), kind="stable")[min(3, len(points) - 1)] for query in queries
    ]
    return leave_one_out(points)[fourth]


# MPEG's pc_error

_TIE = 1e-8  # squared units
_STEP, _MAX_TIES = 5, 30  # neighbours are fetched five at a time


def _closest(squared, count):
    """The nearest `count` indices, and five more as long as the last is exactly as near as the first."""
    bound = np.partition(squared, _MAX_TIES - 1)[_MAX_TIES - 1] if len(squared) > _MAX_TIES else np.inf
    candidates = np.flatnonzero(squared <= bound)
    order = candidates[np.argsort(squared[candidates], kind="stable")][:_MAX_TIES]
    while count < len(order) and squared[order[0]] == squared[order[count - 1]] and count + _STEP <= _MAX_TIES:
        count += _STEP
    return order[:count]


def _exact_ties(squared):
    neighbours = _closest(squared, _STEP)
    return neighbours[squared[neighbours] == squared[neighbours[0]]]


def _close_ties(squared):
    """Nearest first, up to the first step of `_TIE` or more: a chain, not a band about the nearest."""
    neighbours = _closest(squared, 2 * _STEP)
    steps = np.diff(squared[neighbours])
    return neighbours[: int(np.argmax(steps >= _TIE)) + 1] if (steps >= _TIE).any() else neighbours


def _rows(queries, points):
    for _, chunk in squared_distance_rows(queries, points):
        yield from chunk


def _first_of_duplicates(points):
    return np.sort(np.unique(points, axis=0, return_index=True)[1])


def mpeg(a_points, a_normals, b_points):
    """Return the output of `pc_error -a A -b B --hausdorff=1` of mpeg-pcc-dmetric 0.14.2 by its names.

    A's normals are spread to B by nearest neighbours and averaged, neither re-normalised nor oriented. Direction 1 is
    A -> B with B's normals, 2 is B -> A with A's; the figures without a number are the worse of the two. Its maxima
    ("h.") are squared distances. Coordinates are not rounded, while the tool casts them to float32.
    """
    first = _first_of_duplicates(a_points)
    a_points, a_normals = a_points[first], a_normals[first]
    b_points = b_points[_first_of_duplicates(b_points)]

    totals, counts = np.zeros_like(b_points), np.zeros(len(b_points))
    for normal, squared in zip(a_normals, _rows(a_points, b_points), strict=True):
        ties = _exact_ties(squared)
        totals[ties] += normal
        counts[ties] += 1
    b_normals = totals / np.maximum(counts, 1)[:, None]
    empty = counts == 0
    if empty.any():
        b_normals[empty] = [a_normals[_exact_ties(row)].mean(axis=0) for row in _rows(b_points[empty], a_points)]

    # The tool leaves out points whose nearest other point is closer than 1e-5 (squared: 1e-10).
    spacing = leave_one_out(a_points)
    peak = float(spacing[spacing**2 > 1e-10].max())
    result = {"Peak distance for PSNR": peak}

    def psnr(mse):
        return float(10 * np.log10(3 * peak**2 / mse)) if mse > 0 else float("inf")

    for number, queries, points, target_normals in (
        ("1", a_points, b_points, b_normals),
        ("2", b_points, a_points, a_normals),
    ):
        to_point, to_plane = [], []
        for query, squared in zip(queries, _rows(queries, points), strict=True):
            ties = _close_ties(squared)
            to_point.append(squared[ties[0]])
            to_plane.append(np.mean(((query - points[ties]) * target_normals[ties]).sum(axis=1) ** 2))
        for kind, values in (("p2point", to_point), ("p2plane", to_plane)):
            mse, highest = float(np.mean(values)), float(np.max(values))
            result[f"mse{number} ({kind})"] = mse
            result[f"mse{number},PSNR ({kind})"] = psnr(mse)
            result[f"h. {number}({kind})"] = highest
            result[f"h.,PSNR {number}({kind})"] = psnr(highest)
    for kind in ("p2point", "p2plane"):
        result[f"mseF ({kind})"] = max(result[f"mse1 ({kind})"], result[f"mse2 ({kind})"])
        result[f"mseF,PSNR ({kind})"] = min(result[f"mse1,PSNR ({kind})"], result[f"mse2,PSNR ({kind})"])
        result[f"h. ({kind})"] = max(result[f"h. 1({kind})"], result[f"h. 2({kind})"])
        result[f"h.,PSNR ({kind})"] = min(result[f"h.,PSNR 1({kind})"], result[f"h.,PSNR 2({kind})"])
    return result


def first_hits(origins, directions, vertices, faces):
    """Ray parameters t (N,) of the first intersections, by Moeller and Trumbore's 3x3 systems; inf without one."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    result = np.full(len(origins), np.inf)
    for i, (o, d) in enumerate(zip(origins, directions, strict=True)):
        # o + t d = a + u (b - a) + v (c - a)
        systems = np.stack([np.broadcast_to(-d, a.shape), b - a, c - a], axis=2)
        is_regular = np.abs(np.linalg.det(systems)) > 1e-300
        t, u, v = np.linalg.solve(systems[is_regular], (o - a[is_regular])[..., None])[..., 0].T
        hit_parameters = t[(u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0)]
        result[i] = hit_parameters.min(initial=np.inf)
    return result


# Benchmarks


def free_space(scan, points, start_radius, halfangle_rad):
    """Distance (N,) to the nearest scan point in whose beam a point lies (inf: none), and whether a beam passes it."""
    lengths = np.linalg.norm(scan, axis=1)
    nearest, is_passed = np.full(len(points), np.inf), np.zeros(len(points), bool)
    for row, point in enumerate(points):
        along = (scan / lengths[:, None]) @ point
        off = np.linalg.norm(point - along[:, None] * scan / lengths[:, None], axis=1)
        in_beam = (along >= 0) & (off <= start_radius + np.linalg.norm(point) * np.tan(halfangle_rad))
        if in_beam.any():
            nearest[row] = np.linalg.norm(scan[in_beam] - point, axis=1).min()
            is_passed[row] = (along < lengths)[in_beam].any()
    return nearest, is_passed
