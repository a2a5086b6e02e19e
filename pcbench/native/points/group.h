// Eight neighbouring queries that traverse the tree together, one per lane of the SIMD vectors.
// Included once per instruction set, see kernels_isa.h.
#pragma once
#include "points/walk.h"

namespace pcbench::PCB_ISA {

struct QueryGroup {
    alignas(64) double x[kLanes], y[kLanes], z[kLanes];
    size_t row[kLanes];    // row of the result
    size_t point[kLanes];  // point of the tree, for queries that are points of the tree
    int count;             // number of queries; the other lanes repeat the first
    Box box;

    explicit QueryGroup(const Leaf& leaf) : QueryGroup(leaf, 0, kFanout) {}

    // Up to `size` queries of the leaf, from position `first` on.
    QueryGroup(const Leaf& leaf, size_t first, size_t size) : count(0) {
        for (size_t l = 0; l < kLanes; ++l) {
            const bool is_query = l < size && leaf.row[first + l] != kNoRow;
            const size_t from = is_query ? first + l : first;
            count += is_query;
            x[l] = leaf.x[from], y[l] = leaf.y[from], z[l] = leaf.z[from],
            row[l] = point[l] = static_cast<size_t>(leaf.row[from]);
        }
        const double* axes[3] = {x, y, z};
        for (int a = 0; a < 3; ++a) {
            box.low[a] = box.high[a] = axes[a][0];
            for (int l = 1; l < kLanes; ++l) {
                box.low[a] = axes[a][l] < box.low[a] ? axes[a][l] : box.low[a];
                box.high[a] = axes[a][l] > box.high[a] ? axes[a][l] : box.high[a];
            }
        }
    }

    // Squared distance of each query to the box of one child of the node.
    Vector squared_gaps_to(const Node& node, int child) const {
        const double* axes[3] = {x, y, z};
        Vector gap[3];
        for (int a = 0; a < 3; ++a) {
            const Vector q = load(axes[a]);
            gap[a] = interval_gap(q, q, splat(node.low[a][child]), splat(node.high[a][child]));
        }
        return squared_length(gap[0], gap[1], gap[2]);
    }
};

inline bool is_before(double squared, double row, double other_squared, double other_row) {
    return squared < other_squared || (squared == other_squared && row < other_row);
}

}  // namespace pcbench::PCB_ISA
