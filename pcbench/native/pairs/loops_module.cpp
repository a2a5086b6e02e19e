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
#include "points/bounds.h"
#include "points/cells.h"
#include "points/kernels.h"
#include "points/normals.h"

namespace {

using OptionalIndices = std::optional<Indices>;

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
        occupied =
            pcbench::group_by_cell(points.data(), points.shape(0), pcbench::Grid(side, lower.data()), cells.data());
    }
    return nb::make_tuple(to_numpy(occupied.first), to_numpy(occupied.counts));
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

bool add_exactly(Column values, Indices groups, Out<int64_t, nb::shape<-1, pcbench::kLimbs>> limbs) {
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

std::array<pcbench::MonomialStep, pcbench::kProducts - 1> monomial_steps(Steps steps) {
    std::array<pcbench::MonomialStep, pcbench::kProducts - 1> step;
    for (size_t a = 0; a < step.size(); ++a) {
        step[a] = {steps.data()[2 * a], steps.data()[2 * a + 1]};
        check(
            0 <= step[a].earlier && step[a].earlier <= static_cast<int64_t>(a) && 0 <= step[a].axis && step[a].axis < 3,
            "normal_equations: expected each monomial as an earlier one times a coordinate");
    }
    return step;
}

void normal_equations(Points positions, Points normals, Column weights, Column residuals, Indices starts, Steps steps,
                      Out<double, nb::shape<-1, pcbench::kProducts, 6>> moments,
                      Out<double, nb::shape<-1, pcbench::kMonomials, 3>> scores) {
    const size_t count = positions.shape(0), groups = starts.shape(0);
    check(normals.shape(0) == count && weights.shape(0) == count && residuals.shape(0) == count,
          "normal_equations: expected one row of every argument for each pair");
    check(moments.shape(0) == groups && scores.shape(0) == groups, "normal_equations: expected one result per group");
    const auto step = monomial_steps(steps);
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

void whole_normal_equations(Points positions, Points normals, Column residuals, Steps steps,
                            Out<int64_t, nb::shape<3, pcbench::kProducts, 6>> moments,
                            Out<int64_t, nb::shape<4, pcbench::kMonomials, 3>> scores) {
    const size_t count = positions.shape(0);
    check(normals.shape(0) == count && residuals.shape(0) == count && count <= pcbench::kMaxWholePairs,
          "whole_normal_equations: expected one row of every argument for each of at most 2^20 pairs");
    const auto step = monomial_steps(steps);
    const nb::gil_scoped_release release;
    pcbench::kernels().whole_normal_equations(count, positions.data(), normals.data(), residuals.data(), step.data(),
                                              moments.data(), scores.data());
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
    m.def("add_exactly", &add_exactly, nb::arg("values").noconvert(), nb::arg("groups").noconvert(),
          nb::arg("limbs").noconvert(),
          "Add values (N,) to the fixed-point sums of their groups (N,), in place: limb k of a row (G, 8) counts\n"
          "2^(32 k - 128). Returned is False if a value is not finite or not below 2^96 in magnitude.");
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
        "Sums over groups of pairs, written in place: moments (G, 84, 6) of w phi n n' and scores (G, 20, 3) of\n"
        "w phi n r. Each monomial phi but the first is an earlier one times a coordinate, as given by steps (83, 2).");
    m.def(
        "whole_normal_equations", &whole_normal_equations, nb::arg("positions").noconvert(),
        nb::arg("normals").noconvert(), nb::arg("residuals").noconvert(), nb::arg("steps").noconvert(),
        nb::arg("moments").noconvert(), nb::arg("scores").noconvert(),
        "The sums of normal_equations over pairs of weight 1 in whole numbers, added to moments (3, 84, 6) and scores\n"
        "(4, 20, 3): digits of base 2^20 in units of 2^-80, the lowest one first. Factors are rounded to 2^-40.");
}
