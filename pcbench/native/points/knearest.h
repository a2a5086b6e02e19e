// The k nearest points of each query, one query at a time.
// Included once per instruction set, see kernels_isa.h.
#pragma once
#include "common/interrupt.h"
#include "points/group.h"

namespace pcbench::PCB_ISA {

// The nearest points found so far, sorted by (distance, row) and stored in the query's row of the result.
class NearestK {
public:
    NearestK(const Tree& tree, const double* query, size_t k, double* squared, int64_t* rows)
        : tree_(tree), query_(query), box_(box_of_point(query)), k_(k), squared_(squared), rows_(rows) {}

    // For k = 1. Any point is valid; a near one gives a low first bound, which prunes more.
    void start(int64_t hint) {
        const double* p = tree_.points + 3 * hint;
        const double dx = query_[0] - p[0], dy = query_[1] - p[1], dz = query_[2] - p[2];
        insert((dx * dx + dy * dy) + dz * dz, static_cast<double>(hint));
    }

    Vector squared_gaps(const Node& node) const { return pcbench::PCB_ISA::squared_gaps(node, box_); }
    double bound() const { return count_ < k_ ? kUnbounded : squared_[k_ - 1]; }
    uint32_t last_tie() const { return count_ < k_ ? UINT32_MAX : static_cast<uint32_t>(rows_[k_ - 1]); }

    void leaf(uint32_t id, const Node&, int) {
        const Leaf& leaf = tree_.leaves[id];
        const Vector d = squared_length(splat(query_[0]) - load(leaf.x), splat(query_[1]) - load(leaf.y),
                                        splat(query_[2]) - load(leaf.z));
        alignas(64) double squared[kLanes];
        store(squared, d);
        for (unsigned near = bits(d <= splat(bound())); near; near &= near - 1) {
            const int i = __builtin_ctz(near);
            insert(squared[i], leaf.row[i]);
        }
    }

private:
    void insert(double squared, double row) {
        if (count_ == k_) {
            if (!is_before(squared, row, squared_[k_ - 1], static_cast<double>(rows_[k_ - 1]))) return;
        } else {
            ++count_;
        }
        size_t at = count_ - 1;
        for (; at > 0 && is_before(squared, row, squared_[at - 1], static_cast<double>(rows_[at - 1])); --at)
            squared_[at] = squared_[at - 1], rows_[at] = rows_[at - 1];
        squared_[at] = squared, rows_[at] = static_cast<int64_t>(row);
    }

    const Tree& tree_;
    const double* query_;
    Box box_;
    size_t k_, count_ = 0;
    double* squared_;
    int64_t* rows_;
};

inline void knearest(const Tree& tree, const Leaf* queries, size_t leaf_count, size_t k, double* distances,
                     int64_t* indices, Interrupt& interrupt) {
#pragma omp parallel for schedule(dynamic, 16)
    for (size_t q = 0; q < leaf_count; ++q) {
        if (interrupt.requested()) continue;
        for (size_t l = 0; l < kFanout && queries[q].row[l] != kNoRow; ++l) {
            const double query[3] = {queries[q].x[l], queries[q].y[l], queries[q].z[l]};
            const size_t row = static_cast<size_t>(queries[q].row[l]);
            NearestK search(tree, query, k, distances + k * row, indices + k * row);
            traverse(tree, search);
            for (size_t j = 0; j < k; ++j) distances[k * row + j] = std::sqrt(distances[k * row + j]);
        }
    }
}

}  // namespace pcbench::PCB_ISA
