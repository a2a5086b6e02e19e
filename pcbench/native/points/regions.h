// All points inside balls or cylinders, and their numbers in concentric balls.
// Included once per instruction set, see kernels_isa.h.
#pragma once
#include "common/interrupt.h"
#include "points/kernels.h"
#include "points/walk.h"

namespace pcbench::PCB_ISA {

struct Ball {
    double centre[3];
    double squared_radius;

    Vector squared_gaps(const Node& node) const { return pcbench::PCB_ISA::squared_gaps(node, box_of_point(centre)); }
    double bound() const { return squared_radius; }

    unsigned inside(const Leaf& leaf) const {
        const Vector squared = squared_length(splat(centre[0]) - load(leaf.x), splat(centre[1]) - load(leaf.y),
                                              splat(centre[2]) - load(leaf.z));
        return bits(squared <= splat(squared_radius));
    }
};

// A point p is inside if |(p - origin) . axis| <= half_length and the rest of p - origin is at most as long as the
// radius.
struct Cylinder {
    double origin[3], axis[3];
    double radius, half_length;

    double bound() const { return 0.0; }

    // 0 for a child that may contain a point of the cylinder, else infinity. The box is replaced by its bounding ball
    // in the radial direction, and by its projection in the axial direction.
    Vector squared_gaps(const Node& node) const {
        Vector offset[3], axial = splat(0.0), half_extent = splat(0.0), magnitude = splat(radius + half_length),
                          half[3];
        for (int a = 0; a < 3; ++a) {
            const Vector low = load(node.low[a]), high = load(node.high[a]);
            offset[a] = (low + high) * splat(0.5) - splat(origin[a]);
            half[a] = (high - low) * splat(0.5);
            axial = axial + offset[a] * splat(axis[a]);
            half_extent = half_extent + half[a] * splat(std::fabs(axis[a]));
            magnitude = magnitude + abs(low) + abs(high) + splat(std::fabs(origin[a]));
        }
        // Bound of about twenty roundings, each below 2^-53 of the magnitude.
        const Vector slack = magnitude * splat(1e-13);
        const Vector radial_distance =
            sqrt(squared_length(offset[0] - axial * splat(axis[0]), offset[1] - axial * splat(axis[1]),
                                offset[2] - axial * splat(axis[2])));
        const Vector box_radius = sqrt(squared_length(half[0], half[1], half[2]));
        // A missing child gives NaN, for which the comparisons are false.
        const Mask may_contain = (abs(axial) <= splat(half_length) + half_extent + slack) &
                                 (radial_distance <= splat(radius) + box_radius + slack);
        return select(may_contain, splat(0.0), splat(HUGE_VAL));
    }

    unsigned inside(const Leaf& leaf) const {
        const Vector x = load(leaf.x) - splat(origin[0]), y = load(leaf.y) - splat(origin[1]),
                     z = load(leaf.z) - splat(origin[2]);
        const Vector axial = (x * splat(axis[0]) + y * splat(axis[1])) + z * splat(axis[2]);
        const Vector squared =
            squared_length(x - axial * splat(axis[0]), y - axial * splat(axis[1]), z - axial * splat(axis[2]));
        return bits((abs(axial) <= splat(half_length)) & (squared <= splat(radius * radius)));
    }
};

template <typename Region>
class PointsInside {
public:
    PointsInside(const Tree& tree, const Region& region, int64_t* rows) : tree_(tree), region_(region), rows_(rows) {}

    Vector squared_gaps(const Node& node) const { return region_.squared_gaps(node); }
    double bound() const { return region_.bound(); }
    uint32_t last_tie() const { return UINT32_MAX; }

    void leaf(uint32_t id, const Node&, int) {
        unsigned inside = region_.inside(tree_.leaves[id]);
        if (rows_)
            for (unsigned rest = inside; rest; rest &= rest - 1)
                *rows_++ = static_cast<int64_t>(tree_.leaves[id].row[__builtin_ctz(rest)]);
        count_ += __builtin_popcount(inside);
    }

    int64_t count() const { return count_; }

private:
    const Tree& tree_;
    const Region& region_;
    int64_t* rows_;
    int64_t count_ = 0;
};

template <typename MakeRegion>
inline void find_in_regions(const Tree& tree, const Leaf* queries, size_t leaf_count, MakeRegion make, int64_t* offsets,
                            int64_t* rows, Interrupt& interrupt) {
#pragma omp parallel for schedule(dynamic, 16)
    for (size_t q = 0; q < leaf_count; ++q)
        for (size_t l = 0; l < kFanout && queries[q].row[l] != kNoRow; ++l) {
            if (interrupt.requested()) break;
            const size_t row = static_cast<size_t>(queries[q].row[l]);
            const auto region = make(queries[q].x[l], queries[q].y[l], queries[q].z[l], row);
            PointsInside search(tree, region, rows ? rows + offsets[row] : nullptr);
            traverse(tree, search);
            if (!rows) offsets[row + 1] = search.count();
        }
}

inline void in_balls(const Tree& tree, const Leaf* centres, size_t leaf_count, double radius, int64_t* offsets,
                     int64_t* rows, Interrupt& interrupt) {
    const auto ball = [=](double x, double y, double z, size_t) { return Ball{{x, y, z}, radius * radius}; };
    find_in_regions(tree, centres, leaf_count, ball, offsets, rows, interrupt);
}

// Counts the points within several distances of one query.
class DistanceCounts {
public:
    DistanceCounts(const Tree& tree, const double* query, const double* limits, size_t limit_count)
        : tree_(tree), query_(query), box_(box_of_point(query)), limits_(limits), limit_count_(limit_count) {
        double largest = 0.0;
        for (size_t s = 0; s < limit_count; ++s) largest = limits[s] > largest ? limits[s] : largest;
        bound_ = largest * largest * (1 + 1e-15) + 1e-307;  // above the square of any distance that rounds to the limit
    }

    Vector squared_gaps(const Node& node) const { return pcbench::PCB_ISA::squared_gaps(node, box_); }
    double bound() const { return bound_; }
    uint32_t last_tie() const { return UINT32_MAX; }

    void leaf(uint32_t id, const Node&, int) {
        const Leaf& leaf = tree_.leaves[id];
        const Vector distance = sqrt(squared_length(splat(query_[0]) - load(leaf.x), splat(query_[1]) - load(leaf.y),
                                                    splat(query_[2]) - load(leaf.z)));
        for (size_t s = 0; s < limit_count_; ++s) counts_[s] += __builtin_popcount(bits(distance <= splat(limits_[s])));
    }

    int64_t count(size_t s) const { return counts_[s]; }

private:
    const Tree& tree_;
    const double* query_;
    const Box box_;
    const double* limits_;
    const size_t limit_count_;
    double bound_;
    int64_t counts_[kMostLimits] = {};
};

// `limits` (M, limit_count) are distances from each query, `counts` (M, limit_count) the numbers of points within them.
inline void count_near(const Tree& tree, const Leaf* queries, size_t leaf_count, const double* limits,
                       size_t limit_count, int64_t* counts, Interrupt& interrupt) {
#pragma omp parallel for schedule(dynamic, 64) if (leaf_count > 256)
    for (size_t q = 0; q < leaf_count; ++q) {
        if (interrupt.requested()) continue;
        for (size_t l = 0; l < kFanout && queries[q].row[l] != kNoRow; ++l) {
            const double query[3] = {queries[q].x[l], queries[q].y[l], queries[q].z[l]};
            const size_t first = static_cast<size_t>(queries[q].row[l]) * limit_count;
            DistanceCounts search(tree, query, limits + first, limit_count);
            traverse(tree, search);
            for (size_t s = 0; s < limit_count; ++s) counts[first + s] = search.count(s);
        }
    }
}

inline void in_cylinders(const Tree& tree, const Leaf* origins, size_t leaf_count, const double* axes, double radius,
                         double half_length, int64_t* offsets, int64_t* rows, Interrupt& interrupt) {
    const auto cylinder = [=](double x, double y, double z, size_t row) {
        const double* axis = axes + 3 * row;
        return Cylinder{{x, y, z}, {axis[0], axis[1], axis[2]}, radius, half_length};
    };
    find_in_regions(tree, origins, leaf_count, cylinder, offsets, rows, interrupt);
}

}  // namespace pcbench::PCB_ISA
