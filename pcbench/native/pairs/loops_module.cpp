// Python bindings of the loops over points that need no tree.
#include "pairs/loops_module.h"

#include <nanobind/stl/optional.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <optional>
#include <vector>

#include "common/arrays.h"
#include "common/order_statistics.h"
#include "pairs/exact_sums.h"
#include "pairs/monomials.h"
#include "pairs/pairs.h"
#include "pairs/pixel_sums.h"
#include "points/bounds.h"
#include "points/cells.h"
#include "points/kernels.h"
#include "points/normals.h"

namespace {

using OptionalIndices = std::optional<Indices>;
using Limbs = Out<uint32_t, nb::shape<-1, pcbench::kLimbs>>;
using Counts = Out<int64_t, nb::shape<-1>>;

// Returns `count` rows of an array: those listed in `indices`, or else all in order.
pcbench::Rows rows_of(Points array, const OptionalIndices& indices, size_t count) {
    check((indices ? indices->shape(0) : array.shape(0)) == count, "expected one row of every argument for each pair");
    bool in_range = true;
    if (indices)
        for (size_t i = 0; i < count; ++i)
            in_range &= indices->data()[i] >= 0 && static_cast<size_t>(indices->data()[i]) < array.shape(0);
    if (!in_range) throw nb::index_error("expected indices within their arrays");
    return {array.data(), indices ? indices->data() : nullptr};
}

nb::object to_numpy(const std::vector<int64_t>& values) {
    auto* data = new int64_t[values.size()];
    std::copy(values.begin(), values.end(), data);
    nb::capsule owner(data, [](void* p) noexcept { delete[] static_cast<int64_t*>(p); });
    return nb::cast(nb::ndarray<nb::numpy, int64_t, nb::ndim<1>>(data, {values.size()}, owner));
}

void bounds(Points points, Out<double, nb::shape<3>> lower, Out<double, nb::shape<3>> upper) {
    check(points.shape(0) > 0, "bounds: expected at least one point");
    const nb::gil_scoped_release release;
    pcbench::bounds(points.data(), points.shape(0), lower.data(), upper.data());
}

nb::tuple group_by_cell(Points points, double side, In<double, nb::shape<3>> lower, Out<int64_t, nb::shape<-1>> cells) {
    check(cells.shape(0) == points.shape(0), "group_by_cell: expected one cell for each point");
    check(side > 0, "group_by_cell: expected a positive side");
    pcbench::OccupiedCells occupied;
    {
        nb::gil_scoped_release release;
        occupied = pcbench::group_by_cell(points.data(), points.shape(0), pcbench::Grid(side, lower.data()), nullptr,
                                          cells.data());
    }
    return nb::make_tuple(to_numpy(occupied.first), to_numpy(occupied.counts));
}

nb::object first_in_cells(Points points, OptionalIndices rows, double side, In<double, nb::shape<3>> lower) {
    check(side > 0, "first_in_cells: expected a positive side");
    const size_t count = rows ? rows->shape(0) : points.shape(0);
    rows_of(points, rows, count);
    pcbench::OccupiedCells occupied;
    {
        nb::gil_scoped_release release;
        occupied = pcbench::group_by_cell(points.data(), count, pcbench::Grid(side, lower.data()),
                                          rows ? rows->data() : nullptr, nullptr);
    }
    return to_numpy(occupied.first);
}

void plane_fits(Points points, In<int64_t, nb::ndim<2>> neighbors, Out<double, nb::shape<-1, 3>> normals,
                Out<double, nb::shape<-1>> variation) {
    const size_t rows = neighbors.shape(0), k = neighbors.shape(1);
    check(normals.shape(0) == rows && variation.shape(0) == rows,
          "plane_fits: expected one row of normals and variation for each row of neighbors");
    bool in_range;
    {
        nb::gil_scoped_release release;
        in_range = pcbench::plane_fits(points.data(), points.shape(0), neighbors.data(), rows, k, normals.data(),
                                       variation.data());
    }
    if (!in_range) throw nb::index_error("plane_fits: expected neighbour indices within points");
}

void plane_distances(Points queries, OptionalIndices query_rows, Points closest, OptionalIndices closest_rows,
                     Points normals, OptionalIndices normal_rows, Out<double, nb::shape<-1>> distances) {
    const size_t count = distances.shape(0);
    const pcbench::Rows q = rows_of(queries, query_rows, count), c = rows_of(closest, closest_rows, count),
                        n = rows_of(normals, normal_rows, count);
    nb::gil_scoped_release release;
    pcbench::plane_distances(count, q, c, n, distances.data());
}

void rounded_squares(Points queries, Points closest, Indices rows, Out<double, nb::shape<-1>> squares) {
    const size_t count = squares.shape(0);
    const pcbench::Rows q = rows_of(queries, std::nullopt, count), c = rows_of(closest, rows, count);
    nb::gil_scoped_release release;
    pcbench::rounded_squares(count, q, c, squares.data());
}

bool order_statistics(Column values, std::optional<double> center, Indices ranks, Out<double, nb::shape<-1>> found) {
    const size_t count = values.shape(0), rank_count = ranks.shape(0);
    check(found.shape(0) == rank_count, "order_statistics: expected one result per rank");
    std::vector<size_t> selected(ranks.data(), ranks.data() + rank_count);
    check(std::is_sorted(selected.begin(), selected.end()) && (rank_count == 0 || selected.back() < count),
          "order_statistics: expected ascending ranks below the number of values");
    const double* data = values.data();
    nb::gil_scoped_release release;
    if (!center)
        return pcbench::order_statistics(
            count, [=](size_t i) { return data[i]; }, selected.data(), rank_count, found.data());
    const double c = *center;
    return pcbench::order_statistics(
        count, [=](size_t i) { return std::fabs(data[i] - c); }, selected.data(), rank_count, found.data());
}

void medians_of_rows(Column values, In<int64_t, nb::ndim<2>> rows, Out<double, nb::shape<-1>> medians) {
    const size_t count = rows.shape(0), k = rows.shape(1);
    check(k > 0 && medians.shape(0) == count,
          "medians_of_rows: expected one result for each row of at least one index");
    bool in_range = true;
    for (size_t i = 0; i < count * k; ++i) in_range &= static_cast<uint64_t>(rows.data()[i]) < values.shape(0);
    if (!in_range) throw nb::index_error("medians_of_rows: expected indices of values");
    std::vector<double> selected(k);
    nb::gil_scoped_release release;
    for (size_t i = 0; i < count; ++i) {
        for (size_t j = 0; j < k; ++j) selected[j] = values.data()[rows.data()[i * k + j]];
        medians.data()[i] = pcbench::median(selected.data(), selected.data() + k);
    }
}

bool add_exactly(Column values, Indices groups, Limbs limbs) {
    const size_t count = values.shape(0);
    check(groups.shape(0) == count && count <= pcbench::kMaxAdditions,
          "add_exactly: expected one group for each of at most 2^30 values");
    bool in_range = true;
    for (size_t i = 0; i < count; ++i) in_range &= static_cast<uint64_t>(groups.data()[i]) < limbs.shape(0);
    if (!in_range) throw nb::index_error("add_exactly: expected groups that have limbs");
    nb::gil_scoped_release release;
    return pcbench::add_exactly(count, values.data(), groups.data(), limbs.data());
}

void round_exactly(In<uint32_t, nb::shape<-1, pcbench::kLimbs>> limbs, Out<double, nb::shape<-1>> sums) {
    check(sums.shape(0) == limbs.shape(0), "round_exactly: expected one result per sum");
    for (size_t i = 0; i < sums.shape(0); ++i)
        sums.data()[i] = pcbench::round_exactly(limbs.data() + pcbench::kLimbs * i);
}

bool add_to_pixels(Points points, Column distances, Column signed_distances, double west, double south, double pixel,
                   int64_t width, int64_t height, Counts counts, Limbs limbs, Out<double, nb::shape<-1>> largest,
                   Counts signed_counts, Limbs signed_limbs) {
    const size_t count = points.shape(0);
    check(distances.shape(0) == count && signed_distances.shape(0) == count && count <= pcbench::kMaxAdditions,
          "add_to_pixels: expected one distance and one signed distance for each of at most 2^30 points");
    check(width > 0 && height > 0, "add_to_pixels: expected a positive width and height");
    const size_t pixels = static_cast<size_t>(width) * static_cast<size_t>(height);
    check(counts.shape(0) == pixels && limbs.shape(0) == pixels && largest.shape(0) == pixels &&
              signed_counts.shape(0) == pixels && signed_limbs.shape(0) == pixels,
          "add_to_pixels: expected one sum for each pixel");
    const nb::gil_scoped_release release;
    return pcbench::add_to_pixels(
        {west, south, pixel, width, height}, count, points.data(), distances.data(), signed_distances.data(),
        {counts.data(), signed_counts.data(), limbs.data(), signed_limbs.data(), largest.data()});
}

nb::tuple weigh(Points moved, Column distances, Points closest, Indices rows, Points normals, double max_distance,
                bool robust, double kept_share, Out<double, nb::shape<-1>> residuals,
                Out<double, nb::shape<-1>> weights) {
    const size_t count = moved.shape(0);
    check(0 <= kept_share && kept_share <= 1, "weigh: expected a kept share from 0 to 1");
    check(distances.shape(0) == count && residuals.shape(0) == count && weights.shape(0) == count,
          "weigh: expected one row of every argument for each pair");
    const pcbench::Rows c = rows_of(closest, rows, count), n = rows_of(normals, rows, count);
    pcbench::WeightSummary summary;
    {
        nb::gil_scoped_release release;
        summary = pcbench::weigh(count, moved.data(), distances.data(), c, n, max_distance, robust, kept_share,
                                 residuals.data(), weights.data());
    }
    return nb::make_tuple(summary.pairs_in_range, summary.sigma);
}

double plane_system(Points moved, Points normals, Indices rows, Column residuals, Column weights,
                    Out<double, nb::shape<7, 7>> hessian, Out<double, nb::shape<7>> gradient,
                    Out<double, nb::shape<3>> center) {
    const size_t count = moved.shape(0);
    check(residuals.shape(0) == count && weights.shape(0) == count,
          "plane_system: expected one row of every argument for each pair");
    const pcbench::Rows n = rows_of(normals, rows, count);
    pcbench::PlaneSystem system;
    {
        nb::gil_scoped_release release;
        system = pcbench::plane_system(count, moved.data(), n, residuals.data(), weights.data());
    }
    std::copy_n(&system.hessian[0][0], 49, hessian.data());
    std::copy_n(system.gradient, 7, gradient.data());
    std::copy_n(system.center, 3, center.data());
    return system.radius;
}

using Steps = In<int64_t, nb::shape<pcbench::kProducts - 1, 2>>;
using Moments = Out<double, nb::shape<-1, pcbench::kProducts, 6>>;
using Scores = Out<double, nb::shape<-1, pcbench::kMonomials, 3>>;

std::array<pcbench::MonomialStep, pcbench::kProducts - 1> checked_steps(Steps steps) {
    std::array<pcbench::MonomialStep, pcbench::kProducts - 1> checked;
    for (size_t a = 0; a < checked.size(); ++a) {
        checked[a] = {steps.data()[2 * a], steps.data()[2 * a + 1]};
        check(0 <= checked[a].earlier && checked[a].earlier <= static_cast<int64_t>(a) && 0 <= checked[a].axis &&
                  checked[a].axis < 3,
              "normal_equations: expected each monomial as an earlier one times a coordinate");
    }
    return checked;
}

void normal_equations(Points positions, Points normals, Column weights, Column residuals, Indices starts, Steps steps,
                      Moments moments, Scores scores) {
    const size_t count = positions.shape(0), groups = starts.shape(0);
    check(normals.shape(0) == count && weights.shape(0) == count && residuals.shape(0) == count,
          "normal_equations: expected one row of every argument for each pair");
    check(moments.shape(0) == groups && scores.shape(0) == groups, "normal_equations: expected one result per group");
    const auto step = checked_steps(steps);
    std::vector<size_t> bounds(starts.data(), starts.data() + groups);
    bounds.push_back(count);
    check(std::is_sorted(bounds.begin(), bounds.end()), "normal_equations: expected ascending starts of groups");
    nb::gil_scoped_release release;
#pragma omp parallel for schedule(dynamic) if (groups > 1 && count > pcbench::kMinParallelPairs / 8)
    for (size_t g = 0; g < groups; ++g)
        pcbench::kernels().normal_equations(bounds[g], bounds[g + 1], positions.data(), normals.data(), weights.data(),
                                            residuals.data(), step.data(), moments.data() + g * pcbench::kProducts * 6,
                                            scores.data() + g * pcbench::kMonomials * 3);
}

void equal_normal_equations(Points places, Points normals, OptionalIndices rows, Column distances, Indices queries,
                            In<double, nb::shape<3>> center, double radius, size_t group_size, Steps steps,
                            Moments moments, Scores scores) {
    const size_t count = queries.shape(0), groups = moments.shape(0);
    check(normals.shape(0) == places.shape(0) && (rows ? rows->shape(0) : places.shape(0)) == distances.shape(0),
          "equal_normal_equations: expected one normal for each place, and one place for each distance");
    check(group_size > 0 && count <= groups * group_size && scores.shape(0) == groups,
          "equal_normal_equations: expected one result for each group of queries");
    bool in_range = true;
    for (size_t i = 0; i < count; ++i) in_range &= static_cast<uint64_t>(queries.data()[i]) < distances.shape(0);
    if (!in_range) throw nb::index_error("equal_normal_equations: expected queries that have distances");
    const pcbench::Rows p = rows_of(places, rows, distances.shape(0)), n = rows_of(normals, rows, distances.shape(0));
    const auto step = checked_steps(steps);
    const pcbench::Vec3 origin = pcbench::vec3(center.data());
    nb::gil_scoped_release release;
#pragma omp parallel for schedule(dynamic) if (groups > 1)
    for (size_t g = 0; g < groups; ++g) {
        constexpr size_t kBlock = 256;
        double positions[3 * kBlock], directions[3 * kBlock], residuals[kBlock], weights[kBlock];
        std::fill_n(weights, kBlock, 1.0);
        const size_t end = std::min(count, (g + 1) * group_size);
        for (size_t start = g * group_size; start < end; start += kBlock) {
            const size_t size = std::min(kBlock, end - start);
            for (size_t i = 0; i < size; ++i) {
                const size_t query = static_cast<size_t>(queries.data()[start + i]);
                const pcbench::Vec3 place = p[query] - origin;
                pcbench::write({place.x / radius, place.y / radius, place.z / radius}, positions + 3 * i);
                pcbench::write(n[query], directions + 3 * i);
                residuals[i] = distances.data()[query] / radius;
            }
            pcbench::kernels().normal_equations(0, size, positions, directions, weights, residuals, step.data(),
                                                moments.data() + g * pcbench::kProducts * 6,
                                                scores.data() + g * pcbench::kMonomials * 3);
        }
    }
}

void whole_normal_equations(Points positions, Points normals, Column residuals, Steps steps,
                            Out<int64_t, nb::shape<3, pcbench::kProducts, 6>> moments,
                            Out<int64_t, nb::shape<4, pcbench::kMonomials, 3>> scores) {
    const size_t count = positions.shape(0);
    check(normals.shape(0) == count && residuals.shape(0) == count && count <= pcbench::kMaxWholePairs,
          "whole_normal_equations: expected one row of every argument for each of at most 2^20 pairs");
    const auto step = checked_steps(steps);
    const nb::gil_scoped_release release;
    pcbench::kernels().whole_normal_equations(count, positions.data(), normals.data(), residuals.data(), step.data(),
                                              moments.data(), scores.data());
}

// Sums over boxes of cells, one axis after the other: differences of running sums, in the order of the cells.
void box_sums(In<double, nb::ndim<4>> values, size_t reach, Out<double, nb::ndim<4>> sums) {
    for (int axis = 0; axis < 4; ++axis)
        check(sums.shape(axis) == values.shape(axis), "box_sums: expected sums of the shape of the values");
    double* const data = sums.data();
    std::copy_n(values.data(), values.size(), data);
    if (reach == 0) return;
    const nb::gil_scoped_release release;
    std::vector<double> running;
    size_t outer = values.shape(0), inner = values.size() / std::max<size_t>(outer, 1);
    for (int axis = 1; axis < 4; ++axis) {
        const size_t size = values.shape(axis);
        inner /= std::max<size_t>(size, 1);
        running.assign((size + 1) * inner, 0.0);
        for (size_t o = 0; o < outer && size > 1; ++o) {
            double* const lines = data + o * size * inner;
            std::copy_n(lines, inner, running.data() + inner);
            for (size_t i = inner; i < size * inner; ++i) running[i + inner] = running[i] + lines[i];
            for (size_t i = 0; i < size; ++i) {
                const double* const above = running.data() + std::min(i + reach + 1, size) * inner;
                const double* const below = running.data() + (i > reach ? i - reach : 0) * inner;
                for (size_t j = 0; j < inner; ++j) lines[i * inner + j] = above[j] - below[j];
            }
        }
        outer *= size;
    }
}

}  // namespace

void bind_loops(nb::module_& m) {
    m.def("bounds", &bounds, nb::arg("points").noconvert(), nb::arg("lower").noconvert(), nb::arg("upper").noconvert(),
          "Lowest and highest coordinates (3,) of points, written in place.");
    m.def(
        "group_by_cell", &group_by_cell, nb::arg("points").noconvert(), nb::arg("side"), nb::arg("lower"),
        nb::arg("cells").noconvert(),
        "Number the occupied cubic cells in the order of their first points. The cells (N,) of the points are written\n"
        "in place; the indices of the first points (M,) and the point counts (M,) of the cells are returned.",
        nb::sig("def group_by_cell(points: NDArray[numpy.float64], side: float, lower: NDArray[numpy.float64], cells: "
                "NDArray[numpy.int64]) -> tuple[NDArray[numpy.int64], NDArray[numpy.int64]]"));
    m.def("first_in_cells", &first_in_cells, nb::arg("points").noconvert(), nb::arg("rows").noconvert().none(),
          nb::arg("side"), nb::arg("lower"),
          "Indices (M,) of the first points in the occupied cubic cells, of all points or of those in rows.",
          nb::sig("def first_in_cells(points: NDArray[numpy.float64], rows: NDArray[numpy.int64] | None, side: float, "
                  "lower: NDArray[numpy.float64]) -> NDArray[numpy.int64]"));
    m.def(
        "plane_fits", &plane_fits, nb::arg("points"), nb::arg("neighbors"), nb::arg("normals").noconvert(),
        nb::arg("variation").noconvert(),
        "Fit a plane to each row of neighbours. Unit normals (M, 3) and surface variation (M,) are written in place.");
    m.def("plane_distances", &plane_distances, nb::arg("queries").noconvert(), nb::arg("query_rows").noconvert().none(),
          nb::arg("closest").noconvert(), nb::arg("closest_rows").noconvert().none(), nb::arg("normals").noconvert(),
          nb::arg("normal_rows").noconvert().none(), nb::arg("distances").noconvert(),
          "Signed distances (M,) along normals, written in place; each array is used in order or by its row indices.");
    m.def("rounded_squares", &rounded_squares, nb::arg("queries").noconvert(), nb::arg("closest").noconvert(),
          nb::arg("closest_rows").noconvert(), nb::arg("squares").noconvert(),
          "Squared distances (M,), written in place, from coordinate differences rounded to float32.");
    m.def(
        "order_statistics", &order_statistics, nb::arg("values").noconvert(), nb::arg("center").none(),
        nb::arg("ranks").noconvert(), nb::arg("found").noconvert(),
        "Values of the ascending ranks (M,), 0 the smallest, among values (N,), or among their distances from center;\n"
        "written in place. Returned is False, and nothing is written, if a value is NaN.");
    m.def("box_sums", &box_sums, nb::arg("values").noconvert(), nb::arg("reach"), nb::arg("sums").noconvert(),
          "Sums (Q, X, Y, Z), written in place, of values (Q, X, Y, Z) over the cells up to `reach` cells away along "
          "the\n"
          "last three axes.");
    m.def("medians_of_rows", &medians_of_rows, nb::arg("values").noconvert(), nb::arg("rows").noconvert(),
          nb::arg("medians").noconvert(),
          "Median (M,) of the values (N,) at each row of indices (M, K), written in place.");
    m.def("add_exactly", &add_exactly, nb::arg("values").noconvert(), nb::arg("groups").noconvert(),
          nb::arg("limbs").noconvert(),
          "Add values (N,) to the fixed-point sums of their groups (N,), in place: limb k of a row (G, 8) counts\n"
          "2^(32 k - 128), in two's complement. Returned is False if a value is not finite or not below 2^96 in\n"
          "magnitude.");
    m.def(
        "add_to_pixels", &add_to_pixels, nb::arg("points").noconvert(), nb::arg("distances").noconvert(),
        nb::arg("signed_distances").noconvert(), nb::arg("west"), nb::arg("south"), nb::arg("pixel"), nb::arg("width"),
        nb::arg("height"), nb::arg("counts").noconvert(), nb::arg("limbs").noconvert(), nb::arg("largest").noconvert(),
        nb::arg("signed_counts").noconvert(), nb::arg("signed_limbs").noconvert(),
        "Add distances (N,), and signed ones (N,) where they are finite, to the pixels of a raster over x and y, in\n"
        "place: counts (P,), sums (P, 8) as in `add_exactly`, and largest distances (P,), row by row from the south.\n"
        "Returned is False if a distance is not finite or not below 2^96.");
    m.def("round_exactly", &round_exactly, nb::arg("limbs").noconvert(), nb::arg("sums").noconvert(),
          "Nearest doubles (G,), written in place, of fixed-point sums (G, 8) whose limbs are digits in two's\n"
          "complement.");
    m.def(
        "weigh", &weigh, nb::arg("moved").noconvert(), nb::arg("distances").noconvert(), nb::arg("closest").noconvert(),
        nb::arg("rows").noconvert(), nb::arg("normals").noconvert(), nb::arg("max_distance"), nb::arg("robust"),
        nb::arg("kept_share"), nb::arg("residuals").noconvert(), nb::arg("weights").noconvert(),
        "Residuals and weights (M,) of pairs, written in place. Returned are the number of pairs within the maximum\n"
        "correspondence distance and their sigma.",
        nb::sig(
            "def weigh(moved: NDArray[numpy.float64], distances: NDArray[numpy.float64], closest: "
            "NDArray[numpy.float64], rows: NDArray[numpy.int64], normals: NDArray[numpy.float64], max_distance: float, "
            "robust: bool, kept_share: float, residuals: NDArray[numpy.float64], weights: NDArray[numpy.float64]) -> "
            "tuple[int, float]"));
    m.def(
        "plane_system", &plane_system, nb::arg("moved").noconvert(), nb::arg("normals").noconvert(),
        nb::arg("rows").noconvert(), nb::arg("residuals").noconvert(), nb::arg("weights").noconvert(),
        nb::arg("hessian").noconvert(), nb::arg("gradient").noconvert(), nb::arg("center").noconvert(),
        "Normal equations of one point-to-plane iteration, written in place. Returned is the RMS radius of the pairs.",
        nb::sig("def plane_system(moved: NDArray[numpy.float64], normals: NDArray[numpy.float64], rows: "
                "NDArray[numpy.int64], residuals: NDArray[numpy.float64], weights: NDArray[numpy.float64], hessian: "
                "NDArray[numpy.float64], gradient: NDArray[numpy.float64], center: NDArray[numpy.float64]) -> "
                "float"));
    m.def(
        "normal_equations", &normal_equations, nb::arg("positions").noconvert(), nb::arg("normals").noconvert(),
        nb::arg("weights").noconvert(), nb::arg("residuals").noconvert(), nb::arg("starts").noconvert(),
        nb::arg("steps").noconvert(), nb::arg("moments").noconvert(), nb::arg("scores").noconvert(),
        "Add pairs to the sums of their groups, in place: moments (G, 84, 6) of w phi n n' and scores (G, 20, 3) of\n"
        "w phi n r. Each monomial phi but the first is an earlier one times a coordinate, as given by steps (83, 2).");
    m.def("equal_normal_equations", &equal_normal_equations, nb::arg("places").noconvert(),
          nb::arg("normals").noconvert(), nb::arg("rows").noconvert().none(), nb::arg("distances").noconvert(),
          nb::arg("queries").noconvert(), nb::arg("center").noconvert(), nb::arg("radius"), nb::arg("group_size"),
          nb::arg("steps").noconvert(), nb::arg("moments").noconvert(), nb::arg("scores").noconvert(),
          "Add some queries, in groups of a fixed size, to sums as in `normal_equations` with equal weights. Query i "
          "has\n"
          "the place and the normal of row i, or of rows[i]; places are taken relative to a centre, and places and\n"
          "distances in units of a radius.");
    m.def(
        "whole_normal_equations", &whole_normal_equations, nb::arg("positions").noconvert(),
        nb::arg("normals").noconvert(), nb::arg("residuals").noconvert(), nb::arg("steps").noconvert(),
        nb::arg("moments").noconvert(), nb::arg("scores").noconvert(),
        "The sums of normal_equations over pairs of weight 1 in whole numbers, added to moments (3, 84, 6) and scores\n"
        "(4, 20, 3): digits of base 2^20 in units of 2^-80, the lowest one first. Factors are rounded to 2^-40.");
}
